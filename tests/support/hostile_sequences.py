"""Hostile sequences, runs, trajectories and configs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import fuzzing
import hostile
import numpy as np
import synthetic
import tiny
from hostile_cases import (
    Base,
    Case,
    Edit,
    Read,
    linked,
    of_8_gb,
    piped,
    replaced_by,
    sequence_read,
    text_edited,
)

from rsgen.config.config import load_config
from rsgen.image_codecs import encode_exr, encode_npy, encode_npz
from rsgen.sequence.reader import read_sequence
from rsgen.sequence.trajectory import read_trajectory
from rstrack.data.estimate import read_estimate, write_estimate


def sequences(folder: Path) -> Iterator[Case]:
    folder.mkdir(parents=True, exist_ok=True)
    made = synthetic.make_sequence(folder / "seq", synthetic.make_config(16, 12), 5)
    base = Base("sequences", made, sequence_read)
    sequence = read_sequence(base.whole)
    for inside in ("sequence.yaml", "rgb.txt", "spline.npz", "truth/rows_color.npy", "truth/depth/000001.exr"):
        yield from base.damaged(inside, 2)
    for inside in ("sequence.yaml", "depth.txt", "spline.npz", "truth/rows_depth.npy", "truth/depth/000000.exr"):
        yield base.case(f"{inside} is a device", linked(inside, "/dev/zero"))
        yield base.case(f"{inside} is a pipe", piped(inside))
        yield base.case(f"{inside} of 8 GB", of_8_gb(inside))
    for name in ("truth/rows_depth.npy", "spline.npz"):
        for kind, shape in (
            ("<f8", "(5, 12, 99999999999)"),
            ("<f8", "(-1, 12, 7)"),
            ("|O", "(5, 12, 7)"),
            ("<M8[s]", "(3,)"),
        ):
            head = hostile.npy_head(shape, kind)
            yield base.case(f"{name} {kind} {shape}", replaced_by(name, head if name[0] == "t" else _npz(head)))
    head = hostile.npy_head("(4000000, 4, 4)")
    parts = {f"{key}.npy": encode_npy(np.array(value)) for key, value in (("t0", 0.0), ("dt", 0.05))}
    bomb = hostile.zip_bomb(parts, "control_points.npy", 490, head)
    yield base.case("a spline of 490 MB", replaced_by("spline.npz", bomb))
    yield base.case("a picture of 670 MB", replaced_by("rgb/000000.png", hostile.png_bomb(False)))
    yield base.case("a depth of 430 MB", replaced_by("depth/000000.png", hostile.png_bomb(True)))
    for name, (width, height) in (("a truth of 590 MB", (14000, 11000)), ("a truth of one line", (16, 1))):
        exr = encode_exr(np.zeros((height, width), np.float32))
        yield base.case(name, replaced_by("truth/depth/000000.exr", exr))
    many = encode_exr(np.zeros((12, 16, 900), np.float32), (*(f"c{k:03d}" for k in range(899)), "Z"))
    yield base.case("a truth of 900 channels", replaced_by("truth/depth/000000.exr", many), False)
    yield base.case("a row of NaN", replaced_by("truth/rows_depth.npy", encode_npy(np.full((5, 12, 7), np.nan))))
    yield base.case(
        "rows of float32", replaced_by("truth/rows_depth.npy", encode_npy(np.zeros((5, 12, 7), np.float32)))
    )
    swapped = np.load(base.whole / "truth/rows_depth.npy").astype(">f8")
    yield base.case("rows of the other byte order", replaced_by("truth/rows_depth.npy", encode_npy(swapped)))
    for entry in ("streams.color.size", "streams.depth.frames", "streams.color.rate_hz", "objects", "T_color_depth"):
        yield base.case(f"{entry} = absurd", _entry(entry))
    yield base.case(
        "objects outside", text_edited("sequence.yaml", "name: ", "objects: ['../../../beside/secret']\nname: ")
    )
    run = folder / "run"
    stamps = sequence.streams["depth"].stamps
    write_estimate(run, stamps, sequence.spline.pose(stamps), sequence.spline, {"lost": 0})
    runs = Base("sequences", run, lambda path, out: read_estimate(path))
    for inside in ("trajectory.txt", "spline.npz", "run.json"):
        yield from runs.damaged(inside, 3)
        yield runs.case(f"{inside} is a device", linked(inside, "/dev/zero"))
        yield runs.case(f"{inside} of 8 GB", of_8_gb(inside))
    yield runs.case("very deep", replaced_by("run.json", b'{"a":' * 50000))
    yield runs.case("masks of 600 MB", replaced_by("moving.npz", hostile.zip_bomb({}, "packed.npy", 600, head)))
    mask = {"frames": [0], "ends": [hostile.MB], "shape": [30000, 30000], "stride": 1}
    packed = np.frombuffer(hostile.zeros_deflated(600), np.uint8)
    arrays = {name: np.array(value) for name, value in mask.items()} | {"packed": packed}
    arrays["ends"] = np.array([len(packed)])
    yield runs.case("a mask of 600 MB", replaced_by("moving.npz", encode_npz(arrays)))


def _npz(head: bytes) -> bytes:
    parts = {f"{key}.npy": encode_npy(np.array(value)) for key, value in (("t0", 0.0), ("dt", 0.05))}
    return hostile.zip_bomb(parts, "control_points.npy", 0, head)


def _entry(name: str) -> Edit:
    def edit(path: Path) -> None:
        import yaml

        data = yaml.safe_load((path / "sequence.yaml").read_text())
        changed = fuzzing.with_entry(data, name, [10**9] * 2 if name.endswith("size") else 1e300)
        (path / "sequence.yaml").write_bytes(fuzzing.yaml_bytes(changed))

    return edit


def trajectories(folder: Path) -> Iterator[Case]:
    folder.mkdir(parents=True, exist_ok=True)
    read: Read = lambda path, out: read_trajectory(path)  # noqa: E731
    rows = tiny.poses(8)
    tum = tiny.write_trajectory(folder / "motion.txt", 8)
    icl = folder / "lr.gt.freiburg"
    icl.write_text("\n".join(" ".join(map(repr, [k + 1, *row[1:].tolist()])) for k, row in enumerate(rows)) + "\n")
    euroc = folder / "data.csv"
    lines = (
        ",".join(map(repr, [1_403_636_580_838_555_648 + round(1e9 * r[0]), *r[1:4], r[7], *r[4:7]]))
        for r in rows.tolist()
    )
    euroc.write_text("#t\n" + "\n".join(lines) + "\n")
    for file in (tum, icl, euroc):
        yield from Base("trajectories", file, read).damaged("", 2)
    base = Base("trajectories", tum, read)
    for line in ("nan 0 0 0 0 0 0 1", "9 inf 0 0 0 0 0 1", "9 0 0 0 0 0 0 0", "9 0 0 0", "1e400 0 0 0 0 0 0 1",
                 "9 1e308 1e308 0 0 0 0 1", "9 0 0 0 1e200 0 0 1", "9" * 5000 + " 0 0 0 0 0 0 1",
                 "9 0 0 0 0 0 0 1_0"):  # fmt: skip
        yield base.case(line[:30], lambda path, line=line: path.write_text(path.read_text() + line + "\n"))  # type: ignore[misc]
    yield base.case("8 GB", of_8_gb(""))
    yield base.case("a device", lambda path: (path.unlink(), path.symlink_to("/dev/zero")))
    yield base.case("a pipe", lambda path: (path.unlink(), os.mkfifo(path)))


def configs(folder: Path) -> Iterator[Case]:
    folder.mkdir(parents=True, exist_ok=True)
    base = Base("configs", tiny.write_config(folder, 6), lambda path, out: load_config(path))
    yield from base.damaged("")
    yield base.case("8 GB", of_8_gb(""))
    yield base.case("a device", lambda path: (path.unlink(), path.symlink_to("/dev/zero")))
    yield base.case("a pipe", lambda path: (path.unlink(), os.mkfifo(path)))
    yield base.case("aliases of aliases", lambda path: path.write_text(path.read_text() + hostile.DOUBLING + "s: *a63"))
    yield base.case("very deep", lambda path: path.write_text(path.read_text() + "seed: " + "{a: " * 20000))
