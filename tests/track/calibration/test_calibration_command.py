"""Calibration as it is used: scan directions, devices, the file that comes of it, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shaken_recording import FRAMES, OPTIONS, PACE, RATE_HZ, READOUT_S, RESIDUALS, SHORT, recording, shaking, told

from rstrack.calibration import run as calibration_run
from rstrack.calibration.devices import Device, PublishedShutter
from rstrack.calibration.parameters import (
    COUNT,
    DEPTH_ERROR,
    DEPTH_LENS,
    NAMES,
    POSES,
    PRIOR,
    changed,
)
from rstrack.calibration.record import camera_file_of, read_record
from rstrack.calibration.result import CameraCalibration
from rstrack.calibration.run import calibrate, parameters_of
from rstrack.calibration.solve import Solution
from rstrack.cli.main import main
from rstrack.data.camera_file import read_rig
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.rig import EXACT_SIGMA, DepthError
from rstrack.data.timing import Timing, stream_timing

pytestmark = pytest.mark.usefixtures("few_pairs")


@pytest.mark.nightly
def test_lines_that_are_read_the_other_way_are_seen_to_be(tmp_path: Path) -> None:
    upward = recording(tmp_path / "seq", shaking(), scan="bottom-top")
    found = calibrate(told(upward, 0.004, 0.0, np.zeros(6)), frames=SHORT, options=OPTIONS)
    assert found.values.depth_readout_s < 0.0 and found.values.color_readout_s < 0.0
    right = found.calibrated()
    for shutter in (right.rig.depth_shutter, right.rig.color_shutter):
        assert shutter.scan == "bottom-top" and shutter.readout_s == pytest.approx(READOUT_S, abs=2e-4)
    # Stamps of both streams are those of the line that was thought to be first: alike for both, no offset.
    assert right.color_stamps == pytest.approx(upward.color_stamps, abs=2e-4)
    assert "depth is read bottom-top, not top-bottom" in found.text()


@pytest.mark.nightly
def test_columns_are_told_from_rows_where_nobody_names_them(tmp_path: Path) -> None:
    sideways = recording(tmp_path / "seq", shaking(), scan="right-left")
    unnamed = replace(told(sideways, 0.0, 0.0, np.zeros(6)), scan_named=False)
    found = calibrate(unnamed, ("readout",), SHORT, OPTIONS)
    for shutter in (found.calibrated().rig.depth_shutter, found.calibrated().rig.color_shutter):
        assert shutter.scan == "right-left" and shutter.readout_s == pytest.approx(READOUT_S, abs=2e-4)


@pytest.mark.nightly
def test_an_image_exposed_at_once_has_no_readout(tmp_path: Path) -> None:
    at_once = recording(tmp_path / "seq", shaking(), readout_s=0.0)
    found = calibrate(told(at_once, 0.012, 0.0, np.zeros(6)), ("readout",), SHORT, OPTIONS)
    sigmas = found.sigmas
    for i, readout_s in enumerate((found.values.depth_readout_s, found.values.color_readout_s)):
        assert abs(readout_s) < min(4.0 * sigmas[i], 3e-4)


def test_ctrl_c_keeps_what_there_is(shaken: Dataset) -> None:
    calls: list[str] = []

    def progress(stage: str, _: float, note: str) -> None:
        calls.append(stage)
        if note.startswith("readouts") and sum(stage == "calibrating" for stage in calls) > 6:
            raise KeyboardInterrupt

    found = calibrate(told(shaken, 0.012, 0.0, np.zeros(6)), None, SHORT, OPTIONS, progress)
    assert not found.solution.finished and "interrupted" in found.text()
    assert abs(found.values.color_readout_s - READOUT_S) < abs(0.012 - READOUT_S)


def test_the_camera_file_says_what_was_found(shaken: Dataset, tmp_path: Path) -> None:
    start = parameters_of(shaken)
    step = np.zeros(COUNT)
    step[:POSES] = -0.02, 2e-3, -1.5e-3, 1e-5, 1e-3, 0, 0, 0, 0.01, 0
    step[POSES : POSES + 4], step[DEPTH_ERROR] = (0.01, -0.02, 0.03, -0.01), (0.004, 1e-3, -2e-3)
    found = start.moved(step)
    free = np.ones(COUNT, bool)
    free[5] = False
    A = np.array([np.diag(1.0 / (1e-3 * PRIOR[free]) ** 2)] * 3)
    solution = Solution(found, free, A, np.zeros((3, COUNT - 1)), 0.0, 1e-3, 1e-2)
    motion = calibration_run.motion_of(shaken, [range(30)], shaking())
    made = CameraCalibration(shaken, start, solution, np.ones(COUNT, bool), (range(30),), motion, 1.0, RESIDUALS, PACE)
    (tmp_path / "camera.yaml").write_text(camera_file_of(made))
    again = open_dataset(shaken.root, tmp_path / "camera.yaml")
    expected = made.calibrated()
    for ours, theirs in zip(
        (again.rig.depth_shutter, again.rig.color_shutter), (expected.rig.depth_shutter, expected.rig.color_shutter),
        strict=True,
    ):  # fmt: skip
        assert ours.scan == theirs.scan and ours.readout_s == pytest.approx(theirs.readout_s, abs=1e-7)
    assert again.rig.depth_shutter.scan == "bottom-top"
    assert again.depth_error == expected.depth_error == DepthError(0.004, 1e-3, -2e-3)
    assert pytest.approx(changed(shaken.rig.depth_camera, step[DEPTH_LENS]).K, rel=1e-9) == again.rig.depth_camera.K
    np.testing.assert_allclose(again.rig.T_color_depth, expected.rig.T_color_depth, atol=1e-10)
    np.testing.assert_allclose(again.color_stamps, expected.color_stamps, atol=2e-7)
    # Stamps are used as they were, whatever 'auto' would make of them.
    clock = stream_timing("depth", shaken.stamps, "regular", 0.0)
    regular = replace(made, dataset=replace(shaken, timing=Timing(clock, clock, 0.0)))
    assert "\nstamps: regular" in camera_file_of(regular) and "\nstamps" not in camera_file_of(made)
    # Of stamps that are arrival times the offset is this recording's alone.
    jittered = replace(clock, clock=replace(clock.clock, verdict="jittered"))
    arrived = camera_file_of(replace(made, dataset=replace(shaken, timing=Timing(jittered, clock, 0.0))))
    (tmp_path / "clocks.yaml").write_text(arrived)
    own = open_dataset(shaken.root, tmp_path / "clocks.yaml")
    np.testing.assert_allclose(own.color_stamps, expected.color_stamps, atol=2e-7)
    sizes = [(camera.width, camera.height) for camera in (shaken.rig.color_camera, shaken.rig.depth_camera)]
    another = read_rig(tmp_path / "clocks.yaml", *sizes).of("another")
    assert another.color_offset_s is None and another.color_drift == 0.0
    text = (tmp_path / "camera.yaml").read_text()
    assert "±" in text and "undetermined, kept" in text
    # Extrinsics that were not found are known as badly as they were.
    vague = replace(shaken, rig=replace(shaken.rig, sigma=replace(EXACT_SIGMA, rotation_deg=1.0, translation_m=0.02)))
    still = replace(made, dataset=vague).stated_sigmas()
    assert still["translation_m"] == 0.02 and still["rotation_deg"] < 0.1
    # p1 and p2 trade with the principal point here: it holds nearly all of their σ.
    trading = A.copy()
    lens = [NAMES.index(f"color.{name}") - 1 for name in ("cx", "p2")]
    trading[:, lens[0], lens[1]] = trading[:, lens[1], lens[0]] = -0.99 * np.sqrt(np.prod(A[0].diagonal()[lens]))
    traded = replace(made, solution=replace(solution, A=trading)).stated_sigmas()
    assert still["p"] == pytest.approx(made.sigmas[NAMES.index("color.p2")], rel=0.01)
    assert traded["center_px"] > 5.0 * still["center_px"] and traded["p"] == still["p"]
    parameters = made.as_dict()["parameters"]
    assert parameters["T_color_depth.y"]["sigma"] is None and parameters["color.offset_s"]["sigma"] > 0.0


def test_ctrl_c_while_calibrating_ends_track_too(
    shaken: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(dataset: Dataset, *_: object) -> CameraCalibration:
        start = parameters_of(dataset)
        nothing = Solution(start, np.zeros(COUNT, bool), np.zeros((3, 0, 0)), np.zeros((3, 0)), 0, 1, 1, finished=False)
        motion = calibration_run.motion_of(dataset, [range(30)], shaking())
        return CameraCalibration(dataset, start, nothing, nothing.free, (range(30),), motion, 1.0, RESIDUALS, PACE)

    monkeypatch.setattr(calibration_run, "calibrate", interrupted)
    assert main(["track", str(shaken.root), "--calibrate", "--out", str(tmp_path / "run"), "--quiet"]) == 130
    assert not (tmp_path / "run").exists()


def test_a_sequence_is_calibrated_and_tracked_by_command(
    shaken: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[CameraCalibration] = []

    def once(*given: Any, **named: Any) -> CameraCalibration:
        if not found:
            found.append(calibrate(*given, **named))
        return found[0]

    monkeypatch.setattr(calibration_run, "calibrate", once)
    wrong = tmp_path / "wrong.yaml"
    K = [120.0, 120.0, 79.5, 59.5]
    T = shaken.rig.T_color_depth.tolist()
    stream = f"width: 160, height: 120, intrinsics: {K}, scan: top-bottom"
    wrong.write_text(
        f"color: {{{stream}, readout_s: 0.0, offset_s: 0.006}}\ndepth: {{{stream}, readout_s: 0.0}}\n"
        f"T_color_depth: {T}\n"
    )
    right, run = tmp_path / "right.yaml", tmp_path / "run"
    arguments = ["--camera", str(wrong), "--free", "readout,offset", "--out", str(right), "--quiet", "--json"]
    arguments += ["--report", str(tmp_path / "new/page.html"), "--frames", "0:42"]
    assert main(["calibrate", str(shaken.root), *arguments, "--backend", "llvm"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["parameters"]["color.offset_s"]["value"] == pytest.approx(0.0, abs=2e-4)
    assert figures["parameters"]["color.offset_s"]["shown"] == {"label": "colour offset", "unit": "ms", "factor": 1e3}
    depth_m, intensity = (figures["residuals"][kind] for kind in ("depth_m", "intensity"))
    assert depth_m["before"] > 2.0 * depth_m["after"] and intensity["before"] >= intensity["after"]
    times, pace = np.array(figures["stretch_times_s"]), figures["pace"]
    assert (times[:, 1] - times[:, 0] == pytest.approx(13 / RATE_HZ, abs=2e-4)) and times.max() <= FRAMES / RATE_HZ
    turning = np.linalg.norm(shaking().velocity(np.array(pace["time_s"]) + shaken.stamps[0])[:, 3:], axis=1)
    assert np.median(np.abs(pace["rad_s"] - turning)) < 0.1 * turning.mean()
    assert "camera.yaml" in (tmp_path / "new/page.html").read_text()
    tracked = ["track", str(shaken.root), "--camera", str(right), "--out", str(run), "--frames", "0:24", "--quiet"]
    assert main(tracked) == 0
    assert main(["evaluate", str(shaken.root), str(run), "--json"]) == 0
    out = capsys.readouterr().out
    errors = json.loads(out[out.index("{\n") :])
    assert errors["ate_rmse_m"] < 2e-3
    more = ["--camera", str(wrong), "--calibrate", "--out", str(tmp_path / "again"), "--frames", "0:8", "--quiet"]
    assert main(["track", str(shaken.root), *more]) in (0, 1)
    assert (tmp_path / "again/camera.yaml").read_text().startswith("# rstrack calibrate synthetic")
    kept = read_record(tmp_path / "again/calibration.json")
    assert kept.camera_file == (tmp_path / "again/camera.yaml").read_text()
    assert main(["track", str(shaken.root), "--out", str(tmp_path / "again"), "--frames", "0:4", "--quiet"]) in (0, 1)
    assert not (tmp_path / "again/calibration.json").exists(), "it is of another run"


def test_a_device_that_the_recording_contradicts_is_left_out(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration_run, "_COARSE", (1,))
    wrong = told(shaken, 0.01, 0.0, np.zeros(6))
    stream = PublishedShutter("global", "made up", "https://example.org", 0.0, 1e-4)
    device = Device("made-up", "Made up", stream, stream)
    found = calibrate(wrong, ("readout",), SHORT, OPTIONS, device=device)
    assert found.text().count("this recording contradicts the device's") == 2 and found.start.depth_readout_s == 0.0
    for readout_s in (found.values.depth_readout_s, found.values.color_readout_s):
        assert readout_s == pytest.approx(READOUT_S, abs=1e-3)
    assert "# device: Made up: depth global" in camera_file_of(found)
