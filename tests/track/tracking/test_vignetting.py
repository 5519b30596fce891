"""Colour that darkens towards the corners, from images that were darkened by so much."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsgen.array_types import ByteArray, FloatArray
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rstrack.data.camera_file import read_rig
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import read_estimate
from rstrack.images.device_frame import DeviceRig
from rstrack.images.pyramid import corner_distance2
from rstrack.options import Options
from rstrack.tracking.first_look import views, vignetting
from rstrack.tracking.first_look.rough_track import GeometricTrack, GeometricTracks
from rstrack.tracking.first_look.vignetting import Vignetting, estimate_vignetting
from rstrack.tracking.runs.run import track

RPY = Path(__file__).resolve().parents[4] / "shared/data/tum_fr1_rpy"
needs_rpy = pytest.mark.skipif(not RPY.is_dir(), reason="../shared/data/tum_fr1_rpy is not here")


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the points of images as small as these, in a third of the time."""
    monkeypatch.setattr(views, "_ACROSS", 80)


class Darkened:
    """Images of a lens that takes light from the corners, with a gain of their own."""

    def __init__(self, dataset: Dataset, corner: float, power: float = 1.0) -> None:
        camera = dataset.rig.color_camera
        self._images, self.depth = dataset.images, dataset.images.depth
        self._factor = ((1.0 + corner * corner_distance2(camera.width, camera.height)) ** -power)[..., None]

    def color(self, k: int) -> ByteArray:
        gain = 1.0 + 0.1 * np.sin(k)
        return np.rint(np.clip(self._images.color(k) * self._factor * gain, 0, 255)).astype(np.uint8)


def true_path(dataset: Dataset, frames: range | None = None) -> list[GeometricTrack | None]:
    truth = dataset.truth
    assert truth is not None
    return [GeometricTrack(frames or range(len(dataset)), truth, truth.t_begin, truth.t_end)]


@pytest.mark.parametrize("corner", [0.3, 0.06, 0.5])
def test_what_the_corners_lose_is_found_whatever_the_gain(
    shaken: Dataset, corner: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As little as the prior draws an estimate whose σ is a third of it, and not at all without the systematic part."""
    dark = replace(shaken, images=Darkened(shaken, corner))
    found = estimate_vignetting(dark, true_path(shaken))
    assert found.strength == pytest.approx(0.9 * corner + 0.1 * 0.15, abs=5e-3) and 0.04 < found.sigma < 0.055
    assert found.pairs > 10 and "% darker" in found.text() and "pairs of images" in found.text()
    monkeypatch.setattr(vignetting, "_SYSTEMATIC", 1e-3)
    found = estimate_vignetting(dark, true_path(shaken))
    assert found.strength == pytest.approx(corner, abs=4e-3) and found.sigma < 5e-3


def test_the_law_of_a_lens_is_near_enough(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """cos⁴ of a quarter of the light, seen through a gamma of 2.2."""
    corner = 0.75**-0.5 - 1.0
    monkeypatch.setattr(vignetting, "_SYSTEMATIC", 1e-3)
    found = estimate_vignetting(replace(shaken, images=Darkened(shaken, corner, 2.0 / 2.2)), true_path(shaken))
    d2 = corner_distance2(160, 120)
    np.testing.assert_allclose((1.0 + found.strength * d2) * (1.0 + corner * d2) ** (-2.0 / 2.2), 1.0, atol=0.01)


def test_even_images_stay_about_as_they_are(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    found = estimate_vignetting(shaken, true_path(shaken))
    assert 0.0 <= found.strength < 0.02 and found.sigma < 0.055
    monkeypatch.setattr(vignetting, "_SYSTEMATIC", 1e-3)
    brighter = replace(shaken, images=Darkened(shaken, -0.1))
    assert estimate_vignetting(brighter, true_path(shaken)).strength == 0.0, "no lens does that"


def test_what_no_motion_shows_is_taken_from_what_lenses_do(shaken: Dataset) -> None:
    dark = replace(shaken, images=Darkened(shaken, 0.3))
    for tracks in ([None], true_path(shaken, range(5))):
        found = estimate_vignetting(dark, tracks)
        assert found == Vignetting(0.15, 0.15, 0) and "as lenses do" in found.text()
    assert estimate_vignetting(dark, [None, *true_path(shaken)]).strength == pytest.approx(0.285, abs=5e-3)


class Covered:
    """Images whose depth shows something half as far away in the left half."""

    def __init__(self, dataset: Dataset) -> None:
        self._images, self.color = dataset.images, dataset.images.color

    def depth(self, k: int) -> FloatArray:
        z = self._images.depth(k).copy()
        z[:, : z.shape[1] // 2] *= 0.5
        return z


def test_points_that_depth_does_not_show_where_they_were_do_not_count(shaken: Dataset) -> None:
    """Regression: beside things that move the corners were found to be 16 % brighter where they were darker."""
    assert shaken.truth is not None
    seen, covered = views.Views(shaken, shaken.truth), replace(shaken, images=Covered(shaken))
    p_world = seen.points(0)
    still = views.rests(shaken, shaken.truth, p_world, 0, seen.depth(0))
    hidden = views.rests(covered, shaken.truth, p_world, 0, covered.depth(0))
    assert still.mean() > 0.97 and not (hidden & ~still).any() and 0.4 < hidden.mean() < 0.6
    later = views.rests(shaken, shaken.truth, p_world, 6, seen.depth(6))
    assert 0.5 < later.mean() < 1.0


@pytest.mark.nightly
@needs_rpy
def test_a_kinect_darkens(tmp_path: Path) -> None:
    """Nobody has measured it otherwise; two halves of the recording agree."""
    (tmp_path / "camera.yaml").write_text(
        "color: {width: 640, height: 480, intrinsics: [525, 525, 319.5, 239.5], readout_s: 0.03, offset_s: 0.018}"
    )
    dataset = open_dataset(RPY, tmp_path / "camera.yaml")
    found = estimate_vignetting(dataset, GeometricTracks(dataset, range(60, 160), Options(), no_progress))
    assert found.strength == pytest.approx(0.097, abs=0.02) and found.sigma < 0.055


def test_the_tracker_sees_even_images(shaken: Dataset) -> None:
    frame, camera = shaken.frame(3), shaken.rig.color_camera
    dark = replace(frame, colors=(replace(frame.colors[0], pixels=Darkened(shaken, 0.3).color(3)),))
    seen = []
    for rig, given in ((shaken.rig, frame), (replace(shaken.rig, color_falloff=0.3), dark)):
        image = DeviceRig(rig, Options(backend="llvm")).upload(3, given).colors[0]
        seen.append(np.array(image.levels[0]).reshape(camera.height, camera.width))
    good = np.isfinite(seen[0]) & np.isfinite(seen[1])
    np.testing.assert_allclose(seen[1][good], seen[0][good] * (1.0 + 0.1 * np.sin(3)), atol=0.006)


def test_a_run_finds_it_unless_the_camera_file_says_it_or_it_was_rendered_without(
    shaken: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Dataset] = []

    def estimate(seen: Dataset, *_: object) -> Vignetting:
        asked.append(seen)
        return Vignetting(0.25, 0.002, 20)

    monkeypatch.setattr(vignetting, "estimate_vignetting", estimate)
    assert shaken.rig.color_falloff == 0.0
    recorded = replace(shaken, rig=replace(shaken.rig, color_falloff=None))
    track(recorded, Options(backend="llvm", loops="off"), tmp_path / "run", slice(0, 8))
    notes = read_estimate(tmp_path / "run").info["dataset"]["notes"]
    assert asked == [recorded] and "20.0 % darker" in notes[0]
    track(shaken.with_color_falloff(0.1), Options(backend="llvm", loops="off"), tmp_path / "run", slice(0, 8))
    track(shaken, Options(backend="llvm", loops="off"), tmp_path / "run", slice(0, 8))
    track(recorded, Options(backend="llvm", method="rs-g", loops="off"), tmp_path / "run", slice(0, 8))
    assert len(asked) == 1
    file = tmp_path / "camera.yaml"
    stream = "width: 160, height: 120, intrinsics: [120, 120, 79.5, 59.5], readout_s: 0.01"
    for key, falloff in (("", None), (", falloff: auto", None), (", falloff: 0", 0.0), (", falloff: 0.12", 0.12)):
        file.write_text(f"color: {{{stream}{key}}}")
        assert read_rig(file, (160, 120), (160, 120)).rig.color_falloff == falloff
    file.write_text(f"color: {{{stream}, falloff: 3}}")
    with pytest.raises(UserError, match="falloff"):
        read_rig(file, (160, 120), (160, 120))
