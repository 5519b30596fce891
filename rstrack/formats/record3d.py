"""Record3D's .r3d, a zip: `metadata` (JSON), rgbd/N.jpg, rgbd/N.depth (float32, m) and N.conf packed with LZFSE."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, how_to_install
from rsgen.geometry.camera import Camera
from rsgen.image_codecs import encode_png
from rstrack.formats.pixels import compressed_color, header_size, units_of_metres
from rstrack.formats.recording import (
    ARKIT_TRUTH,
    FLOAT_DEPTH_SCALE,
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

# T_arkit_camera: coordinates of our camera in ARKit's.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_NAME = re.compile(r"rgbd/(\d{1,9})\.(jpg|depth|conf)")
# A file in the zip that unpacks to more is refused: they hold a photograph or 200 kB of depth.
_MOST_BYTES = 1 << 26
_LIDAR, _FACE = (192, 256), (640, 480)

Unpack = Callable[[bytes], bytes]


@dataclass(frozen=True)
class _Metadata:
    intrinsics: FloatArray
    poses: FloatArray
    stamps_ns: tuple[int, ...]
    depth_size: tuple[int, int]


def matches(path: Path) -> bool:
    """Whether it is a zip file."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) == b"PK\x03\x04"


def read(path: Path, options: ReadOptions) -> Recording:
    """The cameras of an .r3d file; frames are read as asked for.

    Nothing is unpacked to the disk. Raises UserError: damaged, or `pyliblzfse` is not installed.
    """
    unpack = _lzfse(path)
    with _opened(path) as archive:
        frames = _frames(path, archive)
        meta = _metadata(path, archive, len(frames))
        size = header_size(f"{path}: rgbd/{frames[0]}.jpg", _member(path, archive, f"rgbd/{frames[0]}.jpg"))
    color = median_camera(str(path), size, meta.intrinsics)
    depth = resized(str(path), color, meta.depth_size)
    return Recording(
        kind="Record3D recording",
        color=StreamCamera(color),
        depth=StreamCamera(depth),
        T_color_depth=np.eye(4),
        depth_scale=FLOAT_DEPTH_SCALE,
        items=_items(path, frames, meta, color, depth, unpack, options.confidence),
        images=2 * len(frames),
        truth=ARKIT_TRUTH,
        source={"confidence": options.confidence},
    )


def _lzfse(path: Path) -> Unpack:
    try:
        import liblzfse
    except ImportError:
        hint = how_to_install("record3d")
        raise UserError(f"{path}: depth of Record3D is packed with LZFSE: {hint}") from None
    unpack: Unpack = liblzfse.decompress
    return unpack


def _opened(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except Exception as error:  # what a damaged directory makes of zipfile
        raise UserError(f"{path}: is no whole zip file ({type(error).__name__}): export it again") from None


def _member(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        info = archive.getinfo(name)
        if info.file_size > _MOST_BYTES:
            raise UserError(f"{path}: {name} unpacks to {info.file_size} bytes: the file is damaged")
        with archive.open(info) as file:
            data = file.read(_MOST_BYTES + 1)
    except UserError:
        raise
    except KeyError:
        raise UserError(f"{path}: has no {name}: export it again") from None
    except Exception as error:
        raise UserError(f"{path}: {name} cannot be unpacked ({type(error).__name__}): export it again") from None
    if len(data) > _MOST_BYTES:
        raise UserError(f"{path}: {name} unpacks to more than it claims: the file is damaged")
    return data


def _frames(path: Path, archive: zipfile.ZipFile) -> list[int]:
    names = [match for name in archive.namelist() if (match := _NAME.fullmatch(name))]
    colors, depths = ({int(m[1]) for m in names if m[2] == ending} for ending in ("jpg", "depth"))
    if not colors or not depths:
        raise UserError(f"{path}: has no rgbd/N.jpg and rgbd/N.depth: it is no recording of Record3D")
    if missing := sorted(colors ^ depths)[:1]:
        raise UserError(
            f"{path}: frame {missing[0]} has no {'depth' if missing[0] in colors else 'colour'}: export it again"
        )
    return sorted(colors)


def _metadata(path: Path, archive: zipfile.ZipFile, count: int) -> _Metadata:
    where = f"{path}: metadata"
    try:
        data: dict[str, Any] = json.loads(_member(path, archive, "metadata"))
        K = np.array(data["K"], float).reshape(3, 3).T  # column by column
        one = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        each = data.get("perFrameIntrinsicCoeffs") or []
        intrinsics = np.array([row[:4] for row in each] if each else [one] * count, float).reshape(-1, 4)
        poses = np.array(data.get("poses") or np.full((count, 7), np.nan), float).reshape(-1, 7)
        times = data.get("frameTimestamps") or [k / float(data["fps"]) for k in range(count)]
        stamps_ns = tuple(round(1e9 * float(t)) + 10**9 for t in times)
        depth_size = (int(data["dw"]), int(data["dh"])) if "dw" in data else (0, 0)
    except UserError:
        raise
    except Exception as error:  # JSON of any shape
        raise UserError(f"{where} cannot be read ({type(error).__name__}): export the recording again") from None
    if not (len(intrinsics) == len(poses) == len(stamps_ns) == count) or not np.isfinite(intrinsics).all():
        found = f"{len(intrinsics)} intrinsics, {len(poses)} poses and {len(stamps_ns)} stamps"
        raise UserError(f"{where} has {found} for {count} images: export the recording again")
    if depth_size == (0, 0):  # versions before 1.4 leave it out
        depth_size = _LIDAR if data.get("cameraType", 1) == 1 else _FACE
    return _Metadata(intrinsics, poses, stamps_ns, depth_size)


def _items(
    path: Path, frames: list[int], meta: _Metadata, color: Camera, depth: Camera, unpack: Unpack, confidence: int
) -> Iterator[Item]:
    with _opened(path) as archive:
        names = set(archive.namelist())
        for k, number in enumerate(frames):
            stamp_ns, where = meta.stamps_ns[k], f"{path}: rgbd/{number}"
            data, ending = compressed_color(f"{where}.jpg", _member(path, archive, f"rgbd/{number}.jpg"), color)
            yield RecordedImage("color", stamp_ns, data, ending)
            fx, fy, cx, cy = meta.intrinsics[k].tolist()
            yield from intrinsics_items(stamp_ns, (fx, fy, cx, cy), color, depth)
            yield RecordedPose(stamp_ns, pose_of(meta.poses[k, :4], meta.poses[k, 4:]) @ _FLIP)
            z = _floats(f"{where}.depth", _member(path, archive, f"rgbd/{number}.depth"), depth, np.float32, unpack)
            if confidence and f"rgbd/{number}.conf" in names:
                conf = _floats(f"{where}.conf", _member(path, archive, f"rgbd/{number}.conf"), depth, np.uint8, unpack)
                z = np.where(conf >= confidence, z, 0.0)
            yield RecordedImage("depth", stamp_ns, encode_png(units_of_metres(z)))


def _floats(where: str, packed: bytes, camera: Camera, kind: type[np.generic], unpack: Unpack) -> FloatArray:
    try:
        data = unpack(packed)
    except Exception as error:  # of a library in C
        raise UserError(f"{where} cannot be unpacked ({type(error).__name__}): export the recording again") from None
    values = np.frombuffer(data[: len(data) // np.dtype(kind).itemsize * np.dtype(kind).itemsize], kind)
    if values.size != camera.width * camera.height:
        raise UserError(f"{where} holds {values.size} values, but depth is {camera.width}x{camera.height}")
    return np.asarray(values.reshape(camera.height, camera.width), float)
