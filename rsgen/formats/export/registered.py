"""Registered depth, as drivers deliver it: warped into the colour camera by geometry alone, motion ignored.

Writes a plain TUM RGB-D folder. A row of a registered image mixes pixels of neighbouring depth rows; where the cameras
lie beside each other their order hardly changes, and camera.yaml states whose rows' times they have.
"""

from __future__ import annotations

from pathlib import Path

from rsgen.console.progress import Progress, no_progress
from rsgen.files import atomic_write, encode_yaml, write_lines
from rsgen.formats.export.shared import (
    DEFAULTS,
    ExportOptions,
    color_truth,
    depth_warper,
    new_folder,
    part_of,
    place_images,
    registered_cameras,
)
from rsgen.sequence.format import associate, pose_lines
from rsgen.sequence.images import Sequence

_MARK = "registered to the colour camera"


def export_registered(
    sequence: Sequence, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress
) -> str:
    """Write the new folder `out` in TUM's layout with registered depth; returns one line.

    rgb/ holds hard links, or copies with options.copy. camera.yaml (as rstrack reads it) states that depth has the
    colour camera, and which camera with which shutter it was warped from. groundtruth.txt holds poses of the colour
    camera at true times, or what the sequence's motion capture reports of it. Stamps are the sequence's listed ones;
    depth that is registered already is linked like colour. Warped, and stated in camera.yaml, is what the sequence
    declares; the poses are the true colour camera's. Raises UserError if `out` is not empty, or an image cannot be
    read.
    """
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    sequence.depth(0)  # checks its size, before memory is taken for that of sequence.yaml
    new_folder(out, "rgb", "depth")
    place_images(color.paths, out / "rgb", options.copy, part_of(progress, 0.0, 0.1))
    filled, image = 0.0, sequence.depth if depth.registered else depth_warper(sequence, out / "depth")
    if depth.registered:
        place_images(depth.paths, out / "depth", options.copy, part_of(progress, 0.1, 0.2))
    for k, path in enumerate(depth.paths):
        filled += float((image(k) > 0).mean()) / len(depth.paths)
        progress("export", 0.2 + 0.8 * (k + 1) / len(depth.paths), path.name)

    entries = {
        folder: [f"{t:.9f} {folder}/{path.name}" for t, path in zip(stream.listed, stream.paths, strict=True)]
        for folder, stream in (("rgb", color), ("depth", depth))
    }
    write_lines(out / "rgb.txt", [f"# colour images of {sequence.name}", "# stamp path", *entries["rgb"]])
    write_lines(out / "depth.txt", [f"# depth images of {sequence.name}, {_MARK}", "# stamp path", *entries["depth"]])
    pairs = associate(color.listed, depth.listed, 0.5 / min(color.rate_hz, depth.rate_hz))
    write_lines(out / "associations.txt", [f"{entries['rgb'][i]} {entries['depth'][j]}" for i, j in pairs])
    rows, reported = color_truth(sequence)
    write_lines(out / "groundtruth.txt", pose_lines(f"ground truth of {sequence.name}: T_world_color{reported}", rows))
    atomic_write(out / "camera.yaml", f"# depth is {_MARK}\n".encode() + encode_yaml(registered_cameras(sequence)))
    return f"{out}: {len(depth.paths)} depth images {_MARK}; {100 * filled:.0f} % of pixels have depth"
