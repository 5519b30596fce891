"""Writes a recording as a folder in TUM's layout, with its cameras, and what else is known of it. Whole or not at all.

rgb/000000.png depth/000000.png rgb.txt depth.txt camera.yaml     see docs/format.md
groundtruth.txt   poses of the colour camera, where the recording has any; its first line states whose
imu.csv           EuRoC's columns; imu.yaml where the recording states where the IMU sits, or how noisy it is
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
from rsgen.sequence.trajectory import MAX_POSITION_M, MAX_STAMP_S, MIN_POSES
from rstrack.data.imu.description import imu_yaml
from rstrack.data.imu.recording import IMU_YAML
from rstrack.data.layouts.tum_folder import ESTIMATED
from rstrack.data.registration import FILES
from rstrack.formats.recording import ImageIntrinsics, ImuSample, RecordedImage, RecordedPose, Recording, StreamCamera

RECORD = "import.json"
_NAMES = {"color": "colour", "depth": "depth"}
_MOST_NS = int(1e9 * MAX_STAMP_S)  # beyond that, stamps are refused when they are read, too
_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


@dataclass(frozen=True)
class ImportedFolder:
    """What is in the folder. unknown: streams whose readout is not known."""

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


def check_place(out: Path, force: bool) -> None:
    """Raises UserError where a folder may not be written: there is one, and it is not one that this may replace."""
    if not (out.exists() or out.is_symlink()) or (out.is_dir() and not any(out.iterdir())):
        return
    if not force:
        raise UserError(f"{out}: is there already: give another folder, or --force to replace an imported one")
    if not (out / RECORD).is_file():
        raise UserError(f"{out}: was not written by 'rstrack import' (it has no {RECORD}): remove it yourself")


def write_folder(
    recording: Recording, out: Path, *, file: str, readout_s: Sequence[float | None] = (None, None),
    force: bool = False, progress: Progress = no_progress,
) -> ImportedFolder:  # fmt: skip
    """Read the whole recording and write it to `out`, which appears when everything is in it.

    file: the recording's name, for import.json. readout_s: what else is known of colour's and depth's readout, where
    the recording does not state it. Raises UserError, one line; nothing is left then.
    """
    check_place(out, force)
    part = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        try:
            shutil.rmtree(part, ignore_errors=True)
            for name in ("rgb", "depth"):
                (part / name).mkdir(parents=True)
            written = _Import(recording, part, file, [*recording.notes]).written(out, readout_s, progress)
            _replace(part, out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise write_error(out, error) from None
    return written


def _replace(part: Path, out: Path) -> None:
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


@dataclass
class _SensorSamples:
    """What one sensor of an IMU measured, in the order of the file."""

    ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, ns: int, values: Sequence[float] | None) -> None:
        if values is not None and 0 <= ns < 2**63:
            self.ns.append(ns)
            self.values.extend(values)

    def in_order(self) -> tuple[Any, FloatArray]:
        """Stamps (n,) in ns, each once, and values (n, 3)."""
        unique, first = np.unique(np.array(self.ns, np.int64), return_index=True)
        return unique, np.array(self.values, float).reshape(-1, 3)[first]


@dataclass
class _Import:
    """A recording on its way into a folder: images are written as they come, the rest is collected."""

    recording: Recording
    folder: Path
    file: str
    notes: list[str]
    images: dict[str, list[tuple[int, int | None, str]]] = field(default_factory=lambda: {"color": [], "depth": []})
    gyro: _SensorSamples = field(default_factory=_SensorSamples)
    accel: _SensorSamples = field(default_factory=_SensorSamples)
    poses: list[RecordedPose] = field(default_factory=list)
    intrinsics: list[ImageIntrinsics] = field(default_factory=list)

    def written(self, out: Path, extra: Sequence[float | None], progress: Progress) -> ImportedFolder:
        """Everything, in `folder`, which will be `out`. extra: readouts where the recording states none."""
        recording, done = self.recording, 0
        for item in recording.items:
            if isinstance(item, RecordedImage):
                self._put(item)
                done += 1
                progress("importing", min(1.0, done / max(recording.images, 1)), f"{done} images")
            elif isinstance(item, ImuSample):
                self.gyro.add(item.stamp_ns, item.gyro)
                self.accel.add(item.stamp_ns, item.accel)
            elif isinstance(item, RecordedPose):
                self.poses.append(item)
            else:
                self.intrinsics.append(item)
        for stream, name in _NAMES.items():
            if not self.images[stream]:
                raise UserError(f"{self.file}: has no {name} images")
        counts, poses, imu = self._listings(), self._truth(), self._imu()
        self._intrinsics()
        streams = recording.color, recording.depth
        known = [e if s.readout_s is None else s.readout_s for s, e in zip(streams, extra, strict=True)]
        unknown = tuple(name for name, value in zip(_NAMES.values(), known, strict=True) if value is None)
        self._camera_file(known, unknown)
        record = {"format": "rstrack-import/1", "file": self.file, "kind": recording.kind, "images": counts,
                  "source": dict(recording.source), "readout_unknown": list(unknown), "notes": self.notes}  # fmt: skip
        (self.folder / RECORD).write_text(json.dumps(record, indent=2) + "\n")
        return ImportedFolder(out, recording.kind, counts, poses, imu, unknown, tuple(self.notes))

    def _write(self, name: str, *lines: str) -> None:
        (self.folder / name).write_text("\n".join([*lines, ""]))

    def _put(self, image: RecordedImage) -> None:
        before = self.images[image.stream]
        path = f"{'rgb' if image.stream == 'color' else 'depth'}/{len(before):06d}.{image.ending}"
        (self.folder / path).write_bytes(image.data)
        before.append((image.stamp_ns, image.arrival_ns, path))

    def _listings(self) -> dict[str, int]:
        """rgb.txt and depth.txt, by one clock for both."""
        # A first image may be of time 0; more of them are of none.
        use_arrival = any(sum(stamp == 0 for stamp, _, _ in images) > 1 for images in self.images.values())
        if use_arrival:
            if any(arrival is None for images in self.images.values() for _, arrival, _ in images):
                raise UserError(f"{self.file}: images without stamps, and nothing else states their times")
            late = "the times at which they were recorded are taken, some milliseconds late"
            self.notes.append(f"images have no stamps (0): {late}")
        counts = {}
        for stream, name in _NAMES.items():
            once: dict[int, str] = {}
            for stamp, arrival, path in self.images[stream]:
                ns = arrival if use_arrival and arrival is not None else stamp
                if not 0 <= ns < _MOST_NS:
                    raise UserError(f"{self.file}: {path} has the stamp {ns} ns: the file is damaged")
                if ns in once:
                    (self.folder / path).unlink()
                once.setdefault(ns, path)
            if again := len(self.images[stream]) - len(once):
                self.notes.append(f"{again} {name} images with another's stamp are left out")
            lines = [f"{_seconds(ns)} {path}" for ns, path in sorted(once.items())]
            self._write("rgb.txt" if stream == "color" else "depth.txt", "# stamp [s] file", *lines)
            counts[stream] = len(once)
        return counts

    def _truth(self) -> int:
        once = {pose.stamp_ns: pose.T_world_color for pose in self.poses if _is_pose(pose.T_world_color)}
        if lost := len(self.poses) - len(once):
            which = f"{lost} of {len(self.poses)} poses"
            self.notes.append(f"{which} are not finite, or come twice: there is no truth at these images")
        if len(once) < MIN_POSES:
            self.notes += [f"{len(once)} poses are no truth: groundtruth.txt is not written"] if once else []
            return 0
        rows = pose_rows(np.stack([once[ns] for ns in sorted(once)])).tolist()
        head = f"{'# ' if self.recording.is_measured else ESTIMATED}{self.recording.truth}"
        lines = [
            " ".join([_seconds(ns), *(f"{value:.9f}" for value in row)])
            for ns, row in zip(sorted(once), rows, strict=True)
        ]
        self._write("groundtruth.txt", head, "# stamp tx ty tz qx qy qz qw", *lines)
        return len(once)

    def _imu(self) -> int:
        """imu.csv at the gyro's stamps, where an accelerometer with stamps of its own is interpolated; imu.yaml."""
        if not self.gyro.ns or not self.accel.ns:
            if self.gyro.ns or self.accel.ns:
                self.notes.append("the IMU has no gyro or no accelerometer: imu.csv is not written")
            return 0
        (gyro_ns, gyro), (accel_ns, accel) = self.gyro.in_order(), self.accel.in_order()
        if not np.array_equal(gyro_ns, accel_ns):
            within = (gyro_ns >= accel_ns[0]) & (gyro_ns <= accel_ns[-1])
            gyro_ns, gyro = gyro_ns[within], gyro[within]
            at, known = ((ns - accel_ns[0]) * 1e-9 for ns in (gyro_ns, accel_ns))
            accel = np.column_stack([np.interp(at, known, accel[:, i]) for i in range(3)])
            self.notes.append("the accelerometer has stamps of its own: imu.csv has it interpolated at the gyro's")
        table = np.column_stack([gyro, accel]).tolist()
        lines = [",".join([str(ns), *map(repr, row)]) for ns, row in zip(gyro_ns.tolist(), table, strict=True)]
        self._write("imu.csv", _IMU_HEADER, *lines)
        T, noise = self.recording.T_imu_depth, self.recording.imu_noise
        if T is None:
            cure = "write T_imu_depth into imu.yaml, or rstrack calibrate --free imu"
            self.notes.append(f"where the IMU sits is not known: {cure}")
        if T is not None or noise is not None:
            (self.folder / IMU_YAML).write_text("\n".join([self._head(), imu_yaml(T, noise)]))
        return len(lines)

    def _head(self) -> str:
        return f"# Written by rstrack import, from a {self.recording.kind}."

    def _intrinsics(self) -> None:
        for stream, name in FILES.items():
            once = {item.stamp_ns: item.values for item in reversed(self.intrinsics) if item.stream == stream}
            table = np.array(list(once.values())).reshape(-1, 4)
            if not len(table) or (table == table[0]).all():
                continue
            lines = [",".join([str(ns), *map(repr, once[ns])]) for ns in sorted(once)]
            self._write(name, "#timestamp [ns],fx,fy,cx,cy", *lines)
            spread = np.ptp(table, axis=0)
            self.notes.append(
                f"{_NAMES[stream]}'s intrinsics change (fx by {spread[0]:.2f}, cx by {spread[2]:.2f}, cy by "
                f"{spread[3]:.2f} px): camera.yaml has their medians, {name} each image's"
            )

    def _camera_file(self, known: Sequence[float | None], unknown: Sequence[str]) -> None:
        recording = self.recording
        depth = _stream(recording.depth, known[1]) | {"depth_scale": recording.depth_scale}
        if recording.is_registered:
            depth |= {"registered": True}
        data: dict[str, Any] = {"color": _stream(recording.color, known[0]), "depth": depth}
        if not recording.is_registered:
            T = np.eye(4) if recording.T_color_depth is None else recording.T_color_depth
            data["T_color_depth"] = [[float(value) for value in row] for row in T]
        head = [self._head()]
        if unknown:
            head.append(f"# readout_s of {' and '.join(unknown)} is not known, and 0 here: rstrack calibrate finds it.")
        (self.folder / "camera.yaml").write_bytes("\n".join([*head, ""]).encode() + encode_yaml(data))


def _seconds(ns: int) -> str:
    return f"{ns // 10**9}.{ns % 10**9:09d}"


def _is_pose(T: FloatArray) -> bool:
    return bool(np.isfinite(T).all() and np.abs(T[:3, 3]).max() <= MAX_POSITION_M)


def _stream(stream: StreamCamera, readout_s: float | None) -> dict[str, Any]:
    camera = stream.camera
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    data: dict[str, Any] = {"width": camera.width, "height": camera.height, "intrinsics": intrinsics}
    if camera.model != "pinhole":
        data |= {"model": camera.model, "distortion": list(camera.distortion)}
    data |= {"readout_s": readout_s or 0.0}
    data |= {"exposure_s": stream.exposure_s} if stream.exposure_s else {}
    return data | ({"scan": stream.scan} if stream.scan else {})
