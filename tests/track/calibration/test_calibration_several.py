"""One camera from several recordings: what each tells, clocks of their own, and what does not belong together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.calibration.parameters import COUNT, NAMES, Parameters
from rstrack.calibration.result import CameraCalibration
from rstrack.calibration.several import check_alike, together
from rstrack.calibration.solve import Solution
from rstrack.data.rig import DepthError

START = Parameters(0.03, 0.03, 0.0, 0.0, np.eye(4))
AT = [NAMES.index(name) for name in ("color.readout_s", "color.offset_s", "color.fx", "color.cx")]
READOUT, OFFSET, FX, CX = AT


@dataclass(frozen=True)
class Recorded:
    """What a dataset has of its camera here."""

    name: str
    rig: Any
    depth_error: DepthError

    def with_depth_pattern(self, pattern: tuple[float, ...]) -> Recorded:
        return replace(self, depth_error=DepthError(pattern=pattern))


def calibrated(
    name: str, true: np.ndarray, own: np.ndarray, sure: np.ndarray, rng: np.random.Generator,
    pattern: tuple[float, ...] | None = None, note: str = "estimated from it",
) -> CameraCalibration:  # fmt: skip
    """A recording whose eight windows bear out `true` (31,), though it has ended at `own`; note: on its pattern."""
    free = np.isin(np.arange(COUNT), AT)
    root = rng.standard_normal((8, 4, 4)) * sure[:, None]
    A = root @ root.swapaxes(1, 2)
    b = A @ (own - true)[free] + 0.01 * (A @ rng.standard_normal((8, 4, 1)))[..., 0] * 1e-3
    solution = Solution(START.moved(own), free, A, b, 0.0, 1e-3, 1e-2)
    shutter = SimpleNamespace(scan="top-bottom")
    dataset: Any = Recorded(name, SimpleNamespace(color_shutter=shutter), DepthError(pattern=pattern))
    unused: Any = None
    parts = (range(30),)
    return CameraCalibration(dataset, START, solution, free, parts, unused, 1.0, unused, unused, pattern_note=note)


def test_recordings_tell_what_the_others_do_not_and_keep_their_clocks() -> None:
    rng, camera = np.random.default_rng(4), np.zeros(COUNT)
    camera[[READOUT, FX, CX]] = -0.004, 0.02, -0.03
    clocks, found = (0.018, 0.025), []
    for k, sure in enumerate((np.array([1e3, 1e3, 1e2, 1e-3]), np.array([1e3, 1e3, 1e-3, 1e2]))):
        true = camera.copy()
        true[OFFSET] = clocks[k]
        own = true.copy()
        own[(CX, FX)[k]] = 0.0  # what this one does not tell is where it was
        found.append(calibrated(f"recording{k}", true, own, sure, rng, (0.01 * k, 0.02)))
    made = together(found)
    assert made.values.since(START)[[READOUT, FX, CX]] == pytest.approx(camera[[READOUT, FX, CX]], abs=2e-4)
    alone = found[0].solution.sigmas
    assert made.solution.sigmas[CX] < 0.01 * alone[CX] and made.solution.sigmas[READOUT] < alone[READOUT]
    assert made.dataset.depth_error.pattern == (0.005, 0.02) and "mean of those of 2" in made.pattern_note
    assert not made.solution.free[OFFSET] and not made.asked[OFFSET] and len(made.parts) == 2
    for name, offset in zip(("recording0", "recording1"), clocks, strict=True):
        assert made.clocks[name] == (pytest.approx(offset, abs=2e-4), 0.0)


def test_a_pattern_that_the_camera_file_states_is_not_said_to_be_a_mean() -> None:
    rng, none, sure = np.random.default_rng(5), np.zeros(COUNT), np.full(4, 1e3)
    made = together([calibrated(f"recording{k}", none, none, sure, rng, (0.01, 0.02), note="") for k in range(2)])
    assert made.dataset.depth_error.pattern == (0.01, 0.02) and not made.pattern_note


def test_recordings_of_different_cameras_or_of_one_name_are_refused() -> None:
    def recording(name: str, fx: float) -> Any:
        camera = Camera(64, 48, fx, 50.0, 31.5, 23.5)
        rig = SimpleNamespace(color_camera=camera, depth_camera=camera, T_color_depth=np.eye(4))
        return SimpleNamespace(name=name, root=Path(name), rig=rig)

    check_alike([recording("a", 50.0), recording("b", 50.0)])
    with pytest.raises(UserError, match=r"^b: has other cameras than a: give one --camera"):
        check_alike([recording("a", 50.0), recording("b", 51.0)])
    one = calibrated("one", np.zeros(COUNT), np.zeros(COUNT), np.full(4, 1e3), np.random.default_rng(1))
    rig = SimpleNamespace(color_shutter=SimpleNamespace(scan="left-right"))
    with pytest.raises(UserError, match=r"^left-right and top-bottom were found"):
        together([one, replace(one, dataset=SimpleNamespace(name="two", rig=rig))])  # type: ignore[arg-type]
    with pytest.raises(UserError, match="of one name"):
        check_alike([recording("a", 50.0), recording("a", 50.0)])


def test_a_clock_moves_as_the_camera_that_all_have_found_wants_it() -> None:
    rng, true = np.random.default_rng(5), np.zeros(COUNT)
    true[OFFSET] = 0.018
    weak = calibrated("weak", true, true, np.full(4, 1e2), rng)
    A = weak.solution.A.sum(axis=0)
    off = np.zeros(COUNT)
    off[READOUT] = 0.02
    off[OFFSET] = -A[1, 0] / A[1, 1] * off[READOUT]  # the best clock for a readout that is wrong
    assert abs(off[OFFSET]) > 1e-4
    wrong = replace(weak, solution=replace(weak.solution, values=START.moved(true + off), b=weak.solution.A @ off[AT]))
    made = together([wrong, calibrated("sure", true, true, np.full(4, 1e5), rng)])
    assert made.values.since(START)[READOUT] == pytest.approx(0.0, abs=2e-5)
    assert made.clocks["weak"][0] == pytest.approx(true[OFFSET], abs=2e-5)
