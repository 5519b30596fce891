"""From an estimate to a surface: every frame's depth, rectified line by line, goes into one signed distance volume.

result = reconstruct(open_dataset(Path("out/lr_kt2")), read_estimate(Path("runs/lr_kt2")), MapOptions())
write_ply(Path("mesh.ply"), result.surface)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.device.arrays import Engine, Kernels, recorded_with
from rsgen.device.lens import Lens
from rsgen.device.projection import project_rolling
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.data.dataset import Dataset, open_tracked
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.data.image_files import prefetched
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import MARGIN, DeviceRig
from rstrack.images.line_poses import IDENTITY_TO_BASE, Exposure, from_base_table, rows_of, to_base_table
from rstrack.images.pyramid import depth_image
from rstrack.images.sampling import Raster, bilinear_value, pinhole_points
from rstrack.keyframes.keyframe import rectified_lens
from rstrack.keyframes.rectification import RectifyInput, rectify_kernel
from rstrack.metrics.association import compare, truth_of
from rstrack.options import MapOptions, Options
from rstrack.volume.mesh import TriangleSurface, extract_surface, write_ply
from rstrack.volume.volume import Volume

# Seconds from the nearest estimated pose beyond which a frame is left out: its pose would be a guess.
_POSE_WITHIN_S = 0.1


@dataclass(frozen=True)
class Reconstruction:
    """A surface and how it came about. frames: integrated; without_pose: frames left out."""

    surface: TriangleSurface
    frames: int
    without_pose: int
    shutter: Literal["rs", "gs"]
    world: Literal["truth", "estimate"]
    bytes: int

    def text(self) -> str:
        """A summary of one line."""
        left = f", {self.without_pose} left out without a pose" if self.without_pose else ""
        return (
            f"{self.frames} frames ({self.shutter}){left}: {len(self.surface.vertices)} vertices, "
            f"{len(self.surface.faces)} triangles, in the {self.world}'s world; volume of {self.bytes / 2**20:.0f} MB"
        )


class FrameMapper:
    """Frames of a rig, with the motion of an estimate, into a volume. rolling: with a pose for each line."""

    def __init__(
        self, device: DeviceRig, rig: Rig, estimate: Estimate, volume: Volume, T_world_estimate: FloatArray,
        rolling: bool, max_depth: float,
    ) -> None:  # fmt: skip
        self._device, self._rig, self._estimate, self._max_depth = device, rig, estimate, max_depth
        self._volume, self._T_world_estimate = volume, T_world_estimate
        self.base = rectified_lens(rig.depth_camera)
        self._kernel, self._lines = Kernels(device.e), estimate.spline if rolling else None

    def __call__(self, frame: Frame, number: int) -> bool:
        """Integrate one frame of the data set without what moves by itself; False if the estimate does not cover it.

        Raises UserError if the estimate has masks of images of another size.
        """
        device, e = self._device, self._device.e
        exposure = device.depth_exposure(frame.depth)
        t = exposure.mid_time
        if not self._covered(exposure):
            return False
        T_estimate_base = self._pose(t)
        z = np.where(device.sees, frame.depth.pixels, 0.0)
        camera = self._rig.depth_camera
        # Its colours are taken a little later, and from beside: what is next to it is seen better by other frames.
        moving = self._estimate.moving.of(number, camera.height, camera.width, round(MARGIN * camera.width))
        depth = depth_image(e, exposure, z if moving is None else np.where(moving, 0.0, z), self._max_depth)
        lines = self._lines
        seen_at = IDENTITY_TO_BASE if lines is None else to_base_table(lines, T_estimate_base, exposure)
        rectify = self._kernel(rectify_kernel, device.depth_lens, self.base)
        rho, _, _ = rectify(RectifyInput(depth.inverse_z, *device.device_rays, e.upload(seen_at)))
        self._volume.integrate(
            rho, self._T_world_estimate @ T_estimate_base, self.base, color=self._colors(frame, rho, T_estimate_base, t)
        )
        return True

    def _colors(self, frame: Frame, rho: Any, T_estimate_base: FloatArray, t: float) -> list[Any] | None:
        """Red, green, blue and their weight at the rectified pixels, from the colour image nearest in time."""
        exposures = [self._device.color_exposure(image) for image in frame.colors]
        usable = [i for i, exposure in enumerate(exposures) if self._covered(exposure)]
        if not usable:
            return None
        best = min(usable, key=lambda i: abs(exposures[i].mid_time - t))
        exposure, e = exposures[best], self._device.e
        if self._lines is not None:
            from_base = from_base_table(self._lines, T_estimate_base, exposure)
        else:
            T = self._rig.T_color_depth @ se3.inverse(self._pose(exposure.mid_time)) @ T_estimate_base
            from_base = np.concatenate([rows_of(T), np.zeros(6)])
        red, green, blue = (
            e.upload(plane / np.float32(255.0)) for plane in np.moveaxis(frame.colors[best].pixels, -1, 0)
        )
        look_up = self._kernel(_lookup_kernel, self._device.color_lens, self.base)
        out: list[Any] = look_up(_LookupInput(rho, red, green, blue, e.upload(from_base)))
        return out

    def _pose(self, t: float) -> FloatArray:
        """T_estimate_depth (4, 4) at a covered time."""
        if self._estimate.spline is not None:
            return np.asarray(self._estimate.spline.pose(t))
        return se3.interpolated(self._estimate.stamps, self._estimate.T_world_depth, np.array([t]))[0]

    def _covered(self, exposure: Exposure) -> bool:
        times = np.array([exposure.first_time, exposure.last_time])
        if self._estimate.spline is not None:
            return bool(self._estimate.spline_covers(times).all())
        stamps = self._estimate.stamps
        after = int(np.searchsorted(stamps, times[0]))
        around = stamps[[max(after - 1, 0), min(after, len(stamps) - 1)]]
        return bool((np.abs(around - times[0]) <= _POSE_WITHIN_S).all())


@dataclass(frozen=True)
class _LookupInput:
    """Device arrays: inverse depth, the colour image's planes, and the poses of its lines."""

    inverse_depth: Any
    red: Any
    green: Any
    blue: Any
    from_base: Any


def _lookup_kernel(e: Engine, lens: Lens, base: Lens) -> Callable[[_LookupInput], Any]:
    """Kernel → [red, green, blue, 1 where seen], equation (3).

    Colours of a rectified depth image's points (`base`, a global-shutter pinhole) in a colour image of `lens`.
    """

    @recorded_with(e, _LookupInput, lens, base, Raster.of(base.camera))
    def kernel(given: _LookupInput, lens: Lens, base: Lens, raster: Raster) -> Any:
        p, active = pinhole_points(e, base.camera, raster, given.inverse_depth)
        seen = project_rolling(lens, given.from_base, p, e.UInt, e.Int)
        out = []
        inside, size = active & seen.valid, (lens.camera.width, lens.camera.height)
        for plane in (given.red, given.green, given.blue):
            value, inside = bilinear_value(e, plane, *size, seen.x, seen.y, inside)
            out.append(value)
        return [*(dr.select(inside, value, 0.0) for value in out), dr.select(inside, e.Float(1.0), 0.0)]

    return kernel


def reconstruct(
    dataset: Dataset, estimate: Estimate, options: MapOptions | None = None, progress: Progress = no_progress
) -> Reconstruction:
    """Fuse a sequence's frames with an estimate's motion. Raises UserError: no spline for rs, no truth for --world
    truth, no frame with a pose, an image that cannot be read."""
    options = options or MapOptions()
    shutter = options.shutter or ("rs" if estimate.spline is not None else "gs")
    if shutter == "rs" and estimate.spline is None:
        raise UserError("map: the estimate has no spline, so lines have no poses of their own: use --shutter gs")
    T_world_estimate, world = _world(dataset, estimate, options.world)
    seen_as = Options(method=f"{shutter}-g", backend=options.backend)  # type: ignore[arg-type]
    device = DeviceRig(dataset.rig, seen_as)
    volume = Volume(device.e, options.voxel_m, options.color, most_bytes=1e9 * options.memory_gb)
    mapper = FrameMapper(device, dataset.rig, estimate, volume, T_world_estimate, shutter == "rs", options.max_depth)
    chosen = range(0, len(dataset), options.every)
    done = 0
    images = prefetched(lambda k: dataset.frame(k, color=options.color), chosen, 2)
    for count, (number, frame) in enumerate(zip(chosen, images, strict=True), 1):
        done += mapper(frame, number)
        progress("integrating", count / len(chosen), f"{volume.blocks} blocks, {volume.bytes / 2**20:.0f} MB")
    if not done:
        raise UserError(
            f"map: none of {len(chosen)} frames has a pose: the estimate covers {estimate.stamps[0]:.3f} to "
            f"{estimate.stamps[-1]:.3f} s, the sequence {dataset.stamps[0]:.3f} to {dataset.stamps[-1]:.3f} s"
        )
    progress("meshing", 0.0, "")
    surface = extract_surface(volume.download(), options.voxel_m)
    progress("meshing", 1.0, f"{len(surface.faces)} triangles")
    return Reconstruction(surface, done, len(chosen) - done, shutter, world, volume.bytes)


def run_map(
    seq_path: Path, estimate_path: Path, out: Path, options: MapOptions, cloud: Path | None = None,
    camera_file: Path | None = None, progress: Progress = no_progress,
) -> Reconstruction:  # fmt: skip
    """Map a sequence folder with a run folder or TUM file: writes a mesh, and a point cloud where `cloud` says.

    Arguments as in `reconstruct`, `read_estimate` and `rstrack.data.dataset.open_tracked`. Raises UserError.
    """
    for path in (out, cloud):
        if path is not None and path.suffix.lower() != ".ply":
            raise UserError(f"{path}: only PLY is written: give it a name that ends in .ply")
        if path is not None and not path.parent.is_dir():
            raise UserError(f"{path}: there is no folder {path.parent}: make it or choose another name")
    estimate = read_estimate(estimate_path)
    dataset = open_tracked(seq_path, estimate_path, estimate.info, camera_file)
    result = reconstruct(dataset, estimate, options, progress)
    comment = f"rstrack map, world {result.world}, shutter {result.shutter}, voxels {options.voxel_m:g} m"
    write_ply(out, result.surface, comment)
    if cloud is not None:
        write_ply(cloud, result.surface, comment, cloud=True)
    return result


def _world(
    dataset: Dataset, estimate: Estimate, asked: Literal["truth", "estimate"] | None
) -> tuple[FloatArray, Literal["truth", "estimate"]]:
    """T_world_estimate (4, 4) and what the world is."""
    truth = truth_of(dataset)
    if truth is None and asked == "truth":
        raise UserError(f"{dataset.root}: has no ground truth to align with: use --world estimate")
    if truth is None or asked == "estimate":
        return np.eye(4), "estimate"
    try:
        return compare(truth, estimate).T_true_est, "truth"
    except UserError as error:
        if asked is None:
            raise UserError(f"{error}; or use --world estimate") from None
        raise
