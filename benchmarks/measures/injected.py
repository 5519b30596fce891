"""Faults injected into a recording: jumps, blackouts, covered, frozen and shuffled images, things that pass.

fault = random_fault(dataset, seed=17)
track(fault.dataset, options, out)         # frames fault.first to fault.last - 1 were touched

All are pure functions of dataset and seed. The truth of a frame is where its depth image was really taken, whatever is
shown in it: `Dataset.truth_poses` has it at every stamp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from benchmarks.measures.passing import passed_by
from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import so3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.trajectory import Trajectory
from rstrack.bench.changes import reordered, with_color, with_depth
from rstrack.data.dataset import Dataset
from rstrack.metrics.association import true_poses, truth_of

# Frames before the fault, for the tracker to begin with, and after it, to be found again.
_BEFORE, _AFTER = 12, 12
_MOST_FRAMES = 60
Make = Callable[[Dataset, int, int, np.random.Generator], Dataset]
# Inverse depths that interpolation mixes belong to one surface if they differ by less than this part.
_ONE_SURFACE = 0.03


@dataclass(frozen=True)
class InjectedFault:
    """A recording with something done to it.

    kind: of `KINDS`. first, last: frames [first, last) of `dataset` were touched; where frames are missing, first is
    the one after the jump and last = first + 1.
    """

    kind: str
    dataset: Dataset
    first: int
    last: int


def kidnapped(dataset: Dataset, first: int, count: int) -> Dataset:
    """Frames [first, first + count) are cut out, and those after them follow without a gap in time."""
    _check(dataset, first, count + 1)
    shown = [*range(first), *range(first + count, len(dataset))]
    return reordered(dataset, shown, dataset.stamps[: len(shown)])


def blacked_out(dataset: Dataset, first: int, count: int) -> Dataset:
    """Black colour and no depth in frames [first, first + count)."""
    return covered(_with_colors(dataset, first, count, np.zeros_like), first, count)


def covered(dataset: Dataset, first: int, count: int) -> Dataset:
    """No depth in frames [first, first + count), colour as it was."""
    _check(dataset, first, count)
    return with_depth(dataset, lambda k, z: np.zeros_like(z) if first <= k < first + count else z)


def frozen(dataset: Dataset, first: int, count: int) -> Dataset:
    """Frames [first, first + count) show what frame first - 1 shows; after them the recording is where time is."""
    _check(dataset, first, count)
    shown = np.arange(len(dataset))
    shown[first : first + count] = first - 1
    return reordered(dataset, shown.tolist(), dataset.stamps)


def shuffled(dataset: Dataset, first: int, count: int, seed: int) -> Dataset:
    """Frames [first, first + count), two at least, in another order, under stamps that go on."""
    _check(dataset, first, count)
    shown = np.arange(len(dataset))
    order = np.random.default_rng(seed).permutation(count)
    if (order == np.arange(count)).all():
        order = order[::-1]
    shown[first : first + count] = first + order
    return reordered(dataset, shown.tolist(), dataset.stamps)


def mismatched(dataset: Dataset, first: int, count: int, shift: int) -> Dataset:
    """Colour of `shift` frames later (or earlier, below zero) than depth in frames [first, first + count)."""
    _check(dataset, first, count)
    colors = np.arange(len(dataset))
    colors[first : first + count] = np.clip(colors[first : first + count] + shift, 0, len(dataset) - 1)
    return reordered(dataset, range(len(dataset)), dataset.stamps, colors.tolist())


def sped_up(dataset: Dataset, first: int, count: int, factor: int = 4) -> Dataset:
    """Motion `factor` times as fast from frame first: of count · factor frames one in `factor` stays, time goes on.

    Within an image lines keep the times they had: only between images the motion is faster.
    """
    _check(dataset, first, count * factor)
    shown = [*range(first), *range(first, first + count * factor, factor), *range(first + count * factor, len(dataset))]
    return reordered(dataset, shown, dataset.stamps[: len(shown)])


def bare_wall(dataset: Dataset, first: int, count: int) -> Dataset:
    """A wall in front of the camera in frames [first, first + count): one depth and one colour, their medians."""
    _check(dataset, first, count)

    def flat(k: int, z: Float32Array) -> Float32Array:
        if not (first <= k < first + count and (z > 0).any()):
            return z
        return np.where(z > 0, np.float32(np.median(z[z > 0])), np.float32(0))

    def plain(pixels: ByteArray) -> ByteArray:
        return np.broadcast_to(np.median(pixels, axis=(0, 1)).astype(np.uint8), pixels.shape).copy()

    return with_depth(_with_colors(dataset, first, count, plain), flat)


def shaken(dataset: Dataset, first: int, count: int, seed: int) -> Dataset:
    """Vibration at 12 to 40 Hz by 0.05 to 0.5 degrees about any axis in frames [first, first + count)."""
    _check(dataset, first, count)
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    swing = np.radians(rng.uniform(0.05, 0.5)) * axis / np.linalg.norm(axis)
    return vibrating(dataset, first, count, swing, float(rng.uniform(12.0, 40.0)))


def random_fault(dataset: Dataset, seed: int, kind: str | None = None) -> InjectedFault:
    """A fault of a random kind (or a given one of `KINDS`), place, length and strength, by its seed alone.

    The first 12 frames and the last 12 stay as they are. Raises UserError: a recording that is too short, no such kind.
    """
    rng = np.random.default_rng([seed, 9])
    kind = kind or str(rng.choice(list(KINDS)))
    if kind not in KINDS:
        raise UserError(f"unknown fault '{kind}': choose {', '.join(KINDS)}")
    room = len(dataset) - _BEFORE - _AFTER
    factor = 4 if kind == "sped up" else 1
    most = min(_MOST_FRAMES, room // factor)
    least = 2 if kind == "shuffled" else 1
    if most < least:
        raise UserError(f"{dataset.name}: {len(dataset)} frames are too few for '{kind}'")
    count = int(rng.integers(least, most + 1))
    first = _BEFORE + int(rng.integers(0, room - factor * count + 1))
    touched = 1 if kind == "kidnapped" else count
    return InjectedFault(kind, KINDS[kind](dataset, first, count, rng), first, first + touched)


def _mismatched(dataset: Dataset, first: int, count: int, rng: np.random.Generator) -> Dataset:
    """By 10 to 60 frames, to the side that has more of them."""
    shift = int(rng.integers(10, _MOST_FRAMES + 1))
    return mismatched(dataset, first, count, shift if first < len(dataset) // 2 else -shift)


KINDS: dict[str, Make] = {
    "kidnapped": lambda d, first, count, _: kidnapped(d, first, count),
    "blacked out": lambda d, first, count, _: blacked_out(d, first, count),
    "covered": lambda d, first, count, _: covered(d, first, count),
    "frozen": lambda d, first, count, _: frozen(d, first, count),
    "shuffled": lambda d, first, count, rng: shuffled(d, first, count, int(rng.integers(2**31))),
    "mismatched": _mismatched,
    "sped up": lambda d, first, count, _: sped_up(d, first, count),
    "shaken": lambda d, first, count, rng: shaken(d, first, count, int(rng.integers(2**31))),
    "bare wall": lambda d, first, count, _: bare_wall(d, first, count),
    "passed by": lambda d, first, count, rng: passed_by(d, first, count, int(rng.integers(2**31))),
}
"""Kinds of faults, made of a dataset, a first frame, a number of frames and a generator for what else is random."""


# ---------------------------------------------------------------------------------------------------------------------


def _check(dataset: Dataset, first: int, count: int) -> None:
    if not (first > 0 and count > 0 and first + count <= len(dataset)):
        raise UserError(
            f"{dataset.name}: frames {first} to {first + count - 1} cannot be touched: it has frames 0 to "
            f"{len(dataset) - 1}, and the first stays"
        )


def _with_colors(dataset: Dataset, first: int, count: int, change: Callable[[ByteArray], ByteArray]) -> Dataset:
    """With the colour images of frames [first, first + count) changed."""
    _check(dataset, first, count)
    touched = frozenset(i for group in dataset.groups[first : first + count] for i in group)
    return with_color(dataset, lambda i, pixels: change(pixels) if i in touched else pixels)


def vibrating(dataset: Dataset, first: int, count: int, swing: FloatArray, hertz: float) -> Dataset:
    """Frames [first, first + count) of a depth camera that turns by swing · sin(2π · hertz · (t − t_first)).

    swing (3,): rotation vector in the depth camera's frame, rad; 1/hertz may be shorter than a readout. Either camera
    turns about its own centre (a turn by half a degree moves one 5 cm beside the other by 0.4 mm, which is left out),
    and the little that the recording's own motion changes while a line passes the few pixels of the swing is too.
    """
    rig, begin = dataset.rig, float(dataset.stamps[first])
    touched = frozenset(i for group in dataset.groups[first : first + count] for i in group)
    R_color_depth = rig.T_color_depth[:3, :3]

    def angles(t: FloatArray) -> FloatArray:
        return np.asarray(np.sin(2.0 * np.pi * hertz * (t - begin))[..., None] * swing)

    def turned_depth(k: int, z: Float32Array) -> Float32Array:
        if not first <= k < first + count:
            return z
        R = so3.exp(angles(_pixel_times(rig.depth_camera, rig.depth_shutter, dataset.stamps[k])))
        return _turned_depth(rig.depth_camera, R, z)

    def turned_color(k: int, pixels: ByteArray) -> ByteArray:
        if k not in touched:
            return pixels
        at = angles(_pixel_times(rig.color_camera, rig.color_shutter, dataset.color_stamps[k])) @ R_color_depth.T
        x, y, _ = _source(rig.color_camera, so3.exp(at))
        return np.asarray(cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    made = with_color(with_depth(dataset, turned_depth), turned_color)
    truth = truth_of(dataset)
    if truth is None:
        return made
    index, T = true_poses(truth.motion, dataset.stamps, interpolate=True)
    T, inside = T.copy(), (index >= first) & (index < first + count)
    T[inside, :3, :3] = T[inside, :3, :3] @ so3.exp(angles(dataset.stamps[index[inside]]))
    return replace(made, truth=None, truth_poses=Trajectory(dataset.stamps[index], T), sequence=None)


# ---------------------------------------------------------------------------------------------------------------------


def _pixel_times(camera: Camera, shutter: Shutter, stamp: float) -> FloatArray:
    """Mid-exposures (h, w) of an image's pixels, s."""
    return shutter.line_mid_time(stamp, shutter.line_of_pixel(camera.pixel_grid(), camera), camera)


def _source(camera: Camera, R_still_turned: FloatArray) -> tuple[Float32Array, Float32Array, FloatArray]:
    """Pixels x, y (h, w) of the camera at rest that those of the turned one show, and their directions (h, w, 3)."""
    d = np.einsum("...ij,...j->...i", R_still_turned, camera.unproject(camera.pixel_grid()))
    uv, _ = camera.project(d)
    uv = np.nan_to_num(uv, nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1]), d


def _turned_depth(camera: Camera, R_still_turned: FloatArray, z: Float32Array) -> Float32Array:
    """Depth (h, w) as the turned camera sees it: inverse depth is interpolated, which is exact on planes."""
    x, y, d = _source(camera, R_still_turned)
    rho = np.divide(np.float32(1.0), z, out=np.zeros_like(z), where=z > 0)
    smooth, near = (
        np.asarray(cv2.remap(rho, x, y, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0))
        for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST)
    )
    rho = np.where(np.abs(smooth - near) < _ONE_SURFACE * near, smooth, near)
    # A ray of the turned camera, (x, y, 1) times its z, is d times that: the point's z before is z · d_z.
    return np.divide(1.0, rho * d[..., 2], out=np.zeros(z.shape), where=rho > 0).astype(np.float32)
