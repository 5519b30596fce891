"""Ways to spoil the inputs and the sequence of `tiny` in the working directory, and what has to be said of each."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rsgen.image_codecs import encode_npz


def lines_of(path: Path) -> list[str]:
    return path.read_text().splitlines(keepends=True)


def replaced(name: str, text: str | bytes) -> Callable[[], object]:
    return lambda: Path(name).write_bytes(text if isinstance(text, bytes) else text.encode())


def edited(name: str, old: str, new: str) -> Callable[[], object]:
    def edit() -> None:
        text = Path(name).read_text()
        assert old in text
        Path(name).write_text(text.replace(old, new, 1))

    return edit


def field(section: str, **values: Any) -> Callable[[], object]:
    def edit() -> None:
        data = yaml.safe_load(Path("tiny.yaml").read_text())
        data[section].update(values)
        Path("tiny.yaml").write_text(yaml.safe_dump(data))

    return edit


def truncate_trajectory() -> None:
    text = Path("motion.txt").read_text()
    Path("motion.txt").write_text(text[: len(text) - 40])


def reverse_trajectory() -> None:
    Path("motion.txt").write_text("".join(reversed(lines_of(Path("motion.txt")))))


def unreadable(name: str) -> Callable[[], object]:
    """A link to itself: not even root can read that."""

    def make() -> None:
        Path(name).unlink()
        Path(name).symlink_to(name)

    return make


INPUTS: dict[str, tuple[Callable[[], object], list[str]]] = {
    "trajectory empty": (replaced("motion.txt", ""), ["motion.txt", "no poses"]),
    "trajectory cut off": (truncate_trajectory, ["motion.txt:6"]),
    "trajectory of a pose": (replaced("motion.txt", "0 0 0 0 0 0 0 1\n"), ["motion.txt", "1 poses"]),
    "trajectory backwards": (reverse_trajectory, ["motion.txt:2", "back in time"]),
    "trajectory of bytes": (replaced("motion.txt", b"\xff\xfe\x00\x01"), ["motion.txt"]),
    "trajectory in Latin-1": (replaced("motion.txt", b"# caf\xe9\n"), ["motion.txt:1"]),
    "trajectory unreadable": (unreadable("motion.txt"), ["motion.txt"]),
    "trajectory far away": (edited("motion.txt", "0.033333333 0.0", "0.033333333 23456.0"), ["motion.txt:3", " m:"]),
    "trajectory with NaN": (edited("motion.txt", "0.033333333 ", "0.033333333 nan "), ["motion.txt:3"]),
    "trajectory with infinity": (edited("motion.txt", "0.066666667 0.0", "0.066666667 1e999"), ["motion.txt:4"]),
    "scene not XML": (replaced("scene.xml", "<scene"), ["scene.xml"]),
    "scene empty": (replaced("scene.xml", ""), ["scene.xml"]),
    "scene of bytes": (replaced("scene.xml", b"\xff\x00\xfe"), ["scene.xml"]),
    "scene unreadable": (unreadable("scene.xml"), ["scene.xml"]),
    "scene without shapes": (replaced("scene.xml", '<scene version="3.0.0"></scene>'), ["scene.xml"]),
    "scene of an unknown plugin": (edited("scene.xml", 'type="sphere"', 'type="blob"'), ["scene.xml", "blob"]),
    "scene with an unknown property": (edited("scene.xml", 'name="radius"', 'name="radios"'), ["scene.xml", "radios"]),
    "scene with a missing texture": (lambda: Path("paper.png").unlink(), ["scene.xml", "paper.png"]),
    "scene with a broken texture": (replaced("paper.png", b"\x89PNG\r\n\x1a\n1234"), ["scene.xml"]),
    "scene with a broken reference": (edited("scene.xml", '<ref id="paper"/>', '<ref id="stone"/>'), ["stone"]),
    "mesh empty": (lambda: (replaced("m.ply", "")(), field("scene", file="m.ply")()), ["m.ply"]),
    "mesh not one": (lambda: (replaced("m.obj", "hello\n")(), field("scene", file="m.obj")()), ["m.obj"]),
    "config not YAML": (replaced("tiny.yaml", "name: [\n"), ["tiny.yaml", "YAML"]),
    "config a list": (replaced("tiny.yaml", "- 1\n"), ["tiny.yaml", "mapping"]),
    "config empty": (replaced("tiny.yaml", ""), ["tiny.yaml"]),
    "config of bytes": (replaced("tiny.yaml", b"name: \xff\xfe\n"), ["tiny.yaml", "not a text file"]),
    "config unreadable": (unreadable("tiny.yaml"), ["tiny.yaml", "cannot be read"]),
    "config without a scene": (edited("tiny.yaml", "scene:\n  file: scene.xml\n", ""), ["tiny.yaml", "scene: is req"]),
    "config with an unknown field": (field("color", colour=1), ["tiny.yaml", "color.colour: no such field"]),
    "config with a wrong type": (field("color", width="wide"), ["tiny.yaml", "color.width"]),
    "config with a negative readout": (field("depth", readout_s=-0.1), ["tiny.yaml", "depth.readout_s"]),
    "config with zero intrinsics": (field("color", intrinsics=[0, 0, 0, 0]), ["tiny.yaml", "color"]),
    "config named after a folder above": (edited("tiny.yaml", "name: tiny", "name: ../up"), ["tiny.yaml", "name"]),
}  # fmt: skip


def truncate(name: str) -> Callable[[], object]:
    return lambda: os.truncate(name, Path(name).stat().st_size // 2)


def remove(name: str) -> Callable[[], object]:
    return lambda: Path(name).unlink()


SEQUENCES: dict[str, tuple[Callable[[], object], str, str]] = {
    # what breaks it, what verify has to name, the commands that have to refuse it
    "no description": (remove("seq/sequence.yaml"), "sequence.yaml", "info compare preview"),
    "description cut off": (lambda: os.truncate("seq/sequence.yaml", 300), "sequence.yaml", "info compare preview"),
    "description of bytes": (replaced("seq/sequence.yaml", b"\xff\xfe"), "sequence.yaml", "info compare preview"),
    "another format": (edited("seq/sequence.yaml", "rsgen-sequence/1", "rsgen-sequence/9"), "format", "info preview"),
    "no listing": (remove("seq/rgb.txt"), "rgb.txt", "info compare preview"),
    "listing empty": (replaced("seq/depth.txt", ""), "depth.txt", "info compare preview"),
    "listing leaves the folder": (
        edited("seq/rgb.txt", "rgb/000001.png", "../paper.png"), "rgb.txt line 4", "info compare preview"
    ),
    "no spline": (remove("seq/spline.npz"), "spline.npz", "info compare preview"),
    "spline cut off": (truncate("seq/spline.npz"), "spline.npz", "info compare preview"),
    "spline of NaN": (
        lambda: Path("seq/spline.npz").write_bytes(
            encode_npz({"control_points": np.full((8, 4, 4), np.nan), "t0": np.array(0.0), "dt": np.array(0.05)})
        ),
        "spline.npz", "info compare preview",
    ),
    "colour missing": (remove("seq/rgb/000001.png"), "rgb/000001.png", "info compare preview"),
    "colour cut off": (truncate("seq/rgb/000001.png"), "rgb/000001.png", "compare preview"),
    "colour of another kind": (replaced("seq/rgb/000001.png", "<html>"), "rgb/000001.png", "compare preview"),
    "depth missing": (remove("seq/depth/000001.png"), "depth/000001.png", "info compare preview"),
    "depth cut off": (truncate("seq/depth/000001.png"), "depth/000001.png", "preview"),
    "exact depth missing": (remove("seq/truth/depth/000001.exr"), "truth/depth/000001.exr", "compare"),
    "exact depth cut off": (truncate("seq/truth/depth/000001.exr"), "truth/depth/000001.exr", "compare"),
    "rows cut off": (truncate("seq/truth/rows_depth.npy"), "rows_depth.npy", ""),
    "no scene": (remove("seq/scene.ply"), "scene.ply", ""),
    "origin of bytes": (replaced("seq/origin.yaml", b"\xff\x00"), "", "compare"),
    "origin a list": (replaced("seq/origin.yaml", "- 1\n"), "", "compare"),
    "origin elsewhere": (replaced("seq/origin.yaml", "scene: /nowhere/s.xml\n"), "", "compare"),
    "config not one": (edited("seq/sequence.yaml", "\nconfig:", "\nconfig: 3\nother:"), "config", "compare"),
    "config lost": (edited("seq/sequence.yaml", "\nconfig:", "\nother:"), "config", "compare"),
}  # fmt: skip
