"""Keyframes of a run as a TUM RGB-D folder: rectified, every frame's depth and colour fused in.

write_keyframes(open_dataset(Path("out/table1")), read_estimate(Path("runs/table1")), Path("keyframes"))
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, write_error
from rsgen.image_codecs import encode_png
from rsgen.sequence.format import DEPTH_SCALE, frame_name, pose_rows
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import TRAJECTORY, Estimate
from rstrack.options import Options

_WEIGHT_SCALE = 1000.0
_FOLDERS = ("rgb", "depth", "weight")


def write_keyframes(
    dataset: Dataset, estimate: Estimate, out: Path, sigma_px: float | None = 1.0, options: Options | None = None,
    progress: Progress = no_progress,
) -> int:  # fmt: skip
    """Write rgb/, depth/, weight/, rgb.txt, depth.txt, trajectory.txt and camera.yaml; returns how many keyframes.

    All are seen by one pinhole, at one moment each. Depth: 16 bit, 5000 units a metre; weights: 16 bit, 1000 for a
    sharp view; trajectory: T_world_cam in the estimate's world. sigma_px: of the blur-aware weights, equation (13);
    None: constant weights. Raises UserError if the estimate has no spline or covers no frame, or `out` is not writable.
    """
    from rstrack.mapping.fused_keyframes import fused_keyframes

    spline = estimate.spline
    if spline is None:
        raise UserError("keyframes: the estimate has no spline, so lines have no poses of their own: use 'rstrack map'")
    try:
        for name in _FOLDERS:
            (out / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from None
    listings: dict[str, list[str]] = {"rgb.txt": [], "depth.txt": [], TRAJECTORY: []}
    camera = None
    covers = lambda t: bool(estimate.spline_covers(t))  # noqa: E731
    for count, done in enumerate(fused_keyframes(dataset, spline, (sigma_px,), options, None, covers, estimate.moving)):
        ref, (image, weight), name = done.reference, done.colors[sigma_px], f"{frame_name(count)}.png"
        z = np.divide(1.0, done.inverse_depth, out=np.zeros_like(done.inverse_depth), where=done.inverse_depth > 0)
        units = np.rint(DEPTH_SCALE * z.astype(np.float64))
        for folder, pixels in (
            ("rgb", image),
            ("depth", np.where(units <= 65535, units, 0).astype(np.uint16)),
            ("weight", np.rint(_WEIGHT_SCALE * weight).astype(np.uint16)),
        ):
            atomic_write(out / folder / name, encode_png(np.ascontiguousarray(pixels)))
        row = " ".join(f"{value:.9f}" for value in pose_rows(ref.T_world_base[None])[0])
        listings["rgb.txt"].append(f"{ref.t:.9f} rgb/{name}")
        listings["depth.txt"].append(f"{ref.t:.9f} depth/{name}")
        listings[TRAJECTORY].append(f"{ref.t:.9f} {row}")
        camera = ref.lens.camera
        progress("keyframes", (done.index + 1) / len(dataset), f"{count + 1} keyframes")
    if camera is None:
        raise UserError("keyframes: the estimate covers no frame of the sequence with depth and colour")
    for name, lines in listings.items():
        atomic_write(out / name, ("\n".join(lines) + "\n").encode())
    size = {"width": camera.width, "height": camera.height}
    intrinsics = [float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
    atomic_write(out / "camera.yaml", encode_yaml({"color": {**size, "intrinsics": intrinsics, "readout_s": 0.0}}))
    return len(listings["rgb.txt"])
