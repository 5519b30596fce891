"""Calibration out of recordings: a lens, drift, noise, what is not told, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
from shaken_recording import CORNER, OPTIONS, SHORT, FaultyDepth, recording, shaking

from rsgen.array_types import ByteArray
from rsgen.console.progress import no_progress
from rsgen.device.arrays import engine
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.calibration import run as calibration_run
from rstrack.calibration import solve as calibration_solve
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.trust import trust_in
from rstrack.calibration.parameters import (
    COUNT,
    DRIFT,
    LENSES,
    USEFUL,
    free_of,
)
from rstrack.calibration.run import calibrate, parameters_of
from rstrack.calibration.start import load_window
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import NoisyImages, with_noise
from rstrack.data.rig import DepthError
from rstrack.options import Options

pytestmark = pytest.mark.usefixtures("few_pairs")


def test_a_lens_and_depth_are_put_right(shaken: Dataset) -> None:
    rig, color = shaken.rig, shaken.rig.color_camera
    lens = replace(color, fx=1.02 * color.fx, fy=1.018 * color.fy, cx=color.cx + 1.5, cy=color.cy - 1.0)
    images = FaultyDepth(shaken.images, DepthError(-0.02), rig.depth_camera)
    wrong = replace(shaken, images=images, rig=replace(rig, color_camera=lens))
    found = calibrate(wrong, ("intrinsics", "depth"), SHORT, OPTIONS)
    made = found.calibrated()
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(made.rig.color_camera, name) == pytest.approx(getattr(color, name), abs=0.15), name
        depth = getattr(made.rig.depth_camera, name), getattr(rig.depth_camera, name)
        assert depth[0] == pytest.approx(depth[1], abs=0.1), name
    assert made.rig.color_camera.distortion == pytest.approx((0.0,) * 5, abs=8e-3)
    np.testing.assert_allclose(made.depth(30), shaken.depth(30), atol=4e-3)
    assert found.values.error.offset_m == pytest.approx(0.02, abs=1e-3)
    text = found.text()
    assert "colour fx" in text and "depth offset" in text and "depth's scale cannot be determined" in text


@pytest.mark.nightly
def test_a_lens_that_is_right_is_left_as_it_is_and_noise_makes_sigmas_grow(shaken: Dataset) -> None:
    noisy = replace(shaken, images=NoisyImages(shaken.images, 1.2e-3, 0.01, 1))
    plain = calibrate(shaken, ("readout",), SHORT, OPTIONS)
    grown = calibrate(noisy, ("readout", "intrinsics"), SHORT, OPTIONS)
    assert grown.keeps_file_lens and not grown.asked[LENSES].any() and grown.asked[:2].all()
    assert pytest.approx(shaken.rig.color_camera.K) == grown.calibrated().rig.color_camera.K
    assert "the lens is the file's" in grown.text()
    assert (grown.sigmas[:2] > 2.0 * plain.sigmas[:2]).all()
    assert (np.abs(grown.values.since(grown.start)[:2]) < 5.0 * grown.sigmas[:2]).all()


def test_noise_is_that_of_track(shaken: Dataset) -> None:
    noisy = replace(shaken, images=NoisyImages(shaken.images, 2e-3, 0.02, 7))
    frame = with_noise(shaken.frame(9), 9, 2e-3, 0.02, 7)
    np.testing.assert_array_equal(noisy.images.depth(9), frame.depth.pixels)
    np.testing.assert_array_equal(noisy.images.color(9), frame.colors[0].pixels)


def test_a_camera_at_rest_tells_nothing_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spline = shaking()
    still = Spline(np.broadcast_to(CORNER, spline.control_points.shape).copy(), spline.t0, spline.dt)
    rest = recording(tmp_path / "seq", still)
    # Noise is not taken for motion either.
    noisy = replace(rest, images=NoisyImages(rest.images, 1.2e-3, 0.01, 1))
    found = calibrate(noisy, frames=SHORT, options=OPTIONS)
    assert found.undetermined[found.asked].all()
    assert found.values.since(found.start) == pytest.approx(np.zeros(COUNT), abs=1e-12)
    assert "undetermined: needs turning" in found.text() and "this recording moves at" in found.text()
    monkeypatch.setattr(calibration_run, "calibrate", lambda *_: found)
    assert main(["calibrate", str(tmp_path / "seq"), "--quiet"]) == 1
    assert "undetermined" in capsys.readouterr().out


def test_a_bare_wall_is_told_from_a_room(shaken: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def grey(*_: object) -> ByteArray:
        return np.full((120, 160, 3), 127, np.uint8)

    monkeypatch.setattr(synthetic, "BALL", np.array([0.35, 0.25, -30.0]))
    monkeypatch.setattr(synthetic, "render_color", grey)
    base = shaking()
    wall = se3.exp(np.array([0.0, 0.0, 1.0, 0.05, 0.1, 0.0])) @ se3.inverse(CORNER) @ base.control_points
    bare = recording(tmp_path / "wall", Spline(wall, base.t0, base.dt))
    trusts = []
    for dataset in (shaken, bare):
        noisy = replace(dataset, images=NoisyImages(dataset.images, 1.2e-3, 0.01, 1))
        terms, p = PairTerms(engine("llvm"), noisy, free_of(())), parameters_of(noisy)
        assert dataset.truth is not None
        part = load_window(terms, noisy, range(10, 24), dataset.truth, p, OPTIONS)
        for _ in range(3):
            part.sums(terms, p, 0)
        trusts.append(trust_in(part, terms, p))
    assert trusts[0] > 0.8 and trusts[1] < 0.3
    monkeypatch.setattr(calibration_run, "trust_in", lambda *_: 0.1)
    with pytest.raises(UserError, match="3 of 3 windows what seems to be known of the motion is noise"):
        calibrate(shaken, ("readout",), SHORT, OPTIONS)


@pytest.mark.parametrize("drift", [0.0, 3e-3])
def test_a_drift_is_found_or_else_held(shaken: Dataset, monkeypatch: pytest.MonkeyPatch, drift: float) -> None:
    monkeypatch.setattr(calibration_run, "_DRIFT_S", 0.5)
    # A second shows a drift a hundred times less well than ten do.
    monkeypatch.setattr(calibration_solve, "USEFUL", np.where(np.arange(COUNT) == DRIFT, 1e-3, USEFUL))
    off = drift * (shaken.color_stamps - shaken.middle)
    found = calibrate(replace(shaken, color_stamps=shaken.color_stamps - off), ("offset",), SHORT, OPTIONS)
    assert found.asked[DRIFT] == (drift > 0.0) and not found.undetermined.any()
    assert found.values.color_drift == pytest.approx(drift, abs=2e-4 if drift else 0.0)
    assert ("colour drift" in found.text()) == (drift > 0.0)


def test_knots_of_every_other_window_lie_half_a_spacing_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever phase is asked for: what a spline cannot follow then averages out of the clocks."""
    monkeypatch.setattr(calibration_run, "load_window", lambda *given: given[-1].knot_phase)
    dataset: Any = SimpleNamespace(with_color_offset=lambda *_, **__: None)
    for asked in (0.0, 0.5, 0.8):
        given: list[Any] = [dataset, None, [range(30)] * 4, None, None, Options(knot_phase=asked)]
        first, second, *rest = calibration_run._loaded(*given, no_progress)
        assert first == asked and abs(second - first) == pytest.approx(0.5) and rest == [first, second]
