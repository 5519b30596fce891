"""Points on the scene's surface with their colours, and where which colour image shows them: a sparse model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import ByteArray, FloatArray, IntArray
from rsgen.console.progress import Progress
from rsgen.formats.export.poses.approximation import blur_centres, exact_points
from rsgen.geometry import se3
from rsgen.geometry.shutter import project_rolling
from rsgen.sequence.reader import Sequence

_FRAMES, _COLUMNS, _ROWS = 25, 16, 12  # depth images that points are taken from, and their grid
_DEPTH_SHARE = 0.01  # by how much a point's depth may differ from what the depth image shows there


@dataclass(frozen=True)
class SurfacePoints:
    """m points: p_world (m, 3) m, color (m, 3) sRGB. Of each of n images: which points it shows, and where.

    shown[k] (s,): numbers of points in colour image k; uv[k] (s, 2): their pixels, with its rolling shutter.
    """

    p_world: FloatArray
    color: ByteArray
    shown: tuple[IntArray, ...]
    uv: tuple[FloatArray, ...]


def surface_points(sequence: Sequence, progress: Progress, share: tuple[float, float]) -> SurfacePoints:
    """Points from the exact depth of some depth images, each seen by one colour image or more. Raises UserError.

    Visible is what the depth image that is nearest in time shows at the depth that the point has; colours are those of
    the first image that shows it. sequence: with the cameras that took it. share: of the whole export's progress.
    """
    color = sequence.streams["color"]
    p_world = _seeds(sequence)
    shown, uvs = [], []
    colors, colored = np.zeros((len(p_world), 3), np.uint8), np.zeros(len(p_world), bool)
    for k, stamp in enumerate(blur_centres(color)):
        near = _seen_by_depth(
            sequence, int(np.abs(sequence.streams["depth"].stamps - color.stamps[k]).argmin()), p_world
        )
        uv, _, valid = project_rolling(
            sequence.spline, sequence.T_color_depth, color.camera, color.shutter, stamp, p_world[near]
        )
        which, uv = near[valid], uv[valid]
        shown.append(which)
        uvs.append(uv)
        new = ~colored[which]
        if new.any():
            u, v = np.rint(uv[new]).astype(np.int64).T
            colors[which[new]] = sequence.color(k)[
                np.clip(v, 0, color.camera.height - 1), np.clip(u, 0, color.camera.width - 1)
            ]
            colored[which] = True
        progress("export", share[0] + (share[1] - share[0]) * (k + 1) / len(color.paths), color.paths[k].name)
    number = np.cumsum(colored) - 1
    return SurfacePoints(p_world[colored], colors[colored], tuple(number[which] for which in shown), tuple(uvs))


def _seeds(sequence: Sequence) -> FloatArray:
    depth = sequence.streams["depth"]
    frames = np.unique(np.linspace(0, len(depth.paths) - 1, _FRAMES).round().astype(np.int64))
    u, v = (
        np.unique((size * (np.arange(count) + 0.5) / count).astype(np.int64))
        for size, count in ((depth.camera.width, _COLUMNS), (depth.camera.height, _ROWS))
    )
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return np.concatenate([exact_points(sequence, int(k), grid)[0] for k in frames])


def _seen_by_depth(sequence: Sequence, k: int, p_world: FloatArray) -> IntArray:
    """Numbers (s,) of the points (m, 3) that lie on the surface that depth image k shows."""
    depth = sequence.streams["depth"]
    uv, t, valid = project_rolling(
        sequence.spline, np.eye(4), depth.camera, depth.shutter, blur_centres(depth)[k], p_world
    )
    which = np.flatnonzero(valid)
    z = se3.transform(se3.inverse(sequence.spline.pose(t[which])), p_world[which])[:, 2]
    u, v = np.rint(uv[which]).astype(np.int64).T
    image = sequence.truth_depth(k)
    on = image[np.clip(v, 0, image.shape[0] - 1), np.clip(u, 0, image.shape[1] - 1)]
    return which[np.abs(z - on) < _DEPTH_SHARE * z]
