"""Where the files of a stream are in a sequence's folder: of format 1, colour and depth; of format 2, any camera's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class StreamFiles:
    """Paths within the folder. truth: in which each kind of exact image has a folder; exact_depth: of depth cameras."""

    images: str
    listing: str
    rows: str
    frame_table: str
    truth: str
    exact_depth: str
    object_ids: str
    labels: str
    boxes: str

    def truth_image(self, name: str, channels: Sequence[str], stem: str) -> str:
        """File of an exact image; without EXR channels it is a PNG."""
        return f"{self.truth}/{name}/{stem}.{'exr' if channels else 'png'}"


FILES = {
    "color": StreamFiles(
        "rgb", "rgb.txt", "truth/rows_color.npy", "truth/frames_color.txt", "truth", "", "truth/object_ids",
        "truth/labels", "truth/boxes_color.csv",
    ),
    "depth": StreamFiles(
        "depth", "depth.txt", "truth/rows_depth.npy", "truth/frames_depth.txt", "truth", "truth/depth",
        "truth/depth_object_ids", "truth/depth_labels", "truth/boxes_depth.csv",
    ),
}  # fmt: skip
"""Of a sequence of format 1."""


def rig_files(name: str) -> StreamFiles:
    """Of a camera of a rig, format 2."""
    truth = f"truth/{name}"
    return StreamFiles(
        name,
        f"{name}.txt",
        f"{truth}/rows.npy",
        f"{truth}/frames.txt",
        truth,
        f"{truth}/depth",
        f"{truth}/object_ids",
        f"{truth}/labels",
        f"{truth}/boxes.csv",
    )
