"""Images in bags: every encoding of colour and depth, and every model of a lens, against what was encoded."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import recordings
from import_command import CONTENT, imported, refused
from recordings import COLOR, COLOR_SIZE, COUNT, DEPTH, FRAME, Talker

from rsgen.image_codecs import encode_png

Maker = Callable[[Talker, int, int], tuple[str, Any]]


def rgb(k: int) -> np.ndarray:
    return CONTENT.colors[k]


ENCODINGS: dict[str, tuple[Maker, float]] = {
    "bgr8": (lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", rgb(k)[..., ::-1], "bgr8", padding=5)), 0),
    "bgra8": (
        lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", cv2.cvtColor(rgb(k), cv2.COLOR_RGB2BGRA), "bgra8")), 0,
    ),
    "mono8": (lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", rgb(k)[..., 1], "mono8")), 0),
    "yuyv": (lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", yuyv(smooth(k)), "yuv422_yuy2")), 12),
    "uyvy": (
        lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", yuyv(smooth(k))[..., ::-1], "yuv422")), 12,
    ),
    "png": (lambda t, k, ns: ("sensor_msgs/CompressedImage", t.compressed(ns, "c", encode_png(rgb(k)), "png")), 0),
    "jpeg": (
        lambda t, k, ns: ("sensor_msgs/CompressedImage",
                          t.compressed(ns, "c", recordings.jpeg(smooth(k)), "rgb8; jpeg compressed bgr8")), 12,
    ),
}  # fmt: skip


def smooth(k: int) -> np.ndarray:
    """An image that survives half the chroma and a JPEG."""
    x, y = np.meshgrid(np.arange(COLOR_SIZE[0]), np.arange(COLOR_SIZE[1]))
    return np.stack([60 + 3 * x, 40 + 5 * y, 200 - 2 * x + 0 * y + 5 * k], axis=-1).astype(np.uint8)


def yuyv(pixels: np.ndarray) -> np.ndarray:
    """(h, w, 2) by BT.601's formulas in video range."""
    r, g, b = (pixels[..., i].astype(float) for i in range(3))
    luma = 16 + 0.257 * r + 0.504 * g + 0.098 * b
    u, v = 128 - 0.148 * r - 0.291 * g + 0.439 * b, 128 + 0.439 * r - 0.368 * g - 0.071 * b
    chroma = np.empty_like(luma)
    chroma[:, 0::2], chroma[:, 1::2] = u[:, 0::2], v[:, 0::2]
    return np.rint(np.stack([luma, chroma], axis=-1)).astype(np.uint8)


@pytest.mark.parametrize("name", ENCODINGS)
def test_colour_of_every_encoding(place: Path, capfd: pytest.CaptureFixture[str], name: str) -> None:
    talker, (maker, tolerance) = Talker(True), ENCODINGS[name]
    topic = f"{COLOR}/compressed" if name in ("png", "jpeg") else COLOR
    spoken = recordings.speak(talker, CONTENT, color=lambda k, ns: maker(talker, k, ns), color_topic=topic)
    recordings.write_spoken(place / "one.bag", talker, spoken)
    dataset, _ = imported(capfd, "one.bag")
    for k in range(COUNT):
        wanted = rgb(k)[..., 1][..., None].repeat(3, 2) if name == "mono8" else smooth(k) if tolerance else rgb(k)
        assert np.abs(dataset.images.color(k).astype(float) - wanted).max() <= tolerance
    if name in ("png", "jpeg"):
        first = encode_png(rgb(0)) if name == "png" else recordings.jpeg(smooth(0))
        assert next(Path("out/rgb").glob("000000.*")).read_bytes() == first


@pytest.mark.parametrize("kind", ["32FC1", "compressed", "compressed 32FC1", "bigendian"])
def test_depth_of_every_encoding(place: Path, capfd: pytest.CaptureFixture[str], kind: str) -> None:
    talker = Talker(False)
    a, b = 100.0, 1.0 / 100  # compressed_depth_image_transport: inverse depth = A / z + B

    def depth(k: int, ns: int) -> tuple[str, Any]:
        z = np.where(CONTENT.units[k] > 0, CONTENT.units[k] / 1000, np.nan)
        frame = FRAME["depth"]
        if kind == "32FC1":
            return "sensor_msgs/Image", talker.image(ns, frame, z.astype(np.float32), "32FC1", padding=8)
        if kind == "bigendian":
            message = talker.image(ns, frame, CONTENT.units[k].astype(">u2"), "16UC1")
            message.is_bigendian = 1
            return "sensor_msgs/Image", message
        if kind == "compressed":
            data, format = bytes(12) + encode_png(CONTENT.units[k]), "16UC1; compressedDepth"
        else:
            inverse = np.nan_to_num(np.rint(a / z + b), nan=0.0).astype(np.uint16)
            data = np.array([0, a, b], "<f4").tobytes() + encode_png(inverse)
            format = "32FC1; compressedDepth png"
        return "sensor_msgs/CompressedImage", talker.compressed(ns, frame, data, format)

    topic = f"{DEPTH}/compressedDepth" if kind.startswith("compressed") else DEPTH
    spoken = recordings.speak(talker, CONTENT, depth=depth, depth_topic=topic)
    recordings.write_spoken(place / "two", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "two")
    for k in range(COUNT):
        z, wanted = dataset.images.depth(k), CONTENT.units[k] / 1000
        assert ((z == 0) == (wanted == 0)).all()
        if kind == "compressed 32FC1":  # half a quantum of inverse depth, and 0.1 mm
            seen = wanted > 0
            assert (np.abs(1 / z[seen] - 1 / wanted[seen]) <= 0.5 / a + 1e-4 / wanted[seen] ** 2).all()
        else:  # a millimetre is 1 or 5 units
            assert np.abs(z - wanted).max() < 1e-6


def test_lens_models_and_undistorted_images(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    talker = Talker(False)
    D, fish = [0.1, -0.2, 0.001, 0.002, 0.05], [0.01, -0.02, 0.003, -0.001]
    spoken = recordings.speak(talker, CONTENT, color_info=("plumb_bob", D), depth_info=("equidistant", fish),
                              depth_topic="/camera/depth/image_raw")  # fmt: skip
    recordings.write_spoken(place / "a", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "a")
    assert dataset.rig.color_camera.model == "radtan" and dataset.rig.color_camera.distortion == tuple(D)
    assert dataset.rig.depth_camera.model == "fisheye" and dataset.rig.depth_camera.distortion == tuple(fish)
    spoken = recordings.speak(talker, CONTENT, color_info=("rational_polynomial", [*D, 0.0, 0.0, 0.0]),
                              depth_info=("plumb_bob", D))  # fmt: skip
    recordings.write_spoken(place / "b", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "b --force")
    assert dataset.rig.color_camera.model == "radtan" and dataset.rig.color_camera.distortion == tuple(D)
    assert dataset.rig.depth_camera.model == "pinhole"  # image_rect_raw: what is published is undistorted
    full = [0.5, -2.6, 6e-4, -1e-4, 1.5, 0.38, -2.45, 1.46]
    spoken = recordings.speak(talker, CONTENT, color_info=("rational_polynomial", full))
    recordings.write_spoken(place / "d", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "d --force")
    assert dataset.rig.color_camera.model == "rational" and dataset.rig.color_camera.distortion == tuple(full)
    spoken = recordings.speak(talker, CONTENT, color_info=("double_sphere", [-0.2, 0.6]))
    recordings.write_spoken(place / "e", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "e --force")
    assert dataset.rig.color_camera.model == "double_sphere"
    assert dataset.rig.color_camera.distortion == (-0.2, 0.6)
    spoken = recordings.speak(talker, CONTENT, color_info=("double_sphere", D))
    recordings.write_spoken(place / "c", talker, spoken, "mcap")
    (place / "out").rename(place / "before")
    refused(capfd, "c", "double_sphere", "undistort")
