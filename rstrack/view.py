"""A tracker's work as a rerun recording, live or in a file: what `rstrack track --view` shows.

with open_view(Path("run.rrd"), dataset.rig, dataset.name) as viewer:
    track(dataset, options, out, watch=viewer.see)

It shows what the tracker reports and changes nothing. Images are shown at a part of their size, and a few
times a second, so that the tracker hardly waits.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.console.rerun import recording_file, rerun
from rsgen.errors import UserError
from rsgen.files import make_folder
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Frame, Image, Rig

if TYPE_CHECKING:
    from rstrack.tracking.any_tracker import AnyTracker
    from rstrack.tracking.frame_report import FrameReport

TIMELINE = "time"
# Columns of images that are shown at most, and of those whose residuals and map are.
_WIDTH, _COARSE_WIDTH = 320, 80
# Seconds of the recording between images that are shown.
_EVERY_S = 0.1
# The path is drawn anew after so many frames, and once it is so many times as long.
_PATH_EVERY, _PATH_GROWTH = 10, 1.05
# Frames that are remembered until one of them turns out to be a keyframe.
_RECENT = 16
# Depth residuals from minus to plus so many of the track's σ, blue to red.
_SIGMAS = 3.0
_PATH_COLOR, _TRUE_COLOR = [230, 120, 30], [90, 160, 90]
_ROW_ITERATIONS = 3
# Neighbours whose depths differ by more than this part are on two sides of an edge.
_EDGE = 0.1


@contextmanager
def open_view(file: Path | None, rig: Rig, name: str) -> Iterator[Viewer]:
    """A viewer's window (file: None), or a recording `file` (.rrd) that is there, whole, once this ends well.

    Raises UserError: rerun is not installed, no window can be opened, the file has another suffix or is there already.
    """
    if file is None:
        rr = rerun("--view")
        recording = rr.RecordingStream("rstrack", recording_id=None)
        try:
            recording.spawn()
        except (OSError, RuntimeError) as error:
            raise UserError(f"--view: no window can be opened ({error}): give a file, --view run.rrd") from None
        yield Viewer(rr, recording, rig)
        recording.flush()
        return
    make_folder(file.parent, file)
    with recording_file(file, "rstrack", name, "--view") as (rr, recording):
        yield Viewer(rr, recording, rig)


@dataclass
class Viewer:
    """Logs to a recording of the module `rr` (rerun) what a tracker of such a rig does."""

    rr: Any
    recording: Any
    rig: Rig
    _recent: dict[int, Frame] = field(default_factory=dict)
    _path: list[FloatArray] = field(default_factory=list)
    _drawn: int = 0
    _shown_s: float = -np.inf
    _keyframe: tuple[int, Frame] | None = None

    def __post_init__(self) -> None:
        rr, log = self.rr, self.recording.log
        log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        for name, camera in (("depth", self.rig.depth_camera), ("color", self.rig.color_camera)):
            share = min(1.0, _WIDTH / camera.width)
            K = np.diag([share, share, 1.0]) @ camera.K
            size = [round(share * camera.width), round(share * camera.height)]
            lens = rr.Pinhole(
                image_from_camera=K, resolution=size, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.15
            )
            log(f"world/camera/{name}", lens, static=True)
        T = se3.inverse(self.rig.T_color_depth)
        log("world/camera/color", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)

    def see(self, index: int, frame: Frame, report: FrameReport, tracker: AnyTracker) -> None:
        """Frame number `index` has been fed, and this is what the tracker reports of it."""
        rr, log = self.rr, self.recording.log
        self.recording.set_time(TIMELINE, duration=frame.depth.stamp)
        self._recent[index] = frame
        if len(self._recent) > _RECENT:
            del self._recent[min(self._recent)]
        if report.lost:
            log("log", rr.TextLog(f"frame {index} is lost: {report.fault}", level="WARN"))
        for name, value in (
            ("sigma_depth_mm", 1e3 * report.sigma_depth_m), ("sigma_intensity", report.sigma_intensity),
            ("overlap", report.overlap), ("iterations", report.iterations),
        ):  # fmt: skip
            if np.isfinite(value):
                log(f"figures/{name}", rr.Scalars(float(value)))
        show = frame.depth.stamp >= self._shown_s + _EVERY_S
        if show:
            self._shown_s = frame.depth.stamp
            self._show(frame)
        spline = tracker.spline if (show or report.keyframe) and not report.lost else None
        if spline is not None:
            self._pose(spline, frame)
            self._renew(tracker.reference, spline)
            if show and self._keyframe is not None and self._keyframe[0] < index:
                self._residuals(spline, frame, self._keyframe[1].depth, report.sigma_depth_m)

    def corrected(self, T_world_depth: FloatArray) -> None:
        """The path (n, 4, 4) as it is in the end, with its loops closed; and all of it as it was found."""
        self._draw()
        path = self.rr.LineStrips3D([T_world_depth[:, :3, 3]], colors=[_TRUE_COLOR])
        self.recording.log("world/path_corrected", path, static=True)

    def _show(self, frame: Frame) -> None:
        rr, log = self.rr, self.recording.log
        if frame.colors:
            picture = rr.EncodedImage(contents=jpeg(frame.colors[0].pixels, _WIDTH), media_type="image/jpeg")
            log("world/camera/color/image", picture)
        stride = -(-frame.depth.pixels.shape[1] // _WIDTH)
        z_mm = np.clip(np.rint(1e3 * frame.depth.pixels[::stride, ::stride]), 0, 65535).astype(np.uint16)
        log("world/camera/depth/image", rr.DepthImage(z_mm, meter=1000.0))

    def _pose(self, spline: Spline, frame: Frame) -> None:
        shutter, camera = self.rig.depth_shutter, self.rig.depth_camera
        T = spline.pose(shutter.line_mid_time(frame.depth.stamp, 0.5 * (shutter.line_count(camera) - 1), camera))
        self.recording.log("world/camera", self.rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._path.append(T[:3, 3])
        if len(self._path) >= max(self._drawn + _PATH_EVERY, _PATH_GROWTH * self._drawn):
            self._draw()

    def _draw(self) -> None:
        self._drawn = len(self._path)
        self.recording.log("world/path", self.rr.LineStrips3D([np.array(self._path)], colors=[_PATH_COLOR]))

    def _renew(self, reference: int | None, spline: Spline) -> None:
        """Where another frame has become the keyframe, its points become part of the map."""
        if reference is None or reference not in self._recent:
            return
        if self._keyframe is not None and self._keyframe[0] == reference:
            return
        frame = self._recent[reference]
        self._keyframe = reference, frame
        camera, shutter = self.rig.depth_camera, self.rig.depth_shutter
        points = world_points(spline, camera, shutter, frame.depth, -(-camera.width // _COARSE_WIDTH))
        seen = np.isfinite(points).all(axis=-1)
        colors = self._colors(frame, points, spline)[seen] if frame.colors else None
        self.recording.log(f"world/map/{reference}", self.rr.Points3D(points[seen], colors=colors, radii=0.004))

    def _colors(self, frame: Frame, p_world: FloatArray, spline: Spline) -> ByteArray:
        """What colour shows at points (h, w, 3), up to the motion while it was exposed; grey where it sees nothing."""
        shutter, camera = self.rig.color_shutter, self.rig.color_camera
        image = frame.colors[0]
        middle = float(shutter.line_mid_time(image.stamp, 0.5 * (shutter.line_count(camera) - 1), camera))
        middle = min(max(middle, spline.t_begin), spline.t_end)
        uv, valid = camera.project(se3.transform(self.rig.T_color_depth @ se3.inverse(spline.pose(middle)), p_world))
        valid &= camera.contains(uv)
        colors = np.full(p_world.shape, 128, np.uint8)
        u, v = np.rint(uv[valid]).astype(int).T
        colors[valid] = image.pixels[v, u]
        return colors

    def _residuals(self, spline: Spline, frame: Frame, key: Image, sigma_m: float) -> None:
        camera, shutter = self.rig.depth_camera, self.rig.depth_shutter
        points = world_points(spline, camera, shutter, frame.depth, -(-camera.width // _COARSE_WIDTH))
        off = depth_residuals(spline, camera, shutter, points, key)
        self.recording.log("residuals/depth", self.rr.Image(_diverging(off / (_SIGMAS * sigma_m))))


def jpeg(rgb: ByteArray, width: int) -> bytes:
    """An RGB image (h, w, 3), made smaller if it is wider than `width` pixels."""
    if rgb.shape[1] > width:
        height = round(rgb.shape[0] * width / rgb.shape[1])
        rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])[1])


def _diverging(x: FloatArray) -> ByteArray:
    """Blue at −1 by white at 0 to red at 1, as (h, w, 3) uint8; dark where it is NaN."""
    x = np.clip(x, -1.0, 1.0)
    rgb = np.stack([1.0 + np.minimum(x, 0.0), 1.0 - np.abs(x), 1.0 - np.maximum(x, 0.0)], axis=-1)
    return np.where(np.isnan(x)[..., None], 40, 255.0 * np.nan_to_num(rgb)).astype(np.uint8)


def world_points(spline: Spline, camera: Camera, shutter: Shutter, image: Image, stride: int) -> FloatArray:
    """p_world (h', w', 3) of every stride-th pixel of a depth image, each at its line's pose; NaN without depth.

    spline: T_world_depth(t). Raises UserError where the spline does not cover the image.
    """
    uv = camera.pixel_grid()[::stride, ::stride]
    z = image.pixels[::stride, ::stride].astype(np.float64)
    p_cam = camera.backproject(uv, np.where(z > 0.0, z, np.nan))
    lines, of = np.unique(shutter.line_of_pixel(uv, camera), return_inverse=True)
    T = spline.pose(shutter.line_mid_time(image.stamp, lines, camera))
    return np.asarray(se3.transform(T[of.reshape(p_cam.shape[:-1])], p_cam))


def depth_residuals(
    spline: Spline, camera: Camera, shutter: Shutter, p_world: FloatArray, other: Image
) -> FloatArray:  # fmt: skip
    """Depth that another image has where it sees p_world (..., 3), less the depth that the points have there, in m.

    NaN: not seen, or without depth there. spline: T_world_depth(t), of both images. Which line sees a point is found by
    looking from the line that would have seen it from the line before, which here settles within a hundredth of a line.
    Raises UserError where the spline does not cover the other image.
    """
    points = p_world.reshape(-1, 3)
    last = shutter.line_count(camera) - 1
    times = shutter.line_mid_time(other.stamp, np.arange(last + 1), camera)
    T_cam_world = se3.inverse(spline.pose(times))
    line = np.full(len(points), last // 2)
    for _ in range(_ROW_ITERATIONS):
        p_cam = se3.transform(T_cam_world[line], points)
        uv, valid = camera.project(p_cam)
        wanted = np.where(valid, shutter.line_of_pixel(uv, camera), 0.0)
        line = np.clip(np.rint(wanted), 0, last).astype(int)
    residuals = np.where(valid, _between(other.pixels, uv), np.nan) - p_cam[:, 2]
    return np.asarray(residuals.reshape(p_world.shape[:-1]))


def _between(z: Float32Array, uv: FloatArray) -> FloatArray:
    """Depth (n,) between the four pixels about uv (n, 2), as of a plane: linear in 1 / z. NaN beside edges and gaps."""
    height, width = z.shape
    inside = np.asarray(((uv >= 0.0) & (uv <= (width - 1, height - 1))).all(axis=-1))
    at = np.where(inside[:, None], uv, 0.0)
    u, v = (np.minimum(np.floor(at[:, i]).astype(int), n - 2) for i, n in enumerate((width, height)))
    near = np.stack([z[v + j, u + i] for j in (0, 1) for i in (0, 1)]).astype(np.float64)
    a, b = at[:, 0] - u, at[:, 1] - v
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    smooth = inside & (near.min(axis=0) > 0.0) & (np.ptp(near, axis=0) < _EDGE * near.max(axis=0))
    inverse = (weights / np.where(smooth, near, 1.0)).sum(axis=0)
    return np.where(smooth, 1.0 / inverse, np.nan)
