"""Depth for each colour image, in the colour camera's pixels: linked where the sequence has it so, else warped."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsgen.console.progress import Progress
from rsgen.files import atomic_write
from rsgen.formats.export.folder import place_images
from rsgen.image_codecs import encode_png
from rsgen.produce.writer import quantise
from rsgen.sensors.depth import register_depth
from rsgen.sequence.reader import Sequence

NOTHING = "nothing.png"
"""All zeros: for colour images that no depth image was taken with."""


def aligned_depth(
    sequence: Sequence, folder: Path, copy: bool, progress: Progress, share: tuple[float, float]
) -> list[str]:
    """Write depth images into `folder`, 16-bit in the sequence's units; returns the file name for each colour image.

    Of each colour image the depth image that is nearest in time, within half a period of the slower stream. Links (or
    copies with `copy`) where depth has the colour camera's pixels: registered, or one camera for both; else warped by
    geometry alone, as `export registered` does. share: of the whole export's progress. Raises UserError.
    """
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    nearest = np.abs(depth.stamps - color.stamps[:, None]).argmin(axis=1)
    apart = np.abs(depth.stamps[nearest] - color.stamps)
    paired = apart <= 0.5 / min(color.rate_hz, depth.rate_hz)
    used = np.unique(nearest[paired])
    sources = [depth.paths[i] for i in used]
    if has_color_pixels(sequence):
        place_images(sources, [folder / path.name for path in sources], copy, progress, share)
    else:
        rays = depth.camera.unproject(depth.camera.pixel_grid())
        for count, i in enumerate(used, 1):
            z = register_depth(rays, sequence.depth(int(i)), color.camera, sequence.T_color_depth)
            atomic_write(folder / depth.paths[i].name, encode_png(quantise(z, depth.depth_scale)))
            progress("export", share[0] + (share[1] - share[0]) * count / len(used), depth.paths[i].name)
    if not paired.all():
        atomic_write(folder / NOTHING, encode_png(np.zeros((color.camera.height, color.camera.width), np.uint16)))
    return [depth.paths[i].name if found else NOTHING for i, found in zip(nearest, paired, strict=True)]


def has_color_pixels(sequence: Sequence) -> bool:
    """Whether the images in depth/ are in the colour camera's pixels."""
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    one_camera = color.camera == depth.camera and bool((sequence.T_color_depth == np.eye(4)).all())
    return depth.registered or one_camera
