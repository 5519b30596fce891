"""Depth and colour as one pinhole camera sees them, for trackers that want that: against ray casting."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import synthetic

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.data.dataset import open_dataset, registered_image
from rstrack.data.registration import RegisteredImage, Registrar
from rstrack.data.rig import Rig

GLOBAL = Shutter(0.0)
DISTORTED = Camera(160, 120, 115.0, 117.0, 81.0, 58.0, "radtan", (0.08, -0.1, 0.002, -0.001))
PLAIN = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)


def captured(depth_camera: Camera, color_camera: Camera, T_color_depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and colour of the synthetic room at one instant."""
    spline = synthetic.make_spline(0.0)
    z = synthetic.render_depth(spline, depth_camera, GLOBAL, 0.0)
    return z, synthetic.render_color(spline, color_camera, GLOBAL, 0.0, T_color_depth)


def test_registered_images_are_those_of_one_pinhole_camera() -> None:
    T_color_depth = synthetic.T_COLOR_DEPTH
    z, color = captured(DISTORTED, PLAIN, T_color_depth)
    registrar = Registrar(Rig(DISTORTED, GLOBAL, PLAIN, GLOBAL, T_color_depth))
    image = registrar(z, color)
    assert registrar.camera == Camera(160, 120, 115.0, 117.0, 81.0, 58.0)
    # A camera without distortion at the depth camera's place sees this. Edges of the ball are the nearest pixel's.
    z_true, color_true = captured(registrar.camera, registrar.camera, np.eye(4))
    seen = image.depth > 0
    assert 0.9 < seen.mean() < 1.0
    wrong = np.abs(image.depth - z_true)[seen]
    assert np.median(wrong) < 1e-4 and np.mean(wrong > 2e-3) < 0.06
    off = np.abs(image.color.astype(int) - color_true)[seen].max(axis=-1)
    assert np.median(off) <= 1 and np.mean(off > 4) < 0.03
    # Without undistorting, neither would be anywhere near.
    assert np.mean(np.abs(z - z_true)[seen] > 2e-3) > 0.5


def test_images_that_fit_already_stay_as_they_are() -> None:
    z, color = captured(PLAIN, PLAIN, np.eye(4))
    image = Registrar(Rig(PLAIN, GLOBAL, PLAIN, GLOBAL, np.eye(4)))(z, color)
    np.testing.assert_array_equal(image.depth, z)
    np.testing.assert_array_equal(image.color, color)


def test_missing_depth_stays_missing_and_grows_no_smaller() -> None:
    z, color = captured(DISTORTED, PLAIN, synthetic.T_COLOR_DEPTH)
    z[40:60, 50:90] = 0.0
    image = Registrar(Rig(DISTORTED, GLOBAL, PLAIN, GLOBAL, synthetic.T_COLOR_DEPTH))(z, color)
    hole = image.depth[35:65, 45:95] == 0
    assert 0.8 * 800 < hole.sum() < 1.2 * 800
    assert image.depth[image.depth > 0].min() > 0.5
    # There is colour all the same, and no black edge in it.
    assert image.color[42:58, 55:85].min() > 10


def test_depth_takes_the_colour_image_that_is_nearest_in_time(tmp_path: Path) -> None:
    late = {"offset_s": 0.02, "readout_s": 0.0}
    config = synthetic.make_config(32, 24, color=late, depth={"readout_s": 0.0})
    dataset = open_dataset(synthetic.make_sequence(tmp_path / "seq", config, 4))
    asked: list[tuple[str, int]] = []

    def read(name: str, value: Any) -> Callable[[int], Any]:
        return lambda k: (asked.append((name, k)), value)[1]

    images, depth = SimpleNamespace(color=read("color", None)), read("depth", np.ones((24, 32), np.float32))
    fake = SimpleNamespace(images=images, depth=depth, stamps=dataset.stamps, color_stamps=dataset.color_stamps)
    for k in range(4):
        registered_image(fake, lambda depth, color: RegisteredImage(depth, color), k)  # type: ignore[arg-type]
    assert [k for name, k in asked if name == "color"] == [0, 0, 1, 2]  # 20 ms late: nearer to the next depth image
