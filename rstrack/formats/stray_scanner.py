"""Folders of Stray Scanner: rgb.mp4, depth/N.png (mm), confidence/N.png, odometry.csv, imu.csv, camera_matrix.csv.

odometry.csv has ARKit's pose of the camera (x right, y down, z forward) at each frame, in newer versions its
intrinsics, too. Its frames and the video's come in the same order; a video that is shorter ends the recording.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import listed_file, read_bytes, read_text
from rsgen.geometry.camera import Camera
from rsgen.image_codecs import encode_png, png_fault
from rsgen.sequence.trajectory import MAX_STAMP_S
from rstrack.formats.pixels import check_size, decode, header_size
from rstrack.formats.recording import (
    ARKIT_TRUTH,
    ImuSample,
    Item,
    ReadOptions,
    RecordedImage,
    RecordedPose,
    Recording,
    StreamCamera,
    intrinsics_items,
    median_camera,
    pose_of,
    resized,
)

_MILLIMETRES = 1000.0
_MOST_FRAMES = 10**9
# Kinds of the first box of a QuickTime or MP4 file. FFmpeg opens lists of other files, and addresses, by any name.
_FIRST_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_POSE, _INTRINSICS = ("x", "y", "z", "qx", "qy", "qz", "qw"), ("fx", "fy", "cx", "cy")
_IMU = ("timestamp", "a_x", "a_y", "a_z", "alpha_x", "alpha_y", "alpha_z")


def matches(path: Path) -> bool:
    """Whether a folder is one of the app's."""
    return (path / "rgb.mp4").is_file() and (path / "odometry.csv").is_file()


def read(path: Path, options: ReadOptions) -> Recording:
    """The cameras of a folder; images are read as asked for. Raises UserError, one line."""
    _check_inside(path, ("rgb.mp4", "odometry.csv", "camera_matrix.csv", "imu.csv"))
    rows = _table(path / "odometry.csv", ("timestamp", "frame", *_POSE))
    if not rows:
        raise UserError(f"{path / 'odometry.csv'}: lists no frame")
    each = [[row[name] for name in _INTRINSICS] for row in rows] if "fx" in rows[0] else [_matrix(path)]
    first = _depth_file(path, rows[0])
    with _Video(path / "rgb.mp4") as video:
        size = int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
    color = median_camera(str(path), size, each)
    depth = resized(str(path), color, header_size(str(first), read_bytes(first)))
    imu = _table(path / "imu.csv", _IMU) if (path / "imu.csv").is_file() else []
    return Recording(
        kind="Stray Scanner folder",
        color=StreamCamera(color),
        depth=StreamCamera(depth),
        T_color_depth=np.eye(4),
        depth_scale=_MILLIMETRES,
        items=_items(path, rows, imu, color, depth, options.confidence),
        images=2 * len(rows),
        truth=ARKIT_TRUTH,
        source={"confidence": options.confidence},
    )


def _check_inside(path: Path, names: Sequence[str]) -> None:
    """Raises UserError where one of these files is there, but by a link to what lies outside."""
    for name in names:
        if (path / name).is_file():
            listed_file(path, path.resolve(), name, str(path), "copy the folder again")


def _table(path: Path, wanted: Sequence[str]) -> list[dict[str, float]]:
    """Rows of a CSV with a header, whatever the spaces in it. Raises UserError."""
    lines = list(csv.reader(read_text(path).splitlines()))
    names = [name.strip() for name in lines[0]] if lines else []
    if missing := [name for name in wanted if name not in names]:
        raise UserError(f"{path}: has no column {missing[0]!r}; there are {', '.join(names)[:200]!r}")
    found = []
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        row = {}
        for name, text in zip(names, line, strict=False):
            try:
                row[name] = float(text)
            except ValueError:
                row[name] = math.nan
        needed = [*wanted, *(_INTRINSICS if "fx" in names else ())]
        if not all(math.isfinite(row.get(name, math.nan)) for name in needed if name not in _POSE):
            raise UserError(f"{path} line {number}: expected numbers for {', '.join(needed)}")
        if abs(row["timestamp"]) > MAX_STAMP_S or not 0 <= row.get("frame", 0.0) < _MOST_FRAMES:
            raise UserError(f"{path} line {number}: no recording has that time or number of a frame: it is damaged")
        found.append({name: math.nan for name in names} | row)
    return found


def _matrix(path: Path) -> list[float]:
    file = path / "camera_matrix.csv"
    try:
        K = np.array(read_text(file).replace(",", " ").split(), float).reshape(3, 3)
    except ValueError:
        raise UserError(f"{file}: expected the nine numbers of a camera matrix") from None
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]


class _Video:
    """A video that OpenCV can read, released at the end. Raises UserError."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            if file.read(8)[4:] not in _FIRST_BOXES:
                raise UserError(f"{path}: is no MP4 video: copy it again")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what is wrong is reported here, in one line
        before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
            if not self._capture.isOpened():
                raise UserError(f"{path}: cannot be read as a video: it is damaged, or OpenCV has no decoder for it")
        finally:
            cv2.utils.logging.setLogLevel(before)
        # Pixels as they were encoded: odometry.csv, the intrinsics and depth are about those.
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)

    def __enter__(self) -> Any:
        return self._capture

    def __exit__(self, *_: object) -> None:
        self._capture.release()


def _depth_file(path: Path, row: dict[str, float]) -> Path:
    number = f"{int(row['frame']):06d}"
    _check_inside(path, (f"depth/{number}.png", f"confidence/{number}.png"))
    if (path / "depth" / f"{number}.npy").is_file():
        raise UserError(f"{path}: depth in .npy, of an old version of the app: export it again")
    return path / "depth" / f"{number}.png"


def _items(
    path: Path, rows: Sequence[dict[str, float]], imu: Sequence[dict[str, float]], color: Camera, depth: Camera,
    confidence: int,
) -> Iterator[Item]:  # fmt: skip
    for sample in imu:
        values = [sample[name] for name in _IMU]
        yield ImuSample(_ns(values[0]), (values[4], values[5], values[6]), (values[1], values[2], values[3]))
    with _Video(path / "rgb.mp4") as video:
        for k, row in enumerate(rows):
            ok, bgr = video.read()
            if not ok and k == 0:
                raise UserError(f"{path / 'rgb.mp4'}: holds no frame that can be decoded")
            if not ok:
                return
            check_size(f"{path / 'rgb.mp4'}: frame {k}", (bgr.shape[1], bgr.shape[0]), color)
            stamp_ns = _ns(row["timestamp"])
            yield RecordedImage("color", stamp_ns, encode_png(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)))
            yield RecordedPose(stamp_ns, pose_of([row[n] for n in _POSE[3:]], [row[n] for n in _POSE[:3]]))
            if "fx" in row:
                yield from intrinsics_items(stamp_ns, (row["fx"], row["fy"], row["cx"], row["cy"]), color, depth)
            file = _depth_file(path, row)
            if file.is_file():  # a phone that is busy leaves some out
                yield RecordedImage("depth", stamp_ns, _depth(path, file, depth, confidence))


def _depth(path: Path, file: Path, camera: Camera, confidence: int) -> bytes:
    """The PNG as it is, or without what is less certain. Raises UserError."""
    png = read_bytes(file)
    if fault := png_fault(png):
        raise UserError(f"{file}: is not a whole PNG ({fault}): copy it again")
    check_size(str(file), header_size(str(file), png), camera)
    if (png[24], png[25]) != (16, 0):
        raise UserError(f"{file}: is not 16-bit grey")
    beside = path / "confidence" / file.name
    if not confidence or not beside.is_file():
        return png
    known = decode(str(beside), read_bytes(beside))
    check_size(str(beside), (known.shape[1], known.shape[0]), camera)
    units: FloatArray = decode(str(file), png)
    return encode_png(np.where(known >= confidence, units, 0).astype(np.uint16))


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
