"""One camera from several recordings: what each tells, clocks of their own, and what does not belong together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.calibration.findings.result import Calibration
from rstrack.calibration.several import check_alike, together
from rstrack.calibration.solve import Solution
from rstrack.calibration.unknowns.parameters import COUNT, NAMES, Parameters

START = Parameters(0.03, 0.03, 0.0, 0.0, np.eye(4))
AT = [NAMES.index(name) for name in ("color.readout_s", "color.offset_s", "color.fx", "color.cx")]
READOUT, OFFSET, FX, CX = AT


def calibrated(name: str, true: np.ndarray, own: np.ndarray, sure: np.ndarray, rng: np.random.Generator) -> Calibration:
    """A recording whose eight stretches bear out `true` (29,), though it has ended at `own`."""
    free = np.isin(np.arange(COUNT), AT)
    root = rng.standard_normal((8, 4, 4)) * sure[:, None]
    A = root @ root.swapaxes(1, 2)
    b = A @ (own - true)[free] + 0.01 * (A @ rng.standard_normal((8, 4, 1)))[..., 0] * 1e-3
    solution = Solution(START.moved(own), free, A, b, 0.0, 1e-3, 1e-2)
    dataset: Any = SimpleNamespace(name=name)
    unused: Any = None
    return Calibration(dataset, START, solution, free, (range(30),), unused, 1.0, unused, unused)


def test_recordings_tell_what_the_others_do_not_and_keep_their_clocks() -> None:
    rng, camera = np.random.default_rng(4), np.zeros(COUNT)
    camera[[READOUT, FX, CX]] = -0.004, 0.02, -0.03
    clocks, found = (0.018, 0.025), []
    for k, sure in enumerate((np.array([1e3, 1e3, 1e2, 1e-3]), np.array([1e3, 1e3, 1e-3, 1e2]))):
        true = camera.copy()
        true[OFFSET] = clocks[k]
        own = true.copy()
        own[(CX, FX)[k]] = 0.0  # what this one does not tell is where it was
        found.append(calibrated(f"recording{k}", true, own, sure, rng))
    made = together(found)
    assert made.values.since(START)[[READOUT, FX, CX]] == pytest.approx(camera[[READOUT, FX, CX]], abs=2e-4)
    alone = found[0].solution.sigmas
    assert made.solution.sigmas[CX] < 0.01 * alone[CX] and made.solution.sigmas[READOUT] < alone[READOUT]
    assert not made.solution.free[OFFSET] and not made.asked[OFFSET] and len(made.parts) == 2
    for name, offset in zip(("recording0", "recording1"), clocks, strict=True):
        assert made.clocks[name] == (pytest.approx(offset, abs=2e-4), 0.0)


def test_recordings_of_different_cameras_or_of_one_name_are_refused() -> None:
    def recording(name: str, fx: float) -> Any:
        camera = Camera(64, 48, fx, 50.0, 31.5, 23.5)
        rig = SimpleNamespace(color_camera=camera, depth_camera=camera, T_color_depth=np.eye(4))
        return SimpleNamespace(name=name, root=Path(name), rig=rig)

    check_alike([recording("a", 50.0), recording("b", 50.0)])
    with pytest.raises(UserError, match=r"^b: has other cameras than a: give one --camera"):
        check_alike([recording("a", 50.0), recording("b", 51.0)])
    with pytest.raises(UserError, match="of one name"):
        check_alike([recording("a", 50.0), recording("a", 50.0)])


def test_what_moves_with_the_camera_is_the_clock_too() -> None:
    rng, zero = np.random.default_rng(5), np.zeros(COUNT)
    sure = np.full(4, 1e3)
    one = calibrated("one", zero, zero, sure, rng)
    made = together([one, replace(one, dataset=SimpleNamespace(name="two"))])  # type: ignore[arg-type]
    assert made.clocks["one"] == pytest.approx(made.clocks["two"]) and made.clocks["one"][0] == pytest.approx(
        0, abs=1e-4
    )
