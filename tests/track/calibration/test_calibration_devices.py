"""What is published of devices: the table, how it draws a solution, and what is said of contradictions."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsgen.errors import UserError
from rstrack.calibration.devices import DEVICES, Device, PublishedShutter, device_named, device_notes
from rstrack.calibration.parameters import COUNT, Known, Parameters, free_of
from rstrack.calibration.solve import Solution
from rstrack.cli.main import main

RECORDINGS = Path(__file__).parents[3] / "docs/recordings.md"
FILE = Parameters(0.005, 0.007, 1e-3, 0.0, np.eye(4))
READOUTS = free_of(("readout",))


def link(stream: PublishedShutter) -> str:
    return f"[{stream.kind}]({stream.source})"


def row(device: Device) -> str:
    depth, color = (f"{stream.text()}: {link(stream)}" for stream in (device.depth, device.color))
    return f"| `{device.name}` | {device.title} | {depth} | {'the same' if color == depth else color} |"


def test_the_documents_table_is_that_of_the_package() -> None:
    rows = [line for line in RECORDINGS.read_text().splitlines() if re.match(r"\| `[a-z0-9]+-", line)]
    assert rows == [row(device) for device in DEVICES]


def test_every_word_on_a_shutter_has_a_source_and_numbers_have_an_error() -> None:
    names = [device.name for device in DEVICES]
    assert len(set(names)) == len(names) >= 6 and names[:8] == sorted(names[:8])
    for stream in (stream for device in DEVICES for stream in (device.depth, device.color)):
        assert re.match(r"https://\S+$|notebook/calibration\.md#", stream.source)
        assert (stream.readout_s is None) == (stream.sigma_s is None)
        assert stream.kind
        if stream.readout_s is not None and stream.sigma_s is not None:
            assert 0.0 <= stream.readout_s < 0.05 and stream.sigma_s >= 1e-4
            assert (stream.readout_s == 0.0) == (stream.shutter == "global")


def test_what_was_not_found_begins_where_the_camera_file_does() -> None:
    known = device_named("RealSense-D435").known(FILE)
    assert known.values.depth_readout_s == 0.0 and known.values.color_readout_s == FILE.color_readout_s
    assert known.sigmas[0] == 1e-4 and np.isinf(known.sigmas[1:]).all()
    both = device_named("zed2-720p-30hz").known(FILE)
    assert both.values.depth_readout_s == both.values.color_readout_s == pytest.approx(0.018432)
    assert both.values.color_offset_s == FILE.color_offset_s


def test_an_unknown_device_is_refused_with_all_names(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^--device pinhole: choose one of azure-kinect, .*zed2-1080p-30hz$"):
        device_named("pinhole")
    assert main(["calibrate", str(tmp_path), "--device", "pinhole"]) == 2
    assert main(["track", str(tmp_path), "--device", "kinect-v1", "--out", str(tmp_path / "run")]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "choose one of" in first and "--device kinect-v1: is for --calibrate" in second


# --- σ ---------------------------------------------------------------------------------------------------------------


def solution(told_s: tuple[float, float], known_s: tuple[float, float], seed: int = 3) -> Solution:
    """Twelve windows that tell readouts to within σ `told_s` (s), 5 times as badly as their normal equations say."""
    rng = np.random.default_rng(seed)
    A = np.array([np.diag(25.0 / np.square(told_s) / 12.0)] * 12)
    b = 5.0 * rng.standard_normal((12, 2)) * np.sqrt(np.einsum("snn->sn", A))
    known = np.diag(np.array([*known_s, *(np.inf,) * (COUNT - 2)]) ** -2.0)
    return Solution(FILE, READOUTS, A, b - b.mean(axis=0), 0.0, 1e-3, 1e-2, known=known)


def test_nothing_known_changes_no_sigma_and_much_known_bounds_those_that_the_recording_leaves_open() -> None:
    told = 1e-4, 0.5
    free, held = solution(told, (np.inf, np.inf)).sigmas, solution(told, (np.inf, 1e-3)).sigmas
    # By what the scatter of twelve shows as a correlation of the two, which there is none of.
    assert held[0] == pytest.approx(free[0], rel=0.1) and free[0] == pytest.approx(1e-4, rel=0.5)
    assert free[1] > 0.1 and held[1] == pytest.approx(1e-3, rel=0.05)
    weak = solution(told, (0.1, np.inf)).sigmas
    assert weak[0] == pytest.approx(free[0], rel=1e-3)


def test_two_halves_of_what_is_known_make_a_sigma_smaller_by_the_root_of_two() -> None:
    several = [solution((1e-3, 1e-3), (1e-3, 1e-3), seed).sigmas[:2] for seed in range(40)]
    assert np.median(several) == pytest.approx(1e-3 / np.sqrt(2.0), rel=0.15)


def test_a_recording_contradicts_what_is_known_only_where_it_moves_a_value_further_than_it_may() -> None:
    sigmas = np.where(READOUTS, 1e-3, np.inf)
    known = Known(FILE, sigmas)
    after = np.full(COUNT, 1e-4)
    for off, contradicts in ((2e-3, False), (-4e-3, True)):
        found = replace(FILE, color_readout_s=FILE.color_readout_s + off)
        assert known.contradicted(found, after).tolist() == [False, contradicts, *(False,) * (COUNT - 2)]
    # A recording that hardly tells moves a value a little only, even from one that is far off.
    found = replace(FILE, color_readout_s=FILE.color_readout_s + 5e-4)
    assert known.contradicted(found, np.full(COUNT, 0.999e-3))[1] and not known.contradicted(found, after)[1]
    assert np.isinf(known.without(np.arange(COUNT) == 1).sigmas[1:]).all()


def test_what_became_of_the_devices_values_is_said() -> None:
    device = device_named("zed2-720p-30hz")
    before = device.known(FILE)
    used = before.without(np.arange(COUNT) == 0)
    first, *more = device_notes(device, before, used, np.where(np.arange(COUNT) == 1, 0.9e-3, 1e-4))
    assert first.startswith("device: Stereolabs ZED 2, 720p, 30 Hz: depth rolling, 18.4 ± 2.0 ms;")
    assert [note.partition(":")[0] for note in more] == ["depth readout", "colour readout"]
    assert "contradicts" in more[0] and "rather than by this recording" in more[1]
    assert len(device_notes(device, before, before, np.full(COUNT, 1e-5))) == 1
