"""A tracker's work as a rerun recording, live or in a file: what `rstrack track --view` shows.

with open_view(Path("run.rrd"), dataset.rig, dataset.name) as viewer:
    track(dataset, options, out, watch=viewer.see)

It looks at what the tracker says of itself and changes nothing. Images are shown at a part of their size, and a few
times a second, so that the tracker hardly waits.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rsgen.array_types import ByteArray, FloatArray
from rsgen.errors import UserError
from rsgen.files import whole_file, write_error
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Frame, Image, Rig
from rstrack.view.residuals import depth_residuals, world_points

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


@contextmanager
def open_view(file: Path | None, rig: Rig, name: str) -> Iterator[Viewer]:
    """A viewer's window (file: None), or a recording `file` (.rrd) that is there, whole, once this ends well.

    Raises UserError: rerun is not installed, no window can be opened, the file has another suffix or is there already.
    """
    rr = _rerun()
    if file is None:
        recording = rr.RecordingStream("rstrack", recording_id=None)
        try:
            recording.spawn()
        except (OSError, RuntimeError) as error:
            raise UserError(f"--view: no window can be opened ({error}): give a file, --view run.rrd") from None
        yield Viewer(rr, recording, rig)
        recording.flush()
        return
    if file.suffix != ".rrd":
        raise UserError(f"--view {file}: a rerun recording is named .rrd")
    if file.exists():
        raise UserError(f"--view {file}: is there already: choose another name or delete it")
    recording = rr.RecordingStream("rstrack", recording_id=name)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(file, error) from None
    with whole_file(file) as temporary:
        try:
            recording.save(temporary)
            yield Viewer(rr, recording, rig)
            recording.flush()
        finally:
            recording.disconnect()


def _rerun() -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise UserError("--view: rerun is not installed: pip install 'rolling-shutter-rgbd[rerun]'") from None


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
        """Frame number `index` has been fed, and this is what the tracker says of it."""
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
            picture = rr.EncodedImage(contents=_jpeg(frame.colors[0].pixels), media_type="image/jpeg")
            log("world/camera/color/image", picture)
        stride = -(-frame.depth.pixels.shape[1] // _WIDTH)
        z = _millimetres(frame.depth.pixels[::stride, ::stride])
        log("world/camera/depth/image", rr.DepthImage(z, meter=1000.0))

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


def _jpeg(rgb: ByteArray) -> bytes:
    share = min(1.0, _WIDTH / rgb.shape[1])
    small = cv2.resize(rgb, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) if share < 1.0 else rgb
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])[1])


def _millimetres(z: FloatArray) -> Any:
    return np.clip(np.rint(1e3 * z), 0, 65535).astype(np.uint16)


def _diverging(x: FloatArray) -> ByteArray:
    """Blue at −1 by white at 0 to red at 1, as (h, w, 3) uint8; dark where it is NaN."""
    x = np.clip(x, -1.0, 1.0)
    rgb = np.stack([1.0 + np.minimum(x, 0.0), 1.0 - np.abs(x), 1.0 - np.maximum(x, 0.0)], axis=-1)
    return np.where(np.isnan(x)[..., None], 40, 255.0 * np.nan_to_num(rgb)).astype(np.uint8)
