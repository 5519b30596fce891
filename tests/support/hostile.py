"""What hostile files are made of: systematic damage to any bytes, and small files that unpack to a great deal."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

MB = 1 << 20


def damaged(data: bytes, seed: int) -> Iterator[tuple[str, bytes]]:
    """Ways to damage any file: cut at several places, bits flipped, counts made huge, words turned round, and so on."""
    rng = np.random.default_rng([seed, len(data)])
    size = len(data)
    yield "cut after 1 byte", data[:1]
    for percent in (10, 50, 90):
        yield f"cut at {percent} %", data[: size * percent // 100]
    yield "last byte gone", data[:-1]
    for k in range(3):
        out = bytearray(data)
        # Headers stand at the beginning, directories at the end; pixels fill the middle.
        low, high = ((0, min(200, size)), (max(0, size - 200), size), (0, size))[k]
        for at in rng.integers(low, high, 1 + k):
            out[at] ^= 1 << int(rng.integers(8))
        yield f"bits flipped {k}", bytes(out)
    for k, at in enumerate((4, 12, int(rng.integers(0, max(1, size - 8))))):
        run = (b"\xff" * 8, b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff\xff\xff\xff\x7f")[k]
        yield f"a huge number at {at}", (data[:at] + run + data[at + len(run) :])[:size]
    words = np.frombuffer(data[: size // 4 * 4], "<u4").byteswap().tobytes()
    yield "the other byte order", words + data[len(words) :]
    yield "twice", data + data
    yield "zeros", bytes(size)


def zeros_deflated(megabytes: int, window: int = 15) -> bytes:
    """Zlib's stream (window -15: raw deflate) of that many MB of zeros: the same few bytes again and again."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = packer.compress(bytes(MB)) + packer.flush(zlib.Z_FULL_FLUSH)
    raw = first * megabytes + b"\x03\x00"
    if window < 0:
        return raw
    return b"\x78\xda" + raw + struct.pack(">I", (megabytes * MB % 65521) << 16 | 1)


def png(width: int, height: int, depth: int, color: int, idat: bytes) -> bytes:
    """A PNG with right checksums, whatever is in it. depth: bits; color: PNG's colour type."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)), (b"IDAT", idat), (b"IEND", b"")]
    chunks = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def png_bomb(gray16: bool) -> bytes:
    """A valid PNG of 16000x14000, 430 MB or more of pixels, in 0.7 MB or so."""
    width, height = 16000, 14000
    row = 1 + (2 if gray16 else 3) * width
    return png(width, height, 16 if gray16 else 8, 0 if gray16 else 2, zeros_deflated(row * height // MB + 1))


def jpeg_of(data: bytes, width: int, height: int) -> bytes:
    """A JPEG whose header says another size than its pixels fill."""
    at = next(data.index(marker) for marker in (b"\xff\xc0", b"\xff\xc2") if marker in data)
    return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


def zip_bomb(names: dict[str, bytes], bomb: str, megabytes: int, head: bytes = b"") -> bytes:
    """A zip with these files, and one that unpacks to `head` and that many MB of zeros; the directory is true."""
    body, directory = b"", b""
    deflated = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = deflated.compress(head) + deflated.flush(zlib.Z_FULL_FLUSH) + zeros_deflated(megabytes, -15)
    crc = zlib.crc32(head)
    for _ in range(megabytes):
        crc = zlib.crc32(_ZEROS, crc)
    entries = [(name, 0, data, len(data), zlib.crc32(data)) for name, data in names.items()]
    for name, method, packed, size, crc32 in [*entries, (bomb, 8, start, len(head) + megabytes * MB, crc)]:
        common = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 33, crc32, len(packed), size, len(name), 0)
        directory += b"PK\x01\x02" + struct.pack("<H", 20) + common + struct.pack("<HHHII", 0, 0, 0, 0, len(body))
        directory += name.encode()
        body += b"PK\x03\x04" + common + name.encode() + packed
    count = len(names) + 1
    return body + directory + b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, count, count, len(directory), len(body), 0)


_ZEROS = bytes(MB)


def npy_head(shape: str, kind: str = "<f8") -> bytes:
    """The head of a .npy file that claims a shape."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def sparse(path: Path, gigabytes: int = 8) -> None:
    """A file that takes no room on the disk and that much in memory."""
    with path.open("r+b" if path.exists() else "wb") as file:
        os.truncate(file.fileno(), gigabytes << 30)


DOUBLING = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 64))
"""A few lines of YAML that stand for 2**64 values."""

LAUGHS = (
    '<?xml version="1.0"?><!DOCTYPE s [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    + "]>"
)
"""A DTD in which &a11; stands for 200 GB."""
