"""A sparse truncated signed distance volume: depth images are averaged into it, and seen again from any pose.

After Curless & Levoy (SIGGRAPH 1996) and Newcombe et al. (ISMAR 2011), in blocks as in Nießner et al. (SIGGRAPH Asia
2013): memory grows with the surface that was seen, not with the room and not with the number of frames. There are no
bounds: kernels see the blocks about the camera, and those that are far away go to a file where memory is short.

volume = Volume(engine("auto"), voxel_m=0.01)
volume.integrate(inverse_depth, T_world_cam, lens)
inverse_depth = volume.raycast(T_world_cam, lens)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import Engine, Kernels
from rsgen.device.lens import Lens
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.volume.blocks import BlockDirectory, BlockValues, unsigned
from rstrack.volume.kernels import BLOCK, POINTS, integrate, raycast_kernel, scale_kernel, visible_blocks_kernel

# Voxels to both sides of a surface within which distances are stored: at most the eight of a block.
_TRUNCATION = 4.0
_NEAR_M = 0.05
# Of the distance that a ray is followed, where the window cannot hold all that it might cross.
_SHORTER = 0.8
# Blocks that are moved at a time.
_AT_ONCE = 4096


@dataclass(frozen=True)
class Blocks:
    """The volume on the host, n blocks. at: (n, 3) block coordinates x y z.

    tsdf: (n, 8, 8, 8), axes z y x, in truncations, 1 where no frame has looked; weight: of the same shape.
    color: (n, 8, 8, 8, 4) red, green, blue in [0, 1] and their weight; None if the volume has none.
    """

    at: IntArray
    tsdf: Float32Array
    weight: Float32Array
    color: Float32Array | None


class Volume:
    """Distances at lattice points `voxel_m` apart, along the surfaces' normals as far as those are known.

    Units: metres; weights count measurements of a depth of one metre, seen squarely. Where values take more than
    `most_bytes` on the device, those of blocks that are out of the camera's reach go to a temporary file (in TMPDIR)
    until they are needed: what the volume holds does not depend on that, to the last bit.
    """

    def __init__(self, e: Engine, voxel_m: float = 0.01, color: bool = False, most_bytes: float = float("inf")) -> None:
        if not 1e-4 <= voxel_m <= 1.0:
            raise UserError(f"voxel size {voxel_m!r} m must be between 0.0001 and 1 m")
        self.e, self.voxel_m, self.truncation_m = e, float(voxel_m), _TRUNCATION * float(voxel_m)
        self._colored = color
        self._directory, self._table = BlockDirectory(), e.Int()
        self._values = BlockValues(e, 6 if color else 2, most_bytes)
        self._farthest_m = 0.0
        self._kernel = Kernels(e)

    def __getstate__(self) -> dict[str, Any]:
        """For a checkpoint: all but the kernels."""
        return {name: value for name, value in vars(self).items() if name != "_kernel"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._kernel = Kernels(self.e)

    @property
    def blocks(self) -> int:
        """How many there are, wherever they are."""
        return len(self._directory)

    @property
    def bytes(self) -> int:
        """Memory of the values and of the window."""
        return self._values.bytes + 8 * self._directory.table.size

    def integrate(
        self, inverse_depth: Any, T_world_cam: FloatArray, lens: Lens, weight: Any = None, color: Any = None
    ) -> None:
        """Average one depth image in.

        inverse_depth: (h, w) on the device, flat, 1/m, 0 missing. lens: a global-shutter pinhole. weight: such an image
        of weights; by default (σ(1 m) / σ(z))² with σ after Nguyen et al. (3DIMPVT 2012), at most 2.5. Both times the
        cosine under which the surface is seen. color: images red, green, blue in [0, 1] and their weight, if the volume
        has colour. Raises UserError if one image spreads too far for the voxel size, a pose is not finite, or there is
        no room for the file.
        """
        _check(T_world_cam, lens)
        entries = self._visible(inverse_depth, T_world_cam, lens)
        if not len(entries):
            return
        e = self.e
        block = self._directory.blocks_at(entries)
        T_cam_world = se3.inverse(T_world_cam)
        corners = se3.transform(T_cam_world, block * self._edge_m)
        integrate(
            e, lens, self.voxel_m, self.truncation_m, inverse_depth, self._kernel(scale_kernel, lens)(inverse_depth),
            weight, list(color) if color is not None and self._colored else [],
            unsigned(e, self._directory.table.reshape(-1)[entries]), [e.upload(c) for c in corners.T],
            [e.upload([r]) for r in T_cam_world[:3, :3].ravel()], self._values.sums,
        )  # fmt: skip

    def raycast(self, T_world_cam: FloatArray, lens: Lens) -> Any:
        """What a global-shutter pinhole sees: inverse depth (h, w), 1/m, 0 nothing.

        Flat, on the device; as far as the farthest depth that was averaged in. Raises UserError as `integrate` does.
        """
        _check(T_world_cam, lens)
        if not self.blocks or not self._reach(T_world_cam, lens):
            return dr.zeros(self.e.Float, lens.camera.height * lens.camera.width)
        kernel = self._kernel(raycast_kernel, lens, self.voxel_m, self.truncation_m)
        pose, box = self._from_nearby(T_world_cam)
        return kernel(pose, box, self.e.upload([_NEAR_M]), self._table, self._values.sums[:2])

    def download(self) -> Blocks:
        """The whole volume on the host."""
        planes = len(self._values.sums)
        values = np.empty((self.blocks, planes, BLOCK, BLOCK, BLOCK), np.float32)
        for part in _parts(np.arange(self.blocks)):
            values[part] = self._values_of(part).reshape(-1, planes, BLOCK, BLOCK, BLOCK)
        distance, weight, *colors = (values[:, i] for i in range(planes))
        tsdf = np.divide(distance, weight, out=np.ones_like(distance), where=weight > 0)
        color = None
        if colors:
            color = np.stack(colors, axis=-1)
            np.divide(color[..., :3], color[..., 3:], out=color[..., :3], where=color[..., 3:] > 0)
        return Blocks(self._directory.at.copy(), tsdf, weight.copy(), color)

    # -- the window -------------------------------------------------------------------------------------------------

    @property
    def _edge_m(self) -> float:
        return BLOCK * self.voxel_m

    def _visible(self, inverse_depth: Any, T_world_cam: FloatArray, lens: Lens) -> IntArray:
        """Places (n,) in the window's table of the blocks around the depth image's surfaces, all of them made."""
        nearest = float(dr.min(dr.select(inverse_depth > 0.0, inverse_depth, dr.inf))[0])
        if not np.isfinite(nearest):
            return np.empty(0, np.int64)
        far_m = 1.0 / nearest + self.truncation_m
        self._farthest_m = max(self._farthest_m, far_m)
        low, high = self._seen_box(T_world_cam, lens, far_m)
        if not self._directory.covers(low, high) and not self._move(low, high):
            spread = " x ".join(f"{n * self._edge_m:.1f}" for n in high - low)
            raise UserError(
                f"volume: one image spreads over {spread} m, too much for voxels of {self.voxel_m:g} m: "
                "use larger voxels or a smaller max_depth"
            )
        entries, new = self._marked(inverse_depth, T_world_cam, lens)
        if (
            not self._values.has_room(len(new))
            and self._values.would_exceed(len(new))
            and self._move(low, high, alone=True)
        ):
            entries, new = self._marked(inverse_depth, T_world_cam, lens)
        if len(new):
            slots = self._values.take(len(new))
            self._directory.add(new, slots)
            dr.scatter(self._table, self.e.Int(unsigned(self.e, slots)), unsigned(self.e, new))
            dr.eval(self._table)
        return entries

    def _marked(self, inverse_depth: Any, T_world_cam: FloatArray, lens: Lens) -> tuple[IntArray, IntArray]:
        """Places in the table of the blocks around a depth image's surfaces, and of those there are none of yet."""
        e, table = self.e, self._directory.table.reshape(-1)
        kernel = self._kernel(visible_blocks_kernel, lens, self.truncation_m, self.voxel_m)
        marks = dr.zeros(e.UInt, table.size)
        for entry, active in kernel(inverse_depth, *self._from_nearby(T_world_cam)):
            dr.scatter(marks, e.UInt(1), entry, active)
        entries = np.flatnonzero(marks.numpy())
        return entries, entries[table[entries] < 0]

    def _reach(self, T_world_cam: FloatArray, lens: Lens) -> bool:
        """Let the window hold what there is in a camera's view; False if there is nothing."""
        at, far_m = self._directory.at, self._farthest_m
        while True:
            low, high = self._seen_box(T_world_cam, lens, far_m)
            low, high = np.maximum(low, at.min(axis=0)), np.minimum(high, at.max(axis=0) + 1)
            if (low >= high).any():
                return False
            if self._directory.covers(low, high) or self._move(low, high):
                return True
            far_m *= _SHORTER

    def _seen_box(self, T_world_cam: FloatArray, lens: Lens, far_m: float) -> tuple[IntArray, IntArray]:
        """Block coordinates (3,) from and to which a camera sees up to a depth of far_m."""
        camera = lens.camera
        u, v = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        ends = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) * far_m
        p = np.concatenate([se3.transform(T_world_cam, ends), T_world_cam[None, :3, 3]])
        block = p / self._edge_m
        return np.floor(block.min(axis=0)).astype(np.int64) - 1, np.ceil(block.max(axis=0)).astype(np.int64) + 1

    def _from_nearby(self, T_world_cam: FloatArray) -> tuple[Any, Any]:
        """Pose (12,) and window (6,) for kernels, from the block of the camera's centre: float32 does then."""
        origin = np.floor(T_world_cam[:3, 3] / self._edge_m)
        shift = T_world_cam[:3, 3] - origin * self._edge_m
        pose = np.concatenate([T_world_cam[:3, :3].ravel(), shift])
        box = np.concatenate([self._directory.first - origin, self._directory.size])
        return self.e.upload(pose), self.e.upload(box)

    def _move(self, low: IntArray, high: IntArray, alone: bool = False) -> bool:
        """Move the window (`BlockDirectory.move`): its blocks come in, others go if room is short."""
        directory = self._directory
        if not directory.move(low, high, alone):
            return False
        inside, on_device = directory.inside(), directory.slots >= 0
        coming = np.flatnonzero(inside & ~on_device)
        if self._values.would_exceed(len(coming)) or alone:
            for part in _parts(np.flatnonzero(on_device & ~inside)):
                self._values.put_away(part, directory.slots[part])
                directory.slots[part] = -1
        for part in _parts(coming):
            directory.slots[part] = self._values.brought_back(part)
        directory.fill()
        self._table = self.e.Int(unsigned(self.e, directory.table.view(np.uint32)))
        dr.eval(self._table)
        return True

    def _values_of(self, blocks: IntArray) -> Float32Array:
        """Values (n, sums, 512) of blocks (n,), wherever they are."""
        out = np.empty((len(blocks), len(self._values.sums), POINTS), np.float32)
        slots = self._directory.slots[blocks]
        here = slots >= 0
        out[here], out[~here] = self._values.at(slots[here]), self._values.away(blocks[~here])
        return out


def _check(T_world_cam: FloatArray, lens: Lens) -> None:
    if lens.camera.model != "pinhole" or lens.lines > 1:
        raise ValueError("a volume takes rectified images: a pinhole with a global shutter")
    if not np.isfinite(T_world_cam).all():
        raise UserError("volume: a pose is not finite: leave frames that were not tracked out")


def _parts(blocks: IntArray) -> Iterator[IntArray]:
    """Blocks (n,) a few thousand at a time."""
    for start in range(0, len(blocks), _AT_ONCE):
        yield blocks[start : start + _AT_ONCE]
