"""What a tracking run leaves behind: poses at frame stamps, a spline, run.json; and other trackers' TUM files.

estimate = read_estimate(Path("runs/lr_kt2"))        # or Path("other_tracker.txt")
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_text, write_error
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_npz
from rsgen.sequence.format import pose_rows
from rsgen.sequence.trajectory import read_trajectory
from rstrack.data.moving_masks import MOVING, MovingMasks

TRAJECTORY = "trajectory.txt"
SPLINE = "spline.npz"
ONLINE_TRAJECTORY, ONLINE_SPLINE = "trajectory_online.txt", "spline_online.npz"
"""The track as it was found frame by frame, where the whole of it has been corrected since."""
INFO = "run.json"
SEGMENTS = "segments"
"""A TUM file of each segment of the track of which it is not known where it lies, by its number."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated poses, in a world frame of the tracker's own choice.

    stamps: (n,) seconds, strictly increasing. T_world_depth: (n, 4, 4). spline: T_world_depth(t), where the tracker has
    one. info: what run.json holds; `info["spline_valid"]`, a list of [t_begin, t_end] in seconds, restricts where the
    spline is an estimate (without it: everywhere). moving: pixels left out since they move by themselves, by the data
    set's frames. Raises UserError for anything that is not that.
    """

    stamps: FloatArray
    T_world_depth: FloatArray
    spline: Spline | None = None
    info: dict[str, Any] = field(default_factory=dict)
    moving: MovingMasks = field(default_factory=MovingMasks)

    def __post_init__(self) -> None:
        stamps, T = np.asarray(self.stamps, np.float64), np.asarray(self.T_world_depth, np.float64)
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "T_world_depth", T)
        if stamps.ndim != 1 or T.shape != (len(stamps), 4, 4):
            raise UserError(
                f"estimate: stamps {stamps.shape} and poses {T.shape}; give (n,) stamps and (n, 4, 4) poses"
            )
        _refuse(
            ~(np.isfinite(stamps) & np.isfinite(T).all(axis=(1, 2))),
            lambda i: "has a NaN or infinite value: leave frames that were not tracked out",
        )
        _refuse(
            np.diff(stamps, prepend=-np.inf) <= 0.0,
            lambda i: f"is stamped {stamps[i]:.9g} s, not after the {stamps[i - 1]:.9g} s before it: sort the poses",
        )
        _refuse(~se3.is_rigid(T), lambda i: "is not a rigid motion: pass the poses through se3.orthonormalise")
        _intervals(self.info)

    @property
    def untied(self) -> list[str]:
        """A line on segments of the track of which nobody knows where they lie; none where there are none."""
        apart = [s for s in self.info.get("segments") or [] if isinstance(s, dict) and s.get("tie") is None]
        poses = sum(int(s.get("poses", 0)) for s in apart)
        return [f"{poses} poses more in {SEGMENTS}/ are tied to nothing and not compared"] if apart else []

    def spline_covers(self, t: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether the spline is an estimate at times (...,) in seconds; nowhere if there is none."""
        t = np.asarray(t, np.float64)
        if self.spline is None:
            return np.zeros(t.shape, dtype=bool)
        inside = (t >= self.spline.t_begin) & (t <= self.spline.t_end)
        intervals = _intervals(self.info)
        if intervals is None:
            return np.asarray(inside)
        valid = np.zeros(t.shape, dtype=bool)
        for begin, end in intervals:
            valid |= (t >= begin) & (t <= end)
        return np.asarray(inside & valid)


def write_estimate(
    folder: Path, stamps: npt.ArrayLike, T_world_depth: npt.ArrayLike, spline: Spline | None, info: dict[str, Any],
    online: Estimate | None = None,
) -> None:  # fmt: skip
    """Write a run folder: trajectory.txt (TUM, nanometres and nanoseconds), spline.npz where there is one, run.json.

    Arguments as in `Estimate`. `info` may hold NumPy numbers and arrays; what is not finite becomes null. online: the
    track before it was corrected, for trajectory_online.txt and spline_online.npz. Each file is written whole or not at
    all, run.json last; files of an earlier run go first. Raises UserError.
    """
    estimate = Estimate(np.asarray(stamps, np.float64), np.asarray(T_world_depth, np.float64), spline, info)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (INFO, SPLINE, ONLINE_TRAJECTORY, ONLINE_SPLINE, MOVING):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise write_error(folder, error) from None
    _write_run(folder, estimate, TRAJECTORY, SPLINE)
    if online is not None:
        _write_run(folder, online, ONLINE_TRAJECTORY, ONLINE_SPLINE)
    write_info(folder, info)


def write_info(folder: Path, info: dict[str, Any]) -> None:
    """A run folder's run.json; what is not finite becomes null. Raises UserError.

    A line for each entry, and for each item of a list such as that of frames: json's own indentation is slow.
    """
    entries = [f" {json.dumps(name)}: {_entry(value)}" for name, value in plain(info).items()]
    atomic_write(folder / INFO, ("{\n" + ",\n".join(entries) + "\n}\n").encode())


def _entry(value: Any) -> str:
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return "[\n  " + ",\n  ".join(json.dumps(item, allow_nan=False) for item in value) + "\n ]"
    return json.dumps(value, allow_nan=False)


def write_poses(file: Path, stamps: FloatArray, T_world_depth: FloatArray, name: str = "T_world_depth") -> None:
    """Poses (n, 4, 4) at stamps (n,) as a TUM file, nanometres and nanoseconds; name: of what. Raises UserError."""
    lines = [f"# {name}", "# stamp tx ty tz qx qy qz qw"]
    for stamp, row in zip(stamps, pose_rows(T_world_depth), strict=True):
        lines.append(f"{stamp:.9f} {row[0]:.9f} {row[1]:.9f} {row[2]:.9f} " + " ".join(f"{q:.12f}" for q in row[3:]))
    atomic_write(file, ("\n".join(lines) + "\n").encode())


def _write_run(folder: Path, estimate: Estimate, trajectory: str, spline_name: str) -> None:
    write_poses(folder / trajectory, estimate.stamps, estimate.T_world_depth)
    spline = estimate.spline
    if spline is not None:
        arrays = {"control_points": spline.control_points, "t0": np.array(spline.t0), "dt": np.array(spline.dt)}
        atomic_write(folder / spline_name, encode_npz(arrays))


def read_estimate(path: Path) -> Estimate:
    """Read a run folder, or a TUM file 'stamp tx ty tz qx qy qz qw' of any tracker.

    Stamps are kept as they are; gaps, where the track was lost, are fine. At least `MIN_POSES` poses.
    Raises UserError naming the file and the line: missing, malformed, not sorted by time, a stamp twice.
    """
    path = Path(path)
    is_folder = path.is_dir()
    if is_folder and not (path / TRAJECTORY).is_file():
        raise UserError(f"{path}: has no {TRAJECTORY}: give a folder that 'rstrack track' wrote, or a TUM file")
    file = path / TRAJECTORY if is_folder else path
    poses = read_trajectory(file, format="tum", max_gap_s=math.inf)
    spline = Spline.load(path / SPLINE) if is_folder and (path / SPLINE).exists() else None
    info = read_info(path / INFO) if is_folder and (path / INFO).exists() else {}
    moving = MovingMasks.read(path) if is_folder else MovingMasks()
    try:
        return Estimate(poses.stamps, poses.T_world_cam, spline, info, moving)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def read_info(path: Path) -> dict[str, Any]:
    """What a run.json holds. Raises UserError."""
    try:
        info = json.loads(read_text(path))
    except (ValueError, RecursionError):
        raise UserError(f"{path}: is not valid JSON: run the tracker again") from None
    if not isinstance(info, dict):
        raise UserError(f"{path}: expected a JSON object: run the tracker again")
    return info


def plain(value: Any) -> Any:
    """The same data for JSON: NumPy numbers and arrays as Python's, tuples as lists, NaN and infinity as None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        known = value.dtype.kind in "bi" or (value.dtype.kind == "f" and np.isfinite(value).all())
        return value.tolist() if known else plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def _refuse(bad: npt.NDArray[np.bool_], complaint: Any) -> None:
    if bad.any():
        i = int(np.argmax(bad))
        raise UserError(f"estimate: pose {i} {complaint(i)}")


def _intervals(info: dict[str, Any]) -> FloatArray | None:
    """(k, 2) seconds of info["spline_valid"], None if absent. Raises UserError."""
    if info.get("spline_valid") is None:
        return None
    try:
        intervals = np.array(info["spline_valid"], np.float64).reshape(-1, 2)
    except (TypeError, ValueError):
        intervals = np.full((1, 2), np.nan)
    if not (intervals[:, 0] <= intervals[:, 1]).all():
        raise UserError(f"estimate: spline_valid in {INFO} must be a list of [t_begin, t_end] in seconds")
    return intervals
