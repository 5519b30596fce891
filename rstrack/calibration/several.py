"""One camera from several recordings of it.

found = together([calibrate(open_dataset(path, file)) for path in recordings])
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rstrack.calibration.parameters import COUNT, DRIFT, NAMES
from rstrack.calibration.result import CameraCalibration
from rstrack.calibration.solve import Solution, posterior
from rstrack.data.dataset import Dataset

# Colour's clock: each recording's own.
_CLOCK = np.isin(np.arange(COUNT), [NAMES.index("color.offset_s"), DRIFT])
# Times that the scatter of the windows is taken anew.
_ROUNDS = 3


def check_alike(datasets: Sequence[Dataset]) -> None:
    """Raises UserError: recordings whose cameras begin otherwise, or whose folders have one name."""
    first = datasets[0]
    for other in datasets[1:]:
        a, b = first.rig, other.rig
        cameras = (a.color_camera, a.depth_camera) == (b.color_camera, b.depth_camera)
        if not (cameras and np.array_equal(a.T_color_depth, b.T_color_depth)):
            raise UserError(f"{other.root}: has other cameras than {first.root}: give one --camera for all of them")
    names = [dataset.name for dataset in datasets]
    if len(set(names)) < len(names):
        raise UserError(f"{', '.join(names)}: recordings of one name, by which their clocks are named: rename them")


def together(found: Sequence[CameraCalibration]) -> CameraCalibration:
    """One camera from several recordings, each calibrated by itself from the same camera file.

    Their windows' normal equations stand side by side, each recording's clock eliminated, and are solved once more,
    with the same prior: what one recording does not determine another may. Recordings have clocks of their own still,
    at the camera that all have found. Raises UserError: it was read by rows here and by columns there.
    """
    first = found[0]
    scans = {each.dataset.rig.color_shutter.scan for each in found}
    if len(scans) > 1:
        raise UserError(f"{' and '.join(sorted(scans))} were found in different recordings: write 'scan' in the file")
    free = np.logical_or.reduce([each.solution.free for each in found]) & ~_CLOCK
    at, origin = first.values, first.start
    reduced = [_without_clock(each.solution) for each in found]
    known = first.solution.known[np.ix_(free, free)]
    A = np.concatenate([A_r[:, free][:, :, free] for A_r, _, _ in reduced])
    for _ in range(_ROUNDS):
        b = np.concatenate([
            b_r[:, free] + (A_r @ _camera(at.since(each.values)))[:, free]
            for each, (A_r, b_r, _) in zip(found, reduced, strict=True)
        ])  # fmt: skip
        C, gain, _ = posterior(A, b, known)
        step = np.zeros(COUNT)
        step[free] = -C @ (gain @ b.sum(axis=0) + known @ at.since(origin)[free])
        at = at.moved(step)
    blind = np.sqrt(np.mean([each.solution.blind**2 for each in found], axis=0))
    solution = replace(first.solution, values=at, free=free, A=A, b=b, blind=blind, last_step=np.zeros(COUNT))
    clocks = {
        each.dataset.name: _clock(each, _camera(at.since(each.values)), K)
        for each, (_, _, K) in zip(found, reduced, strict=True)
    }
    asked = np.logical_or.reduce([each.asked for each in found]) & ~_CLOCK
    estimated = [each.dataset.depth_error.pattern for each in found if each.pattern_note]
    patterns = [pattern for pattern in estimated if pattern]
    dataset, pattern_note = first.dataset, ""
    if patterns:
        dataset = dataset.with_depth_pattern(tuple(float(x) for x in np.mean(patterns, axis=0)))
        pattern_note = f"fixed pattern of depth's error: the mean of those of {len(patterns)} recordings"
    return replace(
        first, dataset=dataset, pattern_note=pattern_note, solution=solution, asked=asked,
        parts=tuple(part for each in found for part in each.parts), clocks=clocks,
        seconds=sum(each.seconds for each in found),
        keeps_file_lens=all(each.keeps_file_lens for each in found),
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------------


def _camera(step: FloatArray) -> FloatArray:
    return np.where(_CLOCK, 0.0, step)


def _without_clock(solution: Solution) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A (s, 31, 31) and b (s, 31) of the windows with the recording's clock where it is best for any camera, and K
    (2, 31): by how much the clock then moves, −K x, with the camera."""
    of = solution.free
    A, b = np.zeros((len(solution.b), COUNT, COUNT)), np.zeros((len(solution.b), COUNT))
    A[:, np.outer(of, of)], b[:, of] = solution.A.reshape(len(A), -1), solution.b
    total = A.sum(axis=0)
    K = np.linalg.pinv(total[np.ix_(_CLOCK, _CLOCK)], hermitian=True) @ total[_CLOCK]
    project = np.eye(COUNT)
    project[_CLOCK] = 0.0
    project[:, _CLOCK] -= np.where(_CLOCK[:, None], 0.0, K.T)
    return project @ A @ project.T, b @ project.T, K


def _clock(found: CameraCalibration, moved: FloatArray, K: FloatArray) -> tuple[float, float]:
    """Offset (s) and drift of a recording's colour for a camera that has moved by so much (31,) from its own."""
    step = np.zeros(COUNT)
    step[_CLOCK] = -K @ moved
    step[_CLOCK & ~found.solution.free] = 0.0
    p = found.values.moved(step)
    return p.color_offset_s, p.color_drift
