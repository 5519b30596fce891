"""Writes docs/gallery.md and its pictures, of the rooms and sensors that benchmarks/gallery.yaml lists.

python -m benchmarks.gallery                     # the text
python -m benchmarks.gallery --render            # and the pictures: an hour on two cores, mostly for baking light
python -m benchmarks.gallery --render kinect tof # of these only; sequences are kept in out/gallery
"""

from __future__ import annotations

import io
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image

from rsgen.array_types import ByteArray, Float32Array
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_yaml
from rsgen.sequence.reader import Sequence as RenderedSequence
from rsgen.sequence.reader import read_sequence

ROOT = Path(__file__).parents[1]
PAGE, PICTURES = ROOT / "docs/gallery.md", ROOT / "docs/gallery"
WIDTH, HEIGHT, GAP, QUALITY = 280, 210, 4, 78
"""Of a panel and of what is between two, px, and of the JPEG: all pictures together stay below 400 kB."""
_HEAD = """\
# Gallery

What `rsgen` renders: each picture is one frame, and below it stands the command that renders it. Written by
`python -m benchmarks.gallery` from `benchmarks/gallery.yaml`: change nothing here. The first frame of a room takes some
minutes, since its light is baked then and kept. Without `--frames` the whole sequence is rendered.
"""
_SECTIONS = {
    "rooms": "Rooms\n\nColour on the left, exact depth on the right (dark is near, white has none).",
    "sensors": "Sensors and labels\n\nAll settings can be combined, in any room: [the config](format.md#a-config).",
}


@dataclass(frozen=True)
class Entry:
    """A picture: a frame of a config with some settings (dotted names), drawn as two panels of its middle 1/zoom."""

    name: str
    title: str
    text: str
    config: str
    frame: int
    set: dict[str, Any]
    panels: tuple[str, str]
    zoom: int

    @property
    def command(self) -> list[str]:
        """Words of the command that renders it."""
        words = ["rsgen", "render", self.config, "--frames", f"{self.frame}:{self.frame + 1}"]
        return [*words, *(word for name, value in self.set.items() for word in (f"--{name}", str(value)))]


def entries() -> dict[str, list[Entry]]:
    """What gallery.yaml lists, by section. Raises UserError: it cannot be read."""
    listed = read_yaml(Path(__file__).with_suffix(".yaml"))
    defaults = {"set": {}, "panels": ("color", "exact_depth"), "zoom": 1}
    return {section: [Entry(**{**defaults, **entry}) for entry in listed[section]] for section in _SECTIONS}


def page() -> str:
    """All of docs/gallery.md; the divisions are a grid on the site, and nothing elsewhere."""
    lines = [_HEAD]
    for section, listed in entries().items():
        lines += [f"## {_SECTIONS[section]}\n", '<div class="gallery" markdown>\n']
        for entry in listed:
            lines += ["<div markdown>\n", f"### {entry.title}\n", f"![{entry.title}](gallery/{entry.name}.jpg)\n"]
            lines += [f"{entry.text}\n", f"```\n{_folded(entry.command)}\n```\n", "</div>\n"]
        lines.append("</div>\n")
    return "\n".join(lines).rstrip() + "\n"


def picture(entry: Entry, sequence: RenderedSequence) -> bytes:
    """A JPEG of the sequence's first image: the entry's two panels beside each other."""
    panels = [_resized(_panel(name, sequence), entry.zoom) for name in entry.panels]
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    written = io.BytesIO()
    Image.fromarray(np.hstack([panels[0], gap, panels[1]])).save(written, "JPEG", quality=QUALITY, optimize=True)
    return written.getvalue()


def render(entry: Entry) -> None:
    """Render an entry's frame, unless it is there, and write its picture. Raises UserError, CalledProcessError."""
    out = ROOT / "out/gallery" / entry.name
    subprocess.run([sys.executable, "-m", *entry.command, "--out", str(out)], cwd=ROOT, check=True)
    atomic_write(PICTURES / f"{entry.name}.jpg", picture(entry, read_sequence(out)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    known = {entry.name: entry for listed in entries().values() for entry in listed}
    names = given[1:] or list(known)
    if given[:1] not in ([], ["--render"]) or not set(names) <= set(known):
        print(f"usage: python -m benchmarks.gallery [--render [{' | '.join(known)}] ...]", file=sys.stderr)
        return 2
    try:
        for name in names if given else []:
            render(known[name])
        atomic_write(PAGE, page().encode())
    except (UserError, subprocess.CalledProcessError) as error:
        print(f"gallery: {error}", file=sys.stderr)
        return 2
    return 0


# ---------------------------------------------------------------------------------------------------------------------


def _folded(words: list[str]) -> str:
    """A command in lines that fit a narrow page: an option and its value stay together."""
    head, options = words[:3], words[3:]
    pairs = [shlex.join(options[i : i + 2]) for i in range(0, len(options), 2)]
    return " \\\n    ".join([" ".join(head) + " " + pairs[0], *pairs[1:]])


def _panel(name: str, sequence: RenderedSequence) -> ByteArray:
    """Image (h, w, 3) of the sequence's first frame."""
    if name == "color":
        return sequence.color(0)
    if name in ("depth", "exact_depth"):
        return _colored(sequence.depth(0) if name == "depth" else sequence.truth_depth(0), sequence.truth_depth(0))
    if name == "moving":
        return _tinted(sequence.color(0), sequence.object_ids("color", 0))
    if name == "difference":
        return _signed(sequence.color(0).mean(axis=-1) - sequence.truth("global_middle", 0).mean(axis=-1))
    image = sequence.truth("color" if name == "clean" else name, 0)
    return _flow(image) if name.startswith("flow") else image


def _colored(z: Float32Array, exact: Float32Array) -> ByteArray:
    """Depth z (h, w), m, as colours from near to far in the range of the exact one; white where there is none."""
    low, high = np.percentile(exact[exact > 0], [1, 99])
    colors: npt.NDArray[Any] = matplotlib.colormaps["viridis"](np.clip((z - low) / (high - low), 0, 1))[..., :3]
    return np.where(z[..., None] > 0, 255 * colors, 255).astype(np.uint8)


def _signed(difference: npt.NDArray[np.float64]) -> ByteArray:
    """Grey levels (h, w) as red where above 0 and blue where below."""
    most = max(float(np.percentile(np.abs(difference), 99)), 1.0)
    colors: npt.NDArray[Any] = matplotlib.colormaps["RdBu_r"](0.5 + 0.5 * np.clip(difference / most, -1, 1))[..., :3]
    return (255 * colors).astype(np.uint8)


def _tinted(image: ByteArray, ids: npt.NDArray[np.uint8]) -> ByteArray:
    """The image (h, w, 3) in grey, with the things of each number (h, w) in a colour of their own."""
    grey = np.repeat(image.mean(axis=-1, keepdims=True), 3, axis=-1)
    colors = 255 * np.array(matplotlib.colormaps["tab10"].colors)  # type: ignore[attr-defined]
    return np.where(ids[..., None] > 0, 0.35 * grey + 0.65 * colors[ids], grey).astype(np.uint8)


def _flow(flow: Float32Array) -> ByteArray:
    """Flow (h, w, 3), u v valid, px, as hue for the direction and saturation for the length; black where invalid."""
    length, angle = cv2.cartToPolar(flow[..., 0], flow[..., 1], angleInDegrees=True)
    shown = flow[..., 2] > 0
    most = np.percentile(length[shown], 99)
    hsv = np.stack([angle / 2, 255 * np.clip(length / most, 0, 1), np.where(shown, 255, 0)], axis=-1)
    return cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB).astype(np.uint8)


def _resized(image: ByteArray, zoom: int) -> ByteArray:
    """The middle 1/zoom of the image (h, w, 3), in a panel's size."""
    top, left = (n * (zoom - 1) // (2 * zoom) for n in image.shape[:2])
    middle = image[top : top + image.shape[0] // zoom, left : left + image.shape[1] // zoom]
    return cv2.resize(middle, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.uint8)


if __name__ == "__main__":
    sys.exit(main())
