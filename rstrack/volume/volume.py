"""A sparse truncated signed distance volume: depth images are averaged into it, and seen again from any pose.

After Curless & Levoy (SIGGRAPH 1996) and Newcombe et al. (ISMAR 2011), in blocks as in Nießner et al. (SIGGRAPH Asia
2013): memory grows with the surface that was seen, not with the room and not with the number of frames.

volume = Volume(engine("auto"), voxel_m=0.01)
volume.integrate(inverse_depth, T_world_cam, lens)
inverse_depth, _ = volume.raycast(T_world_cam, lens)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray, IntArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.volume.kernels import (
    BLOCK,
    POINTS,
    integrate,
    raycast_kernel,
    scale_kernel,
    sight_kernel,
)

TRUNCATION = 4.0
"""Voxels to both sides of a surface within which distances are kept."""

_FIRST_BLOCKS = 4096
# Entries of the directory: 64 MB.
_MOST_ENTRIES = 2**24
# Blocks around what was seen that the directory covers when it grows.
_MARGIN = 8
_NEAR_M = 0.05


@dataclass(frozen=True)
class Blocks:
    """The volume on the host, n blocks. first: (3,) block coordinates x y z of directory[0, 0, 0].

    directory: (nz, ny, nx) row of each block, -1 for none. tsdf: (n, 8, 8, 8), axes z y x, in truncations, 1 where no
    frame has looked; weight: of the same shape. color: (n, 8, 8, 8, 4) red, green, blue in [0, 1] and their weight;
    None if the volume has none.
    """

    first: IntArray
    directory: npt.NDArray[np.int32]
    tsdf: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float32]
    color: npt.NDArray[np.float32] | None


class Volume:
    """Distances at lattice points `voxel_m` apart, along the surfaces' normals as far as those are known.

    Units: metres; weights count measurements of a depth of one metre, seen squarely.
    """

    def __init__(self, e: Engine, voxel_m: float = 0.01, color: bool = False, truncation: float = TRUNCATION) -> None:
        if not 1e-4 <= voxel_m <= 1.0:
            raise UserError(f"voxel size {voxel_m!r} m must be between 0.0001 and 1 m")
        if not 2.0 <= truncation <= 8.0:
            raise UserError(f"truncation {truncation!r} must be between 2 and 8 voxels: blocks are 8 voxels wide")
        self.e, self.voxel_m, self.truncation_m = e, float(voxel_m), truncation * float(voxel_m)
        self.blocks = 0
        self._colored = color
        self._first, self._directory = np.zeros(3, np.int64), np.zeros((0, 0, 0), np.int32)
        self._device_directory: Any = None
        self._sums = [self._zeros(_FIRST_BLOCKS) for _ in range(6 if color else 2)]
        self._kernel = Kernels(e)

    @property
    def bytes(self) -> int:
        """Memory of the values and of the directory."""
        return 4 * (sum(dr.width(array) for array in self._sums) + 2 * self._directory.size)

    def integrate(
        self, inverse_depth: Any, T_world_cam: FloatArray, lens: Lens, weight: Any = None, color: Any = None
    ) -> None:
        """Average one depth image in.

        inverse_depth: (h, w) on the device, flat, 1/m, 0 missing. lens: a global-shutter pinhole. weight: such an image
        of weights; by default (σ(1 m) / σ(z))² with σ after Nguyen et al. (3DIMPVT 2012), at most 2.5. Both times the
        cosine under which the surface is seen. color: images red, green, blue in [0, 1] and their weight, if the volume
        has colour. Raises UserError if the surfaces spread too far for the voxel size, or a pose is not finite.
        """
        _check(T_world_cam, lens)
        rows = self._sighted(inverse_depth, T_world_cam, lens)
        if not len(rows):
            return
        e = self.e
        _, ny, nx = self._directory.shape
        block = np.stack([rows % nx, rows // nx % ny, rows // (nx * ny)], axis=-1) + self._first
        T_cam_world = se3.inverse(T_world_cam)
        corners = se3.transform(T_cam_world, block * (BLOCK * self.voxel_m))
        integrate(
            e, lens, self.voxel_m, self.truncation_m, inverse_depth, self._kernel(scale_kernel, lens)(inverse_depth),
            weight, list(color) if color is not None and self._colored else [],
            _integers(e.UInt, self._directory.reshape(-1)[rows]), [e.upload(c) for c in corners.T],
            [e.upload([r]) for r in T_cam_world[:3, :3].ravel()], self._sums,
        )  # fmt: skip

    def raycast(self, T_world_cam: FloatArray, lens: Lens, color: bool = False) -> tuple[Any, list[Any]]:
        """What a global-shutter pinhole sees: inverse depth (h, w), 1/m, 0 nothing; and red, green, blue on request.

        Flat, on the device. Raises UserError as `integrate` does.
        """
        _check(T_world_cam, lens)
        e, colored = self.e, color and self._colored
        if not self.blocks:
            empty = dr.zeros(e.Float, lens.camera.height * lens.camera.width)
            return empty, [empty] * (3 if colored else 0)
        kernel = self._kernel(raycast_kernel, lens, self.voxel_m, self.truncation_m, colored)
        rho, seen = kernel(
            e.upload(_row(T_world_cam)), e.upload(self._box()), e.upload([_NEAR_M]), self._device_directory,
            self._sums if colored else self._sums[:2],
        )  # fmt: skip
        return rho, list(seen)

    def download(self) -> Blocks:
        """The whole volume on the host."""
        shape, count = (self.blocks, BLOCK, BLOCK, BLOCK), self.blocks * POINTS
        distance, weight, *colors = (np.array(array.numpy()[:count]).reshape(shape) for array in self._sums)
        tsdf = np.divide(distance, weight, out=np.ones_like(distance), where=weight > 0)
        color = None
        if colors:
            color = np.stack(colors, axis=-1)
            np.divide(color[..., :3], color[..., 3:], out=color[..., :3], where=color[..., 3:] > 0)
        return Blocks(self._first.copy(), self._directory.copy(), tsdf, weight, color)

    # -- blocks -----------------------------------------------------------------------------------------------------

    def _sighted(self, inverse_depth: Any, T_world_cam: FloatArray, lens: Lens) -> IntArray:
        """Directory entries (n,) of the blocks around the depth image's surfaces, all of them made."""
        e = self.e
        nearest = float(dr.min(dr.select(inverse_depth > 0.0, inverse_depth, dr.inf))[0])
        if not np.isfinite(nearest):
            return np.empty(0, np.int64)
        self._cover(T_world_cam, lens, 1.0 / nearest + self.truncation_m)
        kernel = self._kernel(sight_kernel, lens, self.truncation_m, self.voxel_m)
        parts = kernel(inverse_depth, e.upload(_row(T_world_cam)), e.upload(self._box()))
        marks = dr.zeros(e.UInt, self._directory.size)
        for entry, active in parts:
            dr.scatter(marks, e.UInt(1), entry, active)
        rows = np.flatnonzero(marks.numpy())
        table = self._directory.reshape(-1)
        new = rows[table[rows] < 0]
        if len(new):
            made = np.arange(self.blocks, self.blocks + len(new), dtype=np.int32)
            table[new] = made
            dr.scatter(self._device_directory, e.Int(_integers(e.UInt, made)), _integers(e.UInt, new))
            dr.eval(self._device_directory)
            self._reserve(self.blocks + len(new))
            self.blocks += len(new)
        return rows

    def _cover(self, T_world_cam: FloatArray, lens: Lens, far_m: float) -> None:
        """Let the directory reach everything that the camera sees up to a depth of far_m."""
        camera = lens.camera
        u, v = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        ends = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) * far_m
        p = np.concatenate([se3.transform(T_world_cam, ends), T_world_cam[None, :3, 3]])
        block = p / (self.voxel_m * BLOCK)
        low, high = np.floor(block.min(axis=0)).astype(np.int64) - 1, np.ceil(block.max(axis=0)).astype(np.int64) + 1
        old_low, old_size = self._first, np.array(self._directory.shape[::-1])
        if self._directory.size:
            if (low >= old_low).all() and (high <= old_low + old_size).all():
                return
            low, high = np.minimum(low, old_low), np.maximum(high, old_low + old_size)
        low, high = low - _MARGIN, high + _MARGIN
        size = high - low
        if np.prod(size.astype(float)) > _MOST_ENTRIES:
            spread = " x ".join(f"{n * BLOCK * self.voxel_m:.1f}" for n in size)
            raise UserError(
                f"volume: what was seen spreads over {spread} m, too much for voxels of {self.voxel_m:g} m: "
                "use larger voxels or a smaller max_depth"
            )
        grown = np.full(size[::-1], -1, np.int32)
        if self._directory.size:
            x, y, z = old_low - low
            nx, ny, nz = old_size
            grown[z : z + nz, y : y + ny, x : x + nx] = self._directory
        self._first, self._directory = low, grown
        self._device_directory = self.e.Int(_integers(self.e.UInt, grown.view(np.uint32)))
        dr.eval(self._device_directory)

    def _reserve(self, blocks: int) -> None:
        """Double the room for values until it holds so many blocks."""
        have = dr.width(self._sums[0]) // POINTS
        if blocks <= have:
            return
        room = have * 2 ** int(np.ceil(np.log2(blocks / have)))
        kept = dr.arange(self.e.UInt, have * POINTS)
        for i, old in enumerate(self._sums):
            grown = self._zeros(room)
            dr.scatter(grown, old, kept)
            dr.eval(grown)
            self._sums[i] = grown

    def _zeros(self, blocks: int) -> Any:
        # Copied: zeros that were made together would share memory, and the first sum added to would copy it.
        zeros = dr.copy(dr.zeros(self.e.Float, blocks * POINTS))
        dr.eval(zeros)
        return zeros

    def _box(self) -> FloatArray:
        return np.concatenate([self._first, self._directory.shape[::-1]]).astype(np.float64)


def _check(T_world_cam: FloatArray, lens: Lens) -> None:
    if lens.camera.model != "pinhole" or lens.lines > 1:
        raise ValueError("a volume takes rectified images: a pinhole with a global shutter")
    if not np.isfinite(T_world_cam).all():
        raise UserError("volume: a pose is not finite: leave frames that were not tracked out")


def _row(T: FloatArray) -> FloatArray:
    """Pose (4, 4) as (12,): rotation row-major, translation."""
    return np.concatenate([T[:3, :3].ravel(), T[:3, 3]])


def _integers(kind: Any, values: npt.ArrayLike) -> Any:
    """Integers on the device, in memory of its own: `Engine.upload` says why."""
    return kind(dr.copy(kind(np.array(values, np.uint32).ravel())))
