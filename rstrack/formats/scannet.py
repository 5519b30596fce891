"""ScanNet's .sens files, version 4 (Dai et al., CVPR 2017; layout after SensReader in github.com/ScanNet/ScanNet).

A header with both cameras, then each frame: T_world_camera as 16 floats, stamps of colour and depth in microseconds,
sizes, a JPEG or PNG, and 16-bit depth packed with zlib. Poses were found by BundleFusion from the same images.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.image_codecs import encode_png
from rstrack.formats.pixels import compressed_color
from rstrack.formats.recording import Item, ReadOptions, RecordedImage, RecordedPose, Recording, StreamCamera, camera_of

_VERSION = 4
_HEADER = struct.Struct("<64f2i4If")
_FRAME = struct.Struct("<16f4Q")
_COLORS, _RAW_DEPTH, _ZLIB_DEPTH = (1, 2), 0, 1
_MOST_FRAMES = 10_000_000
_RATE_HZ = 30.0
_SKEW = 1e-2


@dataclass(frozen=True)
class _SensHeader:
    color: Camera
    depth: Camera
    T_color_depth: FloatArray
    depth_scale: float
    depth_kind: int
    frames: int
    begin: int
    sensor: str


def matches(path: Path) -> bool:
    """Whether it is a file that begins as version 4 of the format does."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(12)
    return path.suffix == ".sens" or (
        len(start) == 12 and struct.unpack("<IQ", start) < (_VERSION + 1, 256) and start[0] == 4
    )


def read(path: Path, _: ReadOptions) -> Recording:
    """The cameras of a .sens file, whose frames are all there; they are read as asked for. Raises UserError."""
    with path.open("rb") as file:
        head = _head(path, file)
        stamped = _walk(path, file, head)
    notes = () if stamped else (f"frames have no stamps: they are taken to be 1/{_RATE_HZ:g} s apart",)
    return Recording(
        kind="ScanNet .sens file",
        color=StreamCamera(head.color),
        depth=StreamCamera(head.depth),
        T_color_depth=head.T_color_depth,
        depth_scale=head.depth_scale,
        items=_items(path, head, stamped),
        images=2 * head.frames,
        truth="BundleFusion's poses, as ScanNet has them",
        notes=notes,
        source={"sensor": head.sensor},
    )


def _take(path: Path, file: BinaryIO, size: int, most: int) -> bytes:
    """The next bytes. Raises UserError where they are not there, or more than there can be."""
    data = file.read(size) if 0 <= size <= most else b""
    if len(data) != size:
        raise UserError(f"{path}: is damaged or cut short: copy it again")
    return data


def _head(path: Path, file: BinaryIO) -> _SensHeader:
    version, length = struct.unpack("<IQ", _take(path, file, 12, 12))
    if version != _VERSION:
        raise UserError(f"{path}: is no .sens file of version {_VERSION}")
    sensor = _take(path, file, length, 4096).decode("utf-8", "replace")
    values = _HEADER.unpack(_take(path, file, _HEADER.size, _HEADER.size))
    (frames,) = struct.unpack("<Q", _take(path, file, 8, 8))
    K_color, X_color, K_depth, X_depth = np.array(values[:64], float).reshape(4, 4, 4)
    color_kind, depth_kind, cw, ch, dw, dh, shift = values[64:]
    if color_kind not in _COLORS or depth_kind not in (_RAW_DEPTH, _ZLIB_DEPTH):
        raise UserError(
            f"{path}: colour of kind {color_kind}, depth of kind {depth_kind}: only JPEG or PNG, raw or zlib"
        )
    if not 0 < frames <= _MOST_FRAMES or not 1 <= shift < 1e6:
        raise UserError(f"{path}: {frames} frames with {shift:g} units per metre: the file is damaged")
    if not all(_is_rigid(T) for T in (X_color, X_depth)):
        raise UserError(f"{path}: its extrinsics are no rigid transforms: the file is damaged")
    color = camera_of(str(path), cw, ch, (K_color[0, 0], K_color[1, 1], K_color[0, 2], K_color[1, 2]), "", ())
    depth = camera_of(str(path), dw, dh, (K_depth[0, 0], K_depth[1, 1], K_depth[0, 2], K_depth[1, 2]), "", ())
    T_color_depth = se3.orthonormalise(np.linalg.inv(X_color) @ X_depth)
    return _SensHeader(color, depth, T_color_depth, float(shift), depth_kind, frames, file.tell(), sensor)


def _is_rigid(T: FloatArray) -> bool:
    if not np.isfinite(T).all() or np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-4:
        return False
    R = np.clip(T[:3, :3], -2, 2)
    return bool(np.abs(R.T @ R - np.eye(3)).max() < _SKEW and np.linalg.det(R) > 0)


def _walk(path: Path, file: BinaryIO, head: _SensHeader) -> bool:
    """Whether frames are stamped. Raises UserError where the file ends before the last frame does."""
    size, stamped = path.stat().st_size, False
    for _ in range(head.frames):
        frame = _FRAME.unpack(_take(path, file, _FRAME.size, _FRAME.size))
        color_us, depth_us, color_bytes, depth_bytes = frame[16:]
        if file.tell() + color_bytes + depth_bytes > size:
            raise UserError(f"{path}: is damaged or cut short: copy it again")
        file.seek(color_bytes + depth_bytes, 1)
        stamped |= bool(color_us or depth_us)
    return stamped


def _items(path: Path, head: _SensHeader, stamped: bool) -> Iterator[Item]:
    with path.open("rb") as file:
        file.seek(head.begin)
        for k in range(head.frames):
            frame = _FRAME.unpack(_take(path, file, _FRAME.size, _FRAME.size))
            color_us, depth_us, color_bytes, depth_bytes = frame[16:]
            if not stamped:
                color_us = depth_us = round(1e6 * (k + 1) / _RATE_HZ)
            where, most = f"{path}: frame {k}", path.stat().st_size
            if color_bytes:
                data, ending = compressed_color(where, _take(path, file, color_bytes, most), head.color)
                yield RecordedImage("color", 1000 * color_us, data, ending)
                T = np.array(frame[:16], float).reshape(4, 4)
                yield RecordedPose(1000 * color_us, _world_color(T, head))
            if depth_bytes:
                png = _depth(where, _take(path, file, depth_bytes, most), head)
                yield RecordedImage("depth", 1000 * depth_us, png)


def _world_color(T_world_depth: FloatArray, head: _SensHeader) -> FloatArray:
    """NaN where there is no pose: ScanNet writes −∞ for a frame that was lost."""
    if not _is_rigid(T_world_depth):
        return np.full((4, 4), np.nan)
    return se3.orthonormalise(T_world_depth) @ se3.inverse(head.T_color_depth)


def _depth(where: str, data: bytes, head: _SensHeader) -> bytes:
    wanted = 2 * head.depth.width * head.depth.height
    if head.depth_kind == _ZLIB_DEPTH:
        try:
            data = zlib.decompressobj().decompress(data, wanted + 1)
        except zlib.error:
            raise UserError(f"{where}: its depth cannot be unpacked: the file is damaged") from None
    if len(data) != wanted:
        raise UserError(f"{where}: its depth is not {head.depth.width}x{head.depth.height}: the file is damaged")
    return encode_png(np.frombuffer(data, "<u2").reshape(head.depth.height, head.depth.width).astype(np.uint16))
