"""PNG, EXR and NumPy files: the same bytes for the same data on every run, and read back strictly or not at all.

Every reader raises UserError naming the file if it is missing, truncated, corrupt or of another size or type; PNG and
EXR carry checksums that are compared before any decoder sees the data, which keeps the decoders quiet too.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from rsgen.errors import UserError
from rsgen.files import read_bytes
from rsgen.inputs import EXR_START, MOST_BYTES, MOST_PIXELS, PNG_START, exr_size, image_size

# Level 1 with run-length matching: 12 ms and 17 % smaller than the default strategy (15 ms) on a noisy 640x480 picture.
_PNG_COLOR = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
# Smooth 16-bit depth is the other way round: the default strategy is quicker (5 ms) and half the size.
_PNG_DEPTH = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT]
# EXR has no checksum of its own (blocks that do not shrink are stored raw), so the file carries the CRC-32 of all its
# bytes, taken with this field at zero, in a header attribute that other readers ignore.
_CRC_NAME = "rsgenCrc32"
_CRC_FIELD = _CRC_NAME.encode() + b"\0string\0\x08\0\0\0"
_CRC_EMPTY = b"00000000"
_MOST_CHANNELS = 64


def encode_png(image: np.ndarray) -> bytes:
    """PNG of an (h, w, 3) uint8 RGB, (h, w) uint8 grey or (h, w) uint16 image."""
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        ok, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _PNG_COLOR)
    elif image.ndim == 2 and image.dtype in (np.uint8, np.uint16):
        ok, data = cv2.imencode(".png", image, _PNG_DEPTH if image.dtype == np.uint16 else _PNG_COLOR)
    else:
        raise ValueError(
            f"a PNG is written from (h, w, 3) uint8 or (h, w) uint8 or uint16, not {image.shape} {image.dtype}"
        )
    if not ok:
        raise ValueError("cv2 could not encode a PNG")
    return data.tobytes()


def encode_exr(image: np.ndarray, channels: tuple[str, ...] = ("Z",)) -> bytes:
    """Lossless OpenEXR of a float32 image (h, w), or (h, w, n) for n channels, with a checksum of the whole file."""
    planes = image[..., None] if image.ndim == 2 else image
    if planes.ndim != 3 or planes.shape[2] != len(channels) or image.dtype != np.float32:
        raise ValueError(f"an EXR of {channels} is not written from {image.shape} {image.dtype}")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,  # every reader knows it; ZSTD would halve size and time
        "type": OpenEXR.scanlineimage,
        _CRC_NAME: _CRC_EMPTY.decode(),
    }
    stream = io.BytesIO()
    with OpenEXR.File(header, {c: np.ascontiguousarray(planes[..., i]) for i, c in enumerate(channels)}) as file:
        file.write(stream)
    data = stream.getvalue()
    at = data.index(_CRC_FIELD) + len(_CRC_FIELD)
    return data[:at] + b"%08x" % zlib.crc32(data) + data[at + len(_CRC_EMPTY) :]


def encode_npy(array: np.ndarray) -> bytes:
    """Bytes of a .npy file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def encode_npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Bytes of an uncompressed .npz file, entries dated 1980 whatever the clock says."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), encode_npy(np.asarray(array)))
    return stream.getvalue()


def read_png(path: Path, shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray:
    """An RGB (h, w, 3) uint8, or (h, w) uint8 or uint16 PNG of exactly that shape and type. Raises UserError."""
    data = read_bytes(path)
    if (fault := png_fault(data)) is not None:
        raise _damaged(path, "PNG", fault)
    width, height = image_size(data) or (0, 0)
    if width * height > max(MOST_PIXELS, shape[0] * shape[1]):  # it would be decoded for nothing
        raise _damaged(path, "PNG", f"it claims {width}x{height} pixels")
    if (image := decoded(data)) is None:
        raise _damaged(path, "PNG", "cannot be decoded")
    _expect(path, image, shape, dtype)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image


def read_exr(path: Path, shape: tuple[int, int], channels: tuple[str, ...] = ("Z",)) -> np.ndarray:
    """Channels of an EXR of exactly `shape` as float32 (h, w), or (h, w, n) if they are several. Raises UserError."""
    data = read_bytes(path)
    if not data.startswith(EXR_START):
        raise _damaged(path, "EXR", "wrong signature")
    at = data.find(_CRC_FIELD) + len(_CRC_FIELD)
    if at >= len(_CRC_FIELD):  # absent in files of other programs
        stored, end = data[at : at + len(_CRC_EMPTY)], at + len(_CRC_EMPTY)
        if stored != b"%08x" % zlib.crc32(data[end:], zlib.crc32(_CRC_EMPTY, zlib.crc32(data[:at]))):
            raise _damaged(path, "EXR", "checksum differs")
    try:
        height, width, count = exr_size(data)
        if count > _MOST_CHANNELS:
            raise _damaged(path, "EXR", f"it claims {count} channels")
        _expect(path, np.broadcast_to(np.float32(0), (height, width)), shape, np.float32)
        with OpenEXR.File(io.BytesIO(data)) as file:
            stored = file.channels()
            planes = [np.array(stored[name].pixels) for name in channels]
    except (RuntimeError, ValueError, LookupError, TypeError, MemoryError, OSError, struct.error):
        raise _damaged(path, "EXR", "cannot be decoded") from None
    for plane in planes:
        _expect(path, plane, shape, np.float32)
    return planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)


def read_npy(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """A finite float64 .npy of exactly that shape. Raises UserError."""
    data = read_bytes(path, max(MOST_BYTES, 8 * math.prod(shape) + 4096))
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, OSError, EOFError, MemoryError, SyntaxError, zipfile.BadZipFile):
        raise _damaged(path, "NumPy", "cannot be decoded") from None
    if not isinstance(array, np.ndarray):
        raise _damaged(path, "NumPy", "holds more than one array")
    _expect(path, array, shape, np.float64)
    if not np.isfinite(array).all():
        raise UserError(f"{path}: holds values that are not finite")
    return array


def decoded(data: bytes) -> np.ndarray | None:
    """A picture as OpenCV has it, of bytes without a fault; None where it cannot be decoded."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def png_fault(data: bytes) -> str | None:
    """What is wrong with a PNG's structure or checksums, None if nothing is: decoders say it on stderr, or not."""
    if not data.startswith(PNG_START):
        return "wrong signature"
    view, at = memoryview(data), len(PNG_START)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(view[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return "checksum differs"
        if data[at + 4 : at + 8] == b"IEND":
            return None if end == len(data) else "data after its end"
        at = end
    return "truncated"


def _expect(path: Path, array: np.ndarray, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    if array.shape != shape or array.dtype != dtype:
        found, wanted = f"{_size(array.shape)} {array.dtype}", f"{_size(shape)} {np.dtype(dtype)}"
        raise UserError(f"{path}: is {found}, but sequence.yaml asks for {wanted}")


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(str(n) for n in shape)


def _damaged(path: Path, kind: str, why: str) -> UserError:
    return UserError(f"{path}: is not a whole {kind} file ({why}): delete it and render again")
