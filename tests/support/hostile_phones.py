"""Hostile recordings of phones, and of ScanNet."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hostile
import numpy as np
import recordings
from hostile_cases import (
    CONTENT,
    Base,
    Case,
    beside,
    both,
    imported,
    linked,
    of_8_gb,
    patched,
    piped,
    replaced_by,
    text_edited,
)

from rsgen.image_codecs import encode_png


def phones(folder: Path) -> Iterator[Case]:
    folder.mkdir(parents=True, exist_ok=True)
    sens = Base("phones", recordings.write_sens(folder / "scene.sens", CONTENT), imported)
    r3d = Base("phones", recordings.write_r3d(folder / "one.r3d", CONTENT), imported)
    stray = Base("phones", recordings.write_stray(folder / "scan", CONTENT), imported)
    yield from sens.damaged("")
    yield sens.case("8 GB of nothing behind", of_8_gb(""), False)
    for at, name in ((4, "name"), (12 + 15 + 4 * 71, "frames")):
        yield sens.case(f"2^63 bytes of {name}", patched(at, b"\xff" * 7 + b"\x7f"))
    yield sens.case("NaN for a camera", patched(12 + 15, b"\x00\x00\xc0\x7f" * 16))
    yield sens.case("infinite extrinsics", patched(12 + 15 + 64, b"\x00\x00\x80\x7f" * 16))
    yield sens.case("depth of 60000x60000", patched(12 + 15 + 4 * 66, b"\x60\xea\x00\x00" * 2))
    yield from r3d.damaged("")
    yield from _zips(r3d)
    for inside, every in (("odometry.csv", 1), ("rgb.mp4", 2), ("depth/000001.png", 2), ("camera_matrix.csv", 3)):
        yield from stray.damaged(inside, every)
    yield from stray.damaged("imu.csv", 3)
    for number in ("nan", "1e300", "-7", "2.5", "../../beside/secret", "9" * 400):
        yield stray.case(f"frame {number[:20]}", text_edited("odometry.csv", "000000", number), number == "nan")
    yield stray.case("infinite intrinsics", text_edited("odometry.csv", "31.0", "inf"))
    yield stray.case("absurd stamps", text_edited("odometry.csv", "100.0", "1e300"))
    outside = encode_png(np.full((15, 20), 4321, np.uint16))
    for inside, data in (("depth/000001.png", outside), ("confidence/000001.png", outside), ("rgb.mp4", b"")):
        write = beside("outside.bin", data or (stray.whole / "rgb.mp4").read_bytes())
        yield stray.case(f"{inside} lies outside", both(write, linked(inside, _up(inside))))
    for inside in ("odometry.csv", "camera_matrix.csv", "imu.csv", "depth/000001.png"):
        yield stray.case(f"{inside} is a device", linked(inside, "/dev/zero"), inside == "odometry.csv")
        yield stray.case(f"{inside} is a pipe", piped(inside), inside in ("odometry.csv",))
    yield stray.case("8 GB of table", of_8_gb("odometry.csv"))
    yield stray.case("8 GB of depth", of_8_gb("depth/000000.png"))
    yield stray.case("a depth of 430 MB", replaced_by("depth/000000.png", hostile.png_bomb(True)))
    yield stray.case("a confidence of 430 MB", replaced_by("confidence/000000.png", hostile.png_bomb(True)))
    for name, text in (
        ("a playlist of another's video", "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n../../beside/v.mp4\n"),
        ("a list of another's video", "ffconcat version 1.0\nfile ../../beside/v.mp4\n"),
        ("a page of the web", "#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/v.mp4\n"),
    ):
        video = beside("v.mp4", (stray.whole / "rgb.mp4").read_bytes())
        yield stray.case(name, both(video, replaced_by("rgb.mp4", text.encode())))


def _up(inside: str) -> str:
    return "../" * inside.count("/") + "../../beside/outside.bin"


def _zips(r3d: Base) -> Iterator[Case]:
    import zipfile

    with zipfile.ZipFile(r3d.whole) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}

    def without(name: str) -> dict[str, bytes]:
        return {key: data for key, data in members.items() if key != name}

    for name in ("metadata", "rgbd/1.jpg", "rgbd/0.depth", "rgbd/0.conf"):
        bomb = hostile.zip_bomb(without(name), name, 600, members[name])
        yield r3d.case(f"{name} unpacks to 600 MB", replaced_by("", bomb))
    bomb = bytearray(hostile.zip_bomb(without("rgbd/1.jpg"), "rgbd/1.jpg", 600, members["rgbd/1.jpg"]))
    at = bomb.rindex(b"PK\x01\x02")
    bomb[at + 24 : at + 28] = (5000).to_bytes(4, "little")
    yield r3d.case("a directory that lies", replaced_by("", bytes(bomb)))
    for text in (b"[" * 50000, b'{"K": ' + b"[" * 50000, b'{"poses": [' + b"9" * 9000 + b"]}", b"\xff\xfe{}", b"null"):
        rest = without("metadata")
        yield r3d.case(f"metadata {text[:9]!r}", replaced_by("", hostile.zip_bomb(rest, "metadata", 0, text)))
