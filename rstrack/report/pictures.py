"""Which frame a report shows, and its pictures: colour, depth, what the rolling shutter did to it; and maps."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import read_bytes
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import project_rolling
from rsgen.geometry.spline import Spline
from rstrack.bench.experiments.pictures import MeshPicture
from rstrack.data.dataset import Dataset
from rstrack.data.rig import Image, Rig
from rstrack.metrics.run_evaluate import Tracked
from rstrack.report.page import Block, ImageRow, Note, PageImage, Slider
from rstrack.view import jpeg, world_points

# Of maps to be compared with a slider: more than of photographs, for the differences are small.
_SLIDER_WIDTH = 720

_TWINS = {"global_middle": "middle", "global_first": "first", "global_last": "last"}
# Where nothing was measured.
_NOTHING = 128
# Pixels between the samples of a coarser depth image, which are filled from their neighbours.
_FILL_STEPS = 3


def frame_panels(tracked: Tracked, dataset: Dataset, width: int = 640) -> tuple[Block, ...]:
    """The frame of the fastest motion: colour and depth. Raises UserError if an image cannot be read."""
    k = _frame_to_show(tracked, dataset)
    frame = dataset.frame(0 if k is None else k)
    depth, low, high = colored_depth(frame.depth.pixels)
    at = f"frame {k or 0}"
    items = [
        PageImage(
            jpeg_uri(image.pixels, width),
            f"Colour, {at}, {image.stamp - tracked.begin_s:.3f} s",
            f"colour image of {at}",
        )
        for image in frame.colors
    ]
    t = frame.depth.stamp - tracked.begin_s
    caption = f"Depth, {at}, {t:.3f} s: {low:.2f} m (dark) to {high:.2f} m (bright); grey: not measured"
    return (ImageRow((*items, PageImage(jpeg_uri(depth, width), caption, f"depth image of {at}"))),)


def shutter_sliders(tracked: Tracked, dataset: Dataset, width: int = 640) -> tuple[Block, ...]:
    """The frame of the fastest motion against its global-shutter twin, and against what the estimate makes of it.

    Raises UserError if an image cannot be read.
    """
    if dataset.rig.color_shutter.readout_s == 0.0:
        return (Note("The colour images have a global shutter: there is nothing to compare."),)
    blocks: list[Block] = []
    k = _frame_to_show(tracked, dataset)
    if k is None:
        return (Note("No frame has a colour image to compare."),)
    i = dataset.groups[k][0]
    at = f"frame {k}, {dataset.color_stamps[i] - tracked.begin_s:.3f} s"
    sequence = dataset.sequence
    twin = next((name for name in _TWINS if sequence is not None and name in sequence.truth_images), None)
    if sequence is not None and twin is not None:
        is_sharp = "sharp" in sequence.truth_images
        rolling = sequence.truth("sharp", i) if is_sharp else sequence.color(i)
        kind = "Both without blur and noise." if is_sharp else "The global-shutter one has neither blur nor noise."
        blocks.append(
            Slider(
                f"Rolling against global shutter, {at}",
                PageImage(jpeg_uri(rolling, width), "rolling shutter", f"{at} with a rolling shutter"),
                PageImage(jpeg_uri(sequence.truth(twin, i), width), "global shutter", f"{at} with a global shutter"),
                f"Right: the exact twin of the renderer, all lines at the time of the {_TWINS[twin]} one. {kind}",
            )
        )
    elif sequence is not None:
        blocks.append(
            Note("This sequence has no exact global-shutter images: render it with truth.global_shutter: [middle] in "
                 "its config and they will be compared here.")
        )  # fmt: skip
    spline = tracked.estimate.spline
    if spline is not None and _covered(tracked, dataset)[k]:
        image = dataset.frame(k)
        color = image.colors[0]
        blocks.append(
            Slider(
                f"As recorded, and rectified with the estimated motion, {at}",
                PageImage(jpeg_uri(color.pixels, width), "as recorded", f"{at} as recorded"),
                PageImage(
                    jpeg_uri(rectified(dataset.rig, spline, image.depth, color), width), "rectified", f"{at} rectified"
                ),
                "Right: the same image as a global shutter at the middle line's time would show it, from the estimated "
                "pose of every line and the measured depth. Grey: not known.",
            )
        )
    return tuple(blocks)


def map_pictures(picture: MeshPicture, width: int) -> tuple[Block, ...]:
    """The maps of a sequence side by side, `width` px each, and each of the others against the first.

    Raises UserError if the picture cannot be read.
    """
    image = _read_jpeg(picture.path)
    n, (w, h) = len(picture.methods), picture.panel_px
    step = w if n == 1 else (image.shape[1] - w) // (n - 1)
    panels = [image[-h:, k * step : k * step + w] for k in range(n)]
    if any(panel.shape[:2] != (h, w) for panel in panels):
        raise UserError(f"{picture.path}: is not of the size that was drawn: delete it and run 'rstrack bench' again")
    named = list(zip(panels, picture.labels, strict=True))
    blocks: list[Block] = [ImageRow(tuple(_map(panel, label, width) for panel, label in named))]
    first, *others = [_map(panel, label, _SLIDER_WIDTH) for panel, label in named]
    for method, other in zip(picture.methods[1:], others, strict=True):
        blocks.append(Slider(f"Map with {method} against {picture.methods[0]}", other, first))
    return tuple(blocks)


# ---------------------------------------------------------------------------------------------------------------------


def _map(panel: npt.NDArray[np.uint8], label: str, width: int) -> PageImage:
    return PageImage(jpeg_uri(panel, width), label, f"map from above, {label}")


def _read_jpeg(path: Path) -> npt.NDArray[np.uint8]:
    """RGB (h, w, 3). Raises UserError."""
    image = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{path}: is not a whole JPEG: delete it and run 'rstrack bench' again")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _frame_to_show(tracked: Tracked, dataset: Dataset) -> int | None:
    """The fastest of the frames with a colour image, if possible one that the estimate covers."""
    with_color = np.array([bool(group) for group in dataset.groups])
    among = np.flatnonzero(with_color & _covered(tracked, dataset))
    if not len(among):
        among = np.flatnonzero(with_color)
    motion = dataset.truth if dataset.truth is not None else tracked.estimate.spline
    return _fastest(dataset, among, motion) if len(among) else None


def _covered(tracked: Tracked, dataset: Dataset) -> npt.NDArray[np.bool_]:
    """Whether the estimated spline covers the readouts of each frame (n,), its first colour image included."""
    rig, estimate = dataset.rig, tracked.estimate
    first = np.array(
        [dataset.color_stamps[g[0]] if g else s for g, s in zip(dataset.groups, dataset.stamps, strict=True)]
    )
    covered = np.ones(len(dataset), dtype=bool)
    for stamps, shutter in ((dataset.stamps, rig.depth_shutter), (first, rig.color_shutter)):
        begin = stamps - 0.5 * shutter.exposure_s
        covered &= estimate.spline_covers(begin) & estimate.spline_covers(begin + shutter.readout_s)
    return covered


def _fastest(dataset: Dataset, among: npt.NDArray[np.int64], motion: Spline | None) -> int:
    """Of the frames `among` (k,), the one in which the camera turns and moves most while it is read out.

    Movement counts as turning would that shifts a point at two metres as far. Without a spline: the middle one.
    """
    stamps = dataset.stamps[among]
    if motion is None or not len(among):
        return int(among[len(among) // 2]) if len(among) else 0
    middle = np.clip(stamps + 0.5 * dataset.rig.depth_shutter.readout_s, motion.t_begin, motion.t_end)
    velocity = motion.velocity(middle)
    shift = np.linalg.norm(velocity[:, :3], axis=1) / 2.0 + np.linalg.norm(velocity[:, 3:], axis=1)
    return int(among[np.argmax(shift)])


def jpeg_uri(image: npt.NDArray[np.uint8], width: int = 640) -> str:
    """An RGB image (h, w, 3) as a data URI, made smaller if it is wider than `width` pixels."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg(image, width)).decode("ascii")


def colored_depth(z: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.uint8], float, float]:
    """Planar z (h, w) in m as RGB (h, w, 3), grey where it is 0; and the depths in m of dark and bright."""
    seen = z > 0.0
    low, high = (float(v) for v in np.percentile(z[seen], [1.0, 99.0])) if seen.any() else (0.0, 1.0)
    scaled = np.clip((z - low) / max(high - low, 1e-6), 0.0, 1.0)
    image = cv2.applyColorMap(np.rint(255.0 * scaled).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.where(seen[..., None], cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8(_NOTHING)), low, high


def rectified(rig: Rig, spline: Spline, depth: Image, color: Image) -> npt.NDArray[np.uint8]:
    """The colour image (h, w, 3) as a global shutter at its middle line's time would have taken it; grey where unknown.

    spline: T_world_depth(t), which must cover both readouts. The measured depth, each point moved by its own line's
    pose, is seen from the middle line's pose; each pixel's point is then looked up in the rolling-shutter image, where
    equation (3) of the paper puts it.
    """
    camera, shutter = rig.color_camera, rig.color_shutter
    middle = shutter.line_mid_time(color.stamp, (shutter.line_count(camera) - 1) / 2, camera)
    T_world_color = spline.pose(middle) @ se3.inverse(rig.T_color_depth)
    p_world = world_points(spline, rig.depth_camera, rig.depth_shutter, depth, 1)
    p_world = p_world[np.isfinite(p_world).all(axis=-1)]
    z = _nearest_z(camera, se3.transform(se3.inverse(T_world_color), p_world))
    known = z > 0.0
    there = se3.transform(T_world_color, camera.backproject(camera.pixel_grid()[known], z[known]))
    uv = np.full((*z.shape, 2), -10.0, np.float32)
    found, _, valid = project_rolling(spline, rig.T_color_depth, camera, shutter, color.stamp, there, iterations=4)
    uv[known] = np.where(valid[:, None], found, -10.0)
    grey = (_NOTHING, _NOTHING, _NOTHING)
    image = cv2.remap(
        color.pixels, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=grey
    )
    # At the border the interpolation mixes the picture with what lies outside.
    image[(uv < 0.0).any(axis=-1)] = _NOTHING
    return np.asarray(image, np.uint8)


# ---------------------------------------------------------------------------------------------------------------------


def _nearest_z(camera: Camera, p_cam: FloatArray) -> npt.NDArray[np.float64]:
    """Planar z (h, w) of the nearest of the points (n, 3) in each pixel, small holes filled with the nearest beside."""
    uv, _ = camera.project(p_cam)
    inside = camera.contains(uv)
    x, y = np.rint(uv[inside]).astype(np.int64).T
    inverse = np.zeros((camera.height, camera.width))
    np.maximum.at(inverse, (y, x), 1.0 / p_cam[inside, 2])
    for _ in range(_FILL_STEPS):
        inverse = np.where(inverse > 0.0, inverse, cv2.dilate(inverse, np.ones((3, 3), np.uint8)))
    return np.where(inverse > 0.0, 1.0 / np.where(inverse > 0.0, inverse, 1.0), 0.0)
