"""In which order the unknowns of a recording are found on the finest level: what colour shows first, then the rest.

A depth camera is off by the same amount over whole regions of its image, in every image. That bends all poses that
depth has a say in, and a lens bends with them: by 2 % of the focal length on a rendering of a Kinect. So where depth is
not exact colour alone finds the poses and the lens first. How far depth contradicts these poses shows how many of its
pixels count, and with so many the lens is found again. Clocks, which errors that stay where they are do not resemble,
are then found with all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import BoolArray
from rsgen.console.progress import Progress
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.window import RecordingWindow
from rstrack.calibration.parameters import BY_COLOR, COLOR_LENS, COUNT, DRIFT, LENSES, Known, Parameters
from rstrack.calibration.solve import Solution, Watch, joined, solve

# Levels of the pyramid.
_FINE = (0,)
# Part of the largest σ, over what is of use, from which on parameters are held together.
_DRAGS = 0.5
# Of a lens that is no better than the file's to be taken for one, the level of the tracker's tests.
_CHANCE = 1e-3
# For the progress bar.
_ABOUT_STEPS = 10
_NONE = np.zeros(COUNT, bool)
# Part of depth's pixels that counts where colour is to find the poses: it holds what no colour shows.
_HARDLY = 1e-3
# Steps that show what depth counts for.
_FEW_STEPS = 4


@dataclass(frozen=True)
class StageResult:
    """What is found so far. drifts: colour's clock may drift; keeps_file_lens: another explains no more than that."""

    windows: Sequence[RecordingWindow]
    solution: Solution
    drifts: bool
    keeps_file_lens: bool


def in_stages(
    windows: Sequence[RecordingWindow], terms_of: Callable[[BoolArray], PairTerms], known: Known, p: Parameters,
    free: BoolArray, is_exact: bool, progress: Progress,
) -> StageResult:  # fmt: skip
    """From values `p` on, with all that may change (31,).

    terms_of: kernels with columns for so many of the unknowns. is_exact: depth is, and all is found at once.
    """
    terms = terms_of(free)
    if is_exact or not free[COLOR_LENS].any():
        solution, drifts = _solved(windows, terms, known, p, free, _NONE, progress)
        if not solution.finished or not solution.free[LENSES].any():
            return StageResult(windows, solution, drifts, False)
        windows, solution, keeps_file_lens = _paid(windows, terms, known, solution, _NONE, progress)
        return StageResult(windows, solution, drifts, keeps_file_lens)
    watch = progress_watch(progress, 0.3)
    lens = solve(windows, terms, p, free & BY_COLOR, _FINE, watch, known, _FEW_STEPS, _HARDLY)
    counts = 1.0 / max(1.0, lens.depth_overcounts)
    if lens.finished:
        lens, _ = _solved(windows, terms, known, lens.values, free & BY_COLOR, ~BY_COLOR, progress, counts)
    windows, lens, keeps_file_lens = _paid(windows, terms, known, lens, ~LENSES, progress, counts)
    if not lens.finished:
        return StageResult(windows, lens, True, keeps_file_lens)
    held, rest = (_NONE, free & ~LENSES) if keeps_file_lens else (lens.free, free & ~BY_COLOR)
    solution, drifts = _solved(windows, terms_of(rest), known, lens.values, rest, held, progress)
    return StageResult(windows, solution if keeps_file_lens else joined(lens, solution), drifts, keeps_file_lens)


def progress_watch(progress: Progress, begin: float) -> Watch:
    """Tells a progress bar, from a part of it on, of every step."""
    done = 0

    def watch(_level: int, _step: int, p: Parameters) -> None:
        nonlocal done
        done += 1
        note = f"readouts {1e3 * p.depth_readout_s:.2f} and {1e3 * p.color_readout_s:.2f} ms"
        progress("calibrating", min(0.95, begin + 0.4 * done / _ABOUT_STEPS), note)

    return watch


# ---------------------------------------------------------------------------------------------------------------------


def _solved(
    windows: Sequence[RecordingWindow], terms: PairTerms, known: Known, p: Parameters, free: BoolArray,
    held: BoolArray, progress: Progress, depth_counts: float = 1.0,
) -> tuple[Solution, bool]:  # fmt: skip
    """With all that may change, those `held` (31,) at `p`, then without what the recording does not determine.

    And whether colour's clock may drift: one that is within its error of the file's is held there, since it would take
    colour away at both ends of the recording.
    """
    file, drifts, watch = known.values, True, progress_watch(progress, 0.5)
    while True:
        start = file.moved(np.where(free | held, p.since(file), 0.0))
        solution = solve(windows, terms, start, free, _FINE, watch, known, depth_counts=depth_counts)
        unsure, p = solution.unsure, solution.values
        if not solution.finished:
            return solution, drifts
        if free[DRIFT] and abs(p.color_drift - file.color_drift) < 2.0 * solution.sigmas[DRIFT]:
            drifts, free = False, free & (np.arange(COUNT) != DRIFT)
        elif unsure.max() > 1.0:
            # The least determined biases the others, which may be determined once it is held.
            free = free & (unsure <= max(1.0, _DRAGS * unsure.max()))
        else:
            return solution, drifts


def _paid(
    windows: Sequence[RecordingWindow], terms: PairTerms, known: Known, solution: Solution, held: BoolArray,
    progress: Progress, depth_counts: float = 1.0,
) -> tuple[Sequence[RecordingWindow], Solution, bool]:  # fmt: skip
    """The solution with the lens that was found, or that with the file's where another is not significant, and which.

    It is significant if chance makes the images so much more likely in one of a thousand recordings at most. How likely
    the file's lens makes them is found out unless it is plain. held (31,): what stays as it is beside the lens.
    """
    plainly = solution.chance(solution.gain_over(known.values, LENSES), LENSES) < _CHANCE**2
    if plainly or not solution.finished:
        return windows, solution, False
    without = solution.free & ~LENSES
    plain = [replace(each, brightness=each.brightness.copy()) for each in windows]
    start = known.values.moved(np.where(without | held, solution.values.since(known.values), 0.0))
    watch = progress_watch(progress, 0.8)
    other = solve(plain, terms, start, without, _FINE, watch, known, depth_counts=depth_counts)
    gain = (other.cost - solution.cost) * solution.pixels
    if not other.finished or solution.chance(gain, LENSES) < _CHANCE:
        return windows, replace(solution, finished=other.finished), False
    return plain, other, True
