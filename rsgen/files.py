"""Whole files only: atomic writes, and images, arrays and YAML that are read back strictly or not at all.

Every encoder returns the same bytes for the same data on every run, so that a resumed sequence equals an uninterrupted
one. Every reader raises UserError naming the file if it is missing, truncated, corrupt or of another size or type;
PNG and EXR carry checksums that are compared before any decoder sees the data, which keeps the decoders quiet too.
"""

from __future__ import annotations

import errno
import io
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import yaml

from rsgen.errors import UserError
from rsgen.inputs import EXR_START, MOST_BYTES, MOST_PIXELS, PNG_START, check_input, exr_size, image_size

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

_MOST_YAML_VALUES, _DEEPEST_YAML = 1_000_000, 200


# ---------------------------------------------------------------------------------------------------------------------
# writing


def atomic_write(path: Path, data: bytes) -> None:
    """Write `data` to `path` so that the file is there whole or not at all, whenever the process is killed.

    Raises UserError (full disk, no permission, ...); the temporary file is removed and what was there before stays.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            with temporary.open("wb") as file:
                file.write(data)
            os.replace(temporary, path)  # noqa: PTH105 - one name for tests to break
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise write_error(path, error) from None


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A name beside `path`, of the same suffix, for libraries that write files themselves.

    Once the block ends well, what was written there is at `path`; else it is deleted. Raises UserError for an OSError.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise write_error(path, error) from None
    finally:
        temporary.unlink(missing_ok=True)


def write_error(path: Path, error: OSError) -> UserError:
    """The one line for a failed write."""
    cure = {
        errno.EACCES: "make the folder writable",
        errno.EPERM: "make the folder writable",
        errno.EROFS: "that disk is read-only",
    }.get(error.errno or 0, "free space")
    return UserError(
        f"{path}: cannot be written ({_reason(error)}): {cure} or choose another --out, "
        "then run the same command again to resume"
    )


def remove_stale_temporaries(folder: Path) -> None:
    """Delete the temporary files that killed writers left in `folder` (those of living processes stay)."""
    for path in folder.glob(".*.tmp"):
        writer = path.name.split(".")[-2]
        if writer.isdigit() and not _is_running(int(writer)):
            path.unlink(missing_ok=True)


def is_temporary(path: Path) -> bool:
    """True for the names that `atomic_write` uses while it writes."""
    return path.name.startswith(".") and path.name.endswith(".tmp")


def encode_png(image: np.ndarray) -> bytes:
    """PNG of an (h, w, 3) uint8 RGB or (h, w) uint16 image."""
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        ok, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _PNG_COLOR)
    elif image.ndim == 2 and image.dtype == np.uint16:
        ok, data = cv2.imencode(".png", image, _PNG_DEPTH)
    else:
        raise ValueError(f"a PNG is written from (h, w, 3) uint8 or (h, w) uint16, not {image.shape} {image.dtype}")
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


def encode_yaml(data: Mapping[str, Any]) -> bytes:
    """Block-style YAML in the given order, lists of numbers on one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=120, allow_unicode=True).encode()


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: yaml.SafeDumper, data: list[Any]) -> yaml.Node:
    flat = all(isinstance(item, int | float) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


_Dumper.add_representer(list, _represent_list)


# ---------------------------------------------------------------------------------------------------------------------
# reading


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The whole file, of `most` bytes at most. Raises UserError if it cannot be read, is empty, or no file."""
    check_input(path, most)
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({_reason(error)})") from None
    if not data:
        raise UserError(f"{path}: is empty")
    return data


def read_text(path: Path) -> str:
    """The whole file as UTF-8. Raises UserError."""
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not a text file") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML mapping. Raises UserError."""
    try:
        data = parse_yaml(read_text(path))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        raise UserError(f"{path}:{f' line {mark.line + 1}' if mark else ''} is not valid YAML") from None
    if not isinstance(data, dict):
        raise UserError(f"{path}: expected a mapping")
    return data


def parse_yaml(text: str) -> Any:
    """What `yaml.safe_load` returns. Raises its YAMLError, ValueError or RecursionError.

    Refused as well, as a YAMLError, are aliases that stand for more than a million values or for themselves: a few
    lines of them would keep whatever walks the data busy for ever.
    """
    try:
        # libyaml is seven times as quick; not every build of PyYAML has it.
        fast = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        return _parsed(text, fast) if _is_flat(text, fast) else _parsed(text, yaml.SafeLoader)
    except (yaml.YAMLError, ValueError):
        return _parsed(text, yaml.SafeLoader)  # which says better what is wrong, and where


def _parsed(text: str, kind: Any) -> Any:
    loader = kind(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _values(node, {}) > _MOST_YAML_VALUES:
            raise yaml.MarkedYAMLError(problem="aliases repeat too much of it", problem_mark=node.start_mark)
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _is_flat(text: str, kind: Any) -> bool:
    """Whether collections are nested so little that libyaml's composer does not overflow the stack."""
    loader, depth, deepest = kind(text), 0, 0
    try:
        while loader.check_event() and deepest <= _DEEPEST_YAML:
            event = loader.get_event()
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            deepest = max(deepest, depth)
    finally:
        loader.dispose()
    return deepest <= _DEEPEST_YAML


def _values(node: yaml.Node, known: dict[int, float]) -> float:
    """Number of values that a node stands for, aliases written out; infinite if it holds itself."""
    if id(node) not in known:
        known[id(node)] = math.inf  # until it is counted: who meets it on the way meets it within itself
        inner = [] if isinstance(node, yaml.ScalarNode) else node.value
        parts = [part for item in inner for part in (item if isinstance(item, tuple) else (item,))]
        known[id(node)] = 1 + sum(_values(part, known) for part in parts)
    return known[id(node)]


def read_png(path: Path, shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray:
    """An RGB (h, w, 3) uint8 or (h, w) uint16 PNG of exactly that shape and type. Raises UserError."""
    data = read_bytes(path)
    if (fault := png_fault(data)) is not None:
        raise _damaged(path, "PNG", fault)
    _check_pixels(path, data, shape)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
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


def _check_pixels(path: Path, data: bytes, shape: tuple[int, ...]) -> None:
    """Raises UserError where a picture is far larger than any of `shape` and would be decoded for nothing."""
    width, height = image_size(data) or (0, 0)
    if width * height > max(MOST_PIXELS, shape[0] * shape[1]):
        raise _damaged(path, "PNG", f"it claims {width}x{height} pixels")


def _expect(path: Path, array: np.ndarray, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    if array.shape != shape or array.dtype != dtype:
        found, wanted = f"{_size(array.shape)} {array.dtype}", f"{_size(shape)} {np.dtype(dtype)}"
        raise UserError(f"{path}: is {found}, but sequence.yaml asks for {wanted}")


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(str(n) for n in shape)


def _damaged(path: Path, kind: str, why: str) -> UserError:
    return UserError(f"{path}: is not a whole {kind} file ({why}): delete it and render again")


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def listed_file(root: Path, real_root: Path, path: str, where: str, missing: str) -> Path:
    """The file `path` that a listing names, which has to lie in `root` even once symbolic links are followed.

    real_root: root, resolved. where: the listing's line, missing: what to do if there is no such file, for messages.
    Raises UserError.
    """
    file = root / path
    try:
        real = file.resolve()
        exists = real.is_file()
    except (OSError, ValueError, RuntimeError):
        raise UserError(f"{where}: {path[:60]!r} is not a usable path") from None
    if Path(path).is_absolute() or ".." in Path(path).parts or not real.is_relative_to(real_root):
        raise UserError(f"{where}: path {path[:200]!r} leaves the folder")
    if not exists:
        raise UserError(f"{where}: {file} is missing: {missing}")
    return file
