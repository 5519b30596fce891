"""Writes a recording as a folder in TUM's layout, with its cameras, and what else is known of it. Whole or not at all.

rgb/000000.png depth/000000.png rgb.txt depth.txt camera.yaml     see docs/format.md
groundtruth.txt   poses of the colour camera, where the recording has any; its first line says whose
imu.csv           EuRoC's columns; imu.yaml where the recording says where the IMU sits, or how noisy it is
intrinsics.csv    stamp [ns], fx, fy, cx, cy of each colour image, where they change; intrinsics_depth.csv: of each
                  depth image
import.json       what was read of which file, and what was assumed
"""

from __future__ import annotations

import json
import os
import shutil
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import encode_yaml, write_error
from rsgen.sequence.format import pose_rows
from rsgen.sequence.trajectory import MAX_POSITION_M, MIN_POSES
from rstrack.data.imu.description import imu_yaml
from rstrack.data.imu.recording import IMU_YAML
from rstrack.data.layouts.tum_folder import ESTIMATED
from rstrack.data.own_intrinsics import FILES
from rstrack.formats.recording import Inertial, Intrinsics, Picture, Pose, Recording, StreamCamera

RECORD = "import.json"
_MOST_NS = 10**20  # the year 5138: beyond that, stamps are refused when they are read, too
_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


@dataclass(frozen=True)
class Written:
    """What is in the folder. unknown: streams of which nothing tells the readout."""

    out: Path
    kind: str
    counts: dict[str, int]
    poses: int
    imu: int
    unknown: tuple[str, ...]
    notes: tuple[str, ...]

    def text(self) -> str:
        """For the screen."""
        parts = [f"{self.counts['color']} colour and {self.counts['depth']} depth images"]
        parts += [f"{self.poses} poses"] if self.poses else []
        parts += [f"{self.imu} IMU samples"] if self.imu else []
        return "\n".join([*self.notes, f"{self.out}: written from a {self.kind}: {', '.join(parts)}"])


@dataclass
class _Streams:
    """What has come so far, in the order of the file."""

    folder: Path
    stamps: dict[str, list[tuple[int, int | None]]] = field(default_factory=lambda: {"color": [], "depth": []})
    paths: dict[str, list[str]] = field(default_factory=lambda: {"color": [], "depth": []})
    gyro: array[float] = field(default_factory=lambda: array("d"))
    gyro_ns: array[int] = field(default_factory=lambda: array("q"))
    accel: array[float] = field(default_factory=lambda: array("d"))
    accel_ns: array[int] = field(default_factory=lambda: array("q"))
    poses: list[Pose] = field(default_factory=list)
    intrinsics: list[Intrinsics] = field(default_factory=list)


def check_place(out: Path, force: bool) -> None:
    """Raises UserError where a folder may not be written: there is one, and it is not one that this may replace."""
    if not out.exists() and not out.is_symlink():
        return
    if out.is_dir() and not any(out.iterdir()):
        return
    if not force:
        raise UserError(f"{out}: is there already: give another folder, or --force to replace an imported one")
    if not (out / RECORD).is_file():
        raise UserError(f"{out}: was not written by 'rstrack import' (it has no {RECORD}): remove it yourself")


def write_folder(
    recording: Recording,
    out: Path,
    *,
    file: str,
    readout_s: tuple[float | None, float | None] = (None, None),
    force: bool = False,
    progress: Progress = no_progress,
) -> Written:
    """Read the whole recording and write it to `out`, which appears when everything is in it.

    file: the recording's name, for import.json. readout_s: what else is known of colour's and depth's readout, where
    the recording says nothing. Raises UserError, one line; nothing is left then.
    """
    check_place(out, force)
    part = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        try:
            shutil.rmtree(part, ignore_errors=True)
            for name in ("rgb", "depth"):
                (part / name).mkdir(parents=True)
            written = _write(recording, part, out, file, readout_s, progress)
            _replace(part, out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise write_error(out, error) from None
    return written


def _replace(part: Path, out: Path) -> None:
    """Put `part` in the place of `out`."""
    if not out.exists():
        part.rename(out)
        return
    old = out.with_name(f".{out.name}.{os.getpid()}.old.tmp")
    out.rename(old)
    try:
        part.rename(out)
    except OSError:
        old.rename(out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _write(
    recording: Recording, part: Path, out: Path, file: str, extra: tuple[float | None, float | None],
    progress: Progress,
) -> Written:  # fmt: skip
    streams, done = _Streams(part), 0
    for item in recording.items:
        if isinstance(item, Picture):
            _put(streams, item)
            done += 1
            progress("importing", min(1.0, done / max(recording.pictures, 1)), f"{done} images")
        elif isinstance(item, Inertial):
            _note_sample(streams, item)
        elif isinstance(item, Pose):
            streams.poses.append(item)
        else:
            streams.intrinsics.append(item)
    for stream, name in (("color", "colour"), ("depth", "depth")):
        if not streams.paths[stream]:
            raise UserError(f"{file}: has no {name} images")
    notes = [*recording.notes]
    counts = _listings(streams, part, file, notes)
    poses = _truth(streams.poses, part, recording, notes)
    imu = _imu(streams, part, notes)
    if imu:
        _imu_file(recording, part, notes)
    _intrinsics(streams.intrinsics, part, notes)
    known = [
        s.readout_s if s.readout_s is not None else e
        for s, e in zip((recording.color, recording.depth), extra, strict=True)
    ]
    unknown = tuple(name for name, value in zip(("colour", "depth"), known, strict=True) if value is None)
    _camera_file(recording, known, unknown, part)
    record = {"format": "rstrack-import/1", "file": file, "kind": recording.kind, "images": counts,
              "source": dict(recording.source), "readout_unknown": list(unknown), "notes": notes}  # fmt: skip
    (part / RECORD).write_text(json.dumps(record, indent=2) + "\n")
    return Written(out, recording.kind, counts, poses, imu, unknown, tuple(notes))


def _put(streams: _Streams, picture: Picture) -> None:
    paths = streams.paths[picture.stream]
    path = f"{'rgb' if picture.stream == 'color' else 'depth'}/{len(paths):06d}.{picture.ending}"
    (streams.folder / path).write_bytes(picture.data)
    paths.append(path)
    streams.stamps[picture.stream].append((picture.stamp_ns, picture.arrival_ns))


def _note_sample(streams: _Streams, sample: Inertial) -> None:
    for values, stamps, new in (
        (streams.gyro, streams.gyro_ns, sample.gyro),
        (streams.accel, streams.accel_ns, sample.accel),
    ):
        if new is not None and 0 <= sample.stamp_ns < 2**63:
            values.extend(new)
            stamps.append(sample.stamp_ns)


def _listings(streams: _Streams, part: Path, file: str, notes: list[str]) -> dict[str, int]:
    """rgb.txt and depth.txt, by one clock for both."""
    every = [pair for stamps in streams.stamps.values() for pair in stamps]
    # A first image may be of time 0; more of them are of none.
    use_arrival = any(sum(stamp == 0 for stamp, _ in stamps) > 1 for stamps in streams.stamps.values())
    if use_arrival:
        if any(arrival is None for _, arrival in every):
            raise UserError(f"{file}: images without stamps, and nothing else tells their times")
        notes.append(
            "images have no stamps (0): the times at which they were recorded are taken, some milliseconds late"
        )
    counts = {}
    for stream, name in (("color", "rgb"), ("depth", "depth")):
        once: dict[int, str] = {}
        for (stamp, arrival), path in zip(streams.stamps[stream], streams.paths[stream], strict=True):
            ns = arrival if use_arrival and arrival is not None else stamp
            if not 0 <= ns < _MOST_NS:
                raise UserError(f"{file}: {path} has the stamp {ns} ns: the file is damaged")
            if ns in once:
                (part / path).unlink()
            once.setdefault(ns, path)
        if again := len(streams.paths[stream]) - len(once):
            notes.append(
                f"{again} {'colour' if stream == 'color' else stream} images with another's stamp are left out"
            )
        lines = [f"{ns // 10**9}.{ns % 10**9:09d} {path}" for ns, path in sorted(once.items())]
        (part / f"{name}.txt").write_text("\n".join(["# stamp [s] file", *lines, ""]))
        counts[stream] = len(once)
    return counts


def _truth(poses: Sequence[Pose], part: Path, recording: Recording, notes: list[str]) -> int:
    once = {pose.stamp_ns: pose.T_world_color for pose in poses if _is_pose(pose.T_world_color)}
    if lost := len(poses) - len(once):
        notes.append(f"{lost} of {len(poses)} poses are not finite, or come twice: there is no truth at these images")
    if len(once) < MIN_POSES:
        notes += [f"{len(once)} poses are no truth: groundtruth.txt is not written"] if once else []
        return 0
    rows = pose_rows(np.stack([once[ns] for ns in sorted(once)])).tolist()
    head = f"# {recording.truth}" if recording.is_measured else f"{ESTIMATED}{recording.truth}"
    lines = [
        " ".join([f"{ns // 10**9}.{ns % 10**9:09d}", *(f"{value:.9f}" for value in row)])
        for ns, row in zip(sorted(once), rows, strict=True)
    ]
    (part / "groundtruth.txt").write_text("\n".join([head, "# stamp tx ty tz qx qy qz qw", *lines, ""]))
    return len(once)


def _is_pose(T: FloatArray) -> bool:
    return bool(np.isfinite(T).all() and np.abs(T[:3, 3]).max() <= MAX_POSITION_M)


def _imu(streams: _Streams, part: Path, notes: list[str]) -> int:
    """imu.csv at the gyro's stamps; an accelerometer with stamps of its own is interpolated there."""
    gyro_ns, accel_ns = (np.array(stamps, np.int64) for stamps in (streams.gyro_ns, streams.accel_ns))
    gyro, accel = (np.array(values, float).reshape(-1, 3) for values in (streams.gyro, streams.accel))
    if not len(gyro_ns) or not len(accel_ns):
        if len(gyro_ns) or len(accel_ns):
            notes.append("the IMU has no gyro or no accelerometer: imu.csv is not written")
        return 0
    (gyro_ns, gyro), (accel_ns, accel) = _in_order(gyro_ns, gyro), _in_order(accel_ns, accel)
    if not np.array_equal(gyro_ns, accel_ns):
        within = (gyro_ns >= accel_ns[0]) & (gyro_ns <= accel_ns[-1])
        gyro_ns, gyro = gyro_ns[within], gyro[within]
        at, known = ((ns - accel_ns[0]) * 1e-9 for ns in (gyro_ns, accel_ns))
        accel = np.column_stack([np.interp(at, known, accel[:, i]) for i in range(3)])
        notes.append("the accelerometer has stamps of its own: imu.csv has it interpolated at the gyro's")
    table = np.column_stack([gyro, accel]).tolist()
    lines = [",".join([str(ns), *map(repr, row)]) for ns, row in zip(gyro_ns.tolist(), table, strict=True)]
    (part / "imu.csv").write_text("\n".join([_IMU_HEADER, *lines, ""]))
    return len(lines)


def _imu_file(recording: Recording, part: Path, notes: list[str]) -> None:
    """imu.yaml, as far as anything is known."""
    T, noise = recording.T_imu_depth, recording.imu_noise
    if T is None:
        notes.append("where the IMU sits is not told: write T_imu_depth into imu.yaml, or rstrack calibrate --free imu")
    if T is not None or noise is not None:
        head = f"# Written by rstrack import, from a {recording.kind}."
        (part / IMU_YAML).write_text("\n".join([head, imu_yaml(T, noise)]))


def _in_order(stamps: Any, values: FloatArray) -> tuple[Any, FloatArray]:
    unique, first = np.unique(stamps, return_index=True)
    return unique, values[first]


def _intrinsics(changing: Sequence[Intrinsics], part: Path, notes: list[str]) -> None:
    for stream, name in FILES.items():
        once = {item.stamp_ns: item.values for item in reversed(changing) if item.stream == stream}
        table = np.array(list(once.values())).reshape(-1, 4)
        if not len(table) or (table == table[0]).all():
            continue
        lines = [",".join([str(ns), *map(repr, once[ns])]) for ns in sorted(once)]
        (part / name).write_text("\n".join(["#timestamp [ns],fx,fy,cx,cy", *lines, ""]))
        spread = np.ptp(table, axis=0)
        notes.append(
            f"{'colour' if stream == 'color' else stream}'s intrinsics change (fx by {spread[0]:.2f}, cx by "
            f"{spread[2]:.2f}, cy by {spread[3]:.2f} px): camera.yaml has their medians, {name} each image's"
        )


def _camera_file(recording: Recording, known: Sequence[float | None], unknown: Sequence[str], part: Path) -> None:
    depth = _stream(recording.depth, known[1]) | {"depth_scale": recording.depth_scale}
    if recording.is_registered:
        depth |= {"registered": True}
    data: dict[str, Any] = {"color": _stream(recording.color, known[0]), "depth": depth}
    if not recording.is_registered:
        T = np.eye(4) if recording.T_color_depth is None else recording.T_color_depth
        data["T_color_depth"] = [[float(value) for value in row] for row in T]
    head = [f"# Written by rstrack import, from a {recording.kind}."]
    if unknown:
        head.append(f"# readout_s of {' and '.join(unknown)} is not known, and 0 here: rstrack calibrate finds it.")
    (part / "camera.yaml").write_bytes("\n".join([*head, ""]).encode() + encode_yaml(data))


def _stream(stream: StreamCamera, readout_s: float | None) -> dict[str, Any]:
    camera = stream.camera
    data: dict[str, Any] = {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    if camera.model != "pinhole":
        data |= {"model": camera.model, "distortion": list(camera.distortion)}
    data |= {"readout_s": readout_s or 0.0}
    data |= {"exposure_s": stream.exposure_s} if stream.exposure_s else {}
    return data | ({"scan": stream.scan} if stream.scan else {})
