"""Trajectories as lists of stamped poses: reading TUM, ICL-NUIM and EuRoC files, and moving them into a scene.

A file is checked completely before anything is returned; each complaint is one line that names the file and the line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.inputs import check_input

TrajectoryFormat = Literal["auto", "tum", "icl", "euroc"]
Check = Callable[[BoolArray, Callable[[int], str]], None]

ICL_RATE_HZ = 30.0
"""ICL-NUIM's files carry frame indices only; its sequences are 30 Hz by definition."""

QUATERNION_TOLERANCE = 1e-2
"""Largest | |q| − 1 | that is normalised away: what rounding to two decimals can lose. More is taken for a mistake."""

MAX_POSITION_M = 1e4
"""Positions farther than this from the origin are refused: millimetres, or map coordinates, by mistake."""

MIN_POSES = 4
MAX_STAMP_S = 1e11  # the year 5138; today in milliseconds, microseconds or nanoseconds is beyond
_ICL_Z_OFFSET_M = -2.25  # the published files put frame 1 at z = -2.25
_FIELDS = 8
_LAYOUT = {
    "tum": "'stamp tx ty tz qx qy qz qw'",
    "icl": "'frame tx ty tz qx qy qz qw'",
    "euroc": "'timestamp[ns],px,py,pz,qw,qx,qy,qz,...'",
}


@dataclass(frozen=True)
class Trajectory:
    """Stamped poses of a rigid body in the world.

    stamps: (n,) seconds, strictly increasing. T_world_cam: (n, 4, 4), camera x right, y down, z forward; the world is
    right-handed, metres. (For EuRoC files the body is the IMU: apply ``moved(T_body_cam=...)``.)
    """

    stamps: FloatArray
    T_world_cam: FloatArray

    def __post_init__(self) -> None:
        if self.stamps.ndim != 1 or self.T_world_cam.shape != (len(self.stamps), 4, 4):
            raise UserError(
                f"trajectory: stamps {self.stamps.shape} and poses {self.T_world_cam.shape} do not match: "
                "give (n,) stamps and (n, 4, 4) poses"
            )

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def positions(self) -> FloatArray:
        """(n, 3) metres: the camera's centre in the world."""
        return self.T_world_cam[:, :3, 3]

    def moved(self, T_scene_world: FloatArray | None = None, T_body_cam: FloatArray | None = None) -> Trajectory:
        """The same motion in another world frame and/or of another camera fixed to the same body; both are (4, 4)."""
        poses = self.T_world_cam
        if T_scene_world is not None:
            poses = np.asarray(T_scene_world, dtype=np.float64) @ poses
        if T_body_cam is not None:
            poses = poses @ np.asarray(T_body_cam, dtype=np.float64)
        return Trajectory(self.stamps, poses)

    def rebased(self, first_stamp: float = 0.0) -> Trajectory:
        """The same motion with its first stamp at first_stamp seconds.

        Unix stamps leave a float64 0.24 µs of resolution, 0.4 % of a row's delay: sequences want small stamps.
        """
        return Trajectory(self.stamps - self.stamps[0] + first_stamp, self.T_world_cam)


def read_trajectory(
    path: str | Path,
    format: TrajectoryFormat = "auto",
    icl_start: npt.ArrayLike | None = None,
    max_gap_s: float | None = None,
) -> Trajectory:
    """Read a trajectory file.

    path: text file; '#' starts a comment, fields are separated by white space or commas.
    format:
      "tum"    ``stamp tx ty tz qx qy qz qw``, seconds, T_world_cam in our conventions.
      "icl"    ICL-NUIM's published ``livingRoomK.gt.freiburg``: the first column is the frame index (30 Hz), the poses
               are left-handed, y up and relative to frame 1; converted to our conventions.
      "euroc"  ``state_groundtruth_estimate0/data.csv``: nanoseconds, p_RS_R, q_RS with w first; further columns are
               ignored. The body is EuRoC's IMU frame S.
      "auto"   "icl" if the name ends in ``.freiburg``, "euroc" if the first record has commas and an integer stamp of
               at least 16 digits, else "tum".
    icl_start: (3, 4) or (4, 4) camera-to-world [R|t] of frame 1 in ICL-NUIM's own POV-Ray world (left-handed, y up):
      puts an "icl" file at its true place in the room. Without it frame 1 is at the origin. Other formats ignore it:
      a config that places the published file serves one that is in the room's frame already.
    max_gap_s: the longest time allowed between neighbouring poses, seconds; default max(0.5, 5 × the median step).

    Quaternions are normalised if their norm is within QUATERNION_TOLERANCE of one; their signs do not matter.
    Raises UserError, naming file and line, on anything unreadable, incomplete, out of order or absurd.
    """
    path = Path(path)
    if format not in get_args(TrajectoryFormat):
        raise UserError(f"unknown trajectory format '{format}': use one of {', '.join(get_args(TrajectoryFormat))}")
    records = _records(path, _text(path))
    kind = _detect(path, records) if format == "auto" else format

    def check(good: BoolArray, complaint: Callable[[int], str]) -> None:
        """Raises UserError for the first record that is not good."""
        for bad in np.flatnonzero(~good)[:1]:
            raise UserError(f"{path}:{records[bad][0]}: {complaint(int(bad))}")

    table = _table(path, kind, records)
    stamps = table[:, 0]
    check(np.all(np.isfinite(table), axis=1), lambda i: "has a NaN or infinite value: remove the line")
    positions, quaternions = table[:, 1:4], table[:, 4:8]
    if kind == "euroc":
        stamps = _nanoseconds(path, records)
        quaternions = quaternions[:, [1, 2, 3, 0]]
    elif kind == "icl":
        check(
            np.equal(stamps, np.round(stamps)),
            lambda i: f"starts with {stamps[i]:g}, not a frame index: use format tum if the first column is in seconds",
        )
        stamps = stamps / ICL_RATE_HZ
    check(
        np.abs(stamps) < MAX_STAMP_S,
        lambda i: f"has the stamp {stamps[i]:.6g}, absurd in seconds: divide by 1e9 if these are nanoseconds",
    )
    _check_stamps(check, stamps, max_gap_s)
    check(
        np.abs(positions).max(axis=1) <= MAX_POSITION_M,
        lambda i: f"has a position beyond {MAX_POSITION_M:g} m: positions are metres from a nearby origin",
    )
    norms = np.linalg.norm(quaternions, axis=1)
    check(norms > 0.0, lambda i: "has a zero quaternion: remove the line")
    check(
        np.abs(norms - 1.0) <= QUATERNION_TOLERANCE,
        lambda i: f"has a quaternion of norm {norms[i]:.4g}, not 1: check the columns, expected {_LAYOUT[kind]}",
    )
    poses = se3.from_quat_trans(quaternions / norms[:, None], positions)
    if kind == "icl":
        poses = _icl_to_ours(poses, _start_pose(icl_start))
    return Trajectory(stamps, poses)


# --- text to numbers -------------------------------------------------------------------------------------------------


def _text(path: Path) -> str:
    check_input(path)
    try:
        raw = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: no file can have that name
        raise UserError(f"cannot read trajectory {path}: {getattr(error, 'strerror', None) or error}") from None
    if b"\0" in raw:
        raise UserError(f"{path} is not a text file: give a TUM, ICL-NUIM or EuRoC trajectory")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise UserError(f"{path}:{line}: not plain text: give a TUM, ICL-NUIM or EuRoC trajectory") from None
    if text.lstrip().startswith("<"):
        raise UserError(f"{path} is a web page, not a trajectory: download the raw file")
    return text


def _records(path: Path, text: str) -> list[tuple[int, str]]:
    """(line number, content) of every line that carries data."""
    records = [(k, line.split("#", 1)[0].strip()) for k, line in enumerate(text.splitlines(), start=1)]
    records = [(k, line) for k, line in records if line]
    if not records:
        raise UserError(f"{path} holds no poses: expected lines of {_LAYOUT['tum']}")
    if len(records) < MIN_POSES:
        raise UserError(f"{path} holds {len(records)} poses: a trajectory needs at least {MIN_POSES}")
    return records


def _detect(path: Path, records: list[tuple[int, str]]) -> Literal["tum", "icl", "euroc"]:
    if path.suffix == ".freiburg":
        return "icl"
    stamp, comma, _ = records[0][1].partition(",")
    return "euroc" if comma and stamp.strip().isdigit() and len(stamp.strip()) >= 16 else "tum"


def _table(path: Path, kind: str, records: list[tuple[int, str]]) -> FloatArray:
    """(n, 8) float64: the first eight columns."""
    rows = []
    for line, content in records:
        fields = content.split(",") if kind == "euroc" else content.replace(",", " ").split()
        if len(fields) < _FIELDS or (len(fields) > _FIELDS and kind != "euroc"):
            raise UserError(f"{path}:{line}: {len(fields)} columns instead of {_FIELDS}, expected {_LAYOUT[kind]}")
        rows.append(np.empty(_FIELDS))
        for k, field in enumerate(fields[:_FIELDS]):
            try:
                rows[-1][k] = float(field)
            except ValueError:
                what = f"'{field.strip()[:30]}' is not a number"
                raise UserError(f"{path}:{line}: {what}, expected {_LAYOUT[kind]}") from None
    return np.array(rows)


def _nanoseconds(path: Path, records: list[tuple[int, str]]) -> FloatArray:
    """(n,) seconds; read as integers, since 19 digits do not fit a float64."""
    stamps = np.empty(len(records))
    for k, (line, content) in enumerate(records):
        field = content.split(",", 1)[0].strip()
        if not field.lstrip("-").isdigit():
            raise UserError(f"{path}:{line}: '{field[:30]}' is not whole nanoseconds: use format tum for seconds")
        stamps[k] = int(field) / 1e9
    return stamps


# --- checks on numbers -----------------------------------------------------------------------------------------------


def _check_stamps(check: Check, stamps: FloatArray, max_gap_s: float | None) -> None:
    steps = np.diff(stamps, prepend=stamps[0] - 1.0)
    check(steps != 0.0, lambda i: f"repeats the stamp {stamps[i]:.9g} s of the line before: remove one of them")
    check(
        steps > 0.0,
        lambda i: f"goes back in time, from {stamps[i - 1]:.9g} to {stamps[i]:.9g} s: sort the file by time",
    )
    allowed = max(0.5, 5.0 * float(np.median(steps[1:]))) if max_gap_s is None else max_gap_s
    check(
        np.concatenate([[True], steps[1:] <= allowed * (1.0 + 1e-9)]),
        lambda i: (
            f"comes {steps[i]:.3g} s after the pose before it (at most {allowed:.3g} s allowed): "
            "cut the file at the gap or raise max_gap_s"
        ),
    )


# --- ICL-NUIM --------------------------------------------------------------------------------------------------------


def _start_pose(icl_start: npt.ArrayLike | None) -> FloatArray:
    """(4, 4) T_pov_cam of frame 1 from a 3x4 or 4x4 list; orthonormal, since published digits are rounded."""
    if icl_start is None:
        return np.eye(4)
    try:
        start = np.asarray(icl_start, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError("icl_start is not a matrix of numbers: give frame 1's 3x4 camera-to-world [R|t]") from None
    if start.shape not in ((3, 4), (4, 4)) or not np.isfinite(start).all():
        raise UserError(f"icl_start has shape {start.shape}: give frame 1's finite 3x4 camera-to-world [R|t]")
    T = np.eye(4)
    T[:3] = start[:3]
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(T[:3, :3]) < 0.0:
        raise UserError("icl_start is not a rigid pose: its left 3x3 block must be a rotation")
    return se3.orthonormalise(T)


def _icl_to_ours(T_relative: FloatArray, T_pov_start: FloatArray) -> FloatArray:
    """(n, 4, 4) published start-relative poses to T_world_cam, given frame 1's pose in the POV-Ray world.

    POV-Ray's world is left-handed (x right, y up, z forward) and so is its camera, so that the rotation between them
    is proper and the files hold ordinary quaternions. Mirroring the world's x makes it right-handed, mirroring the
    camera's y makes y point down: T = diag(−1,1,1,1) T_pov diag(1,−1,1,1).
    """
    T_start_cam = T_relative.copy()
    T_start_cam[:, 2, 3] -= _ICL_Z_OFFSET_M
    mirror_x, mirror_y = np.diag([-1.0, 1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])
    return mirror_x @ T_pov_start @ T_start_cam @ mirror_y
