"""Keyframes of a sequence along a known spline, every frame's depth and colour fused in; as a TUM RGB-D folder.

for done in fused_keyframes(dataset, spline, (None, 1.0), Options(), lambda t: True):
    image, weight = done.colors[1.0]
write_keyframes(open_dataset(Path("out/table1")), read_estimate(Path("runs/table1")), Path("keyframes"))
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array
from rsgen.console.progress import Progress, no_progress
from rsgen.device.arrays import engine
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, write_error
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_png
from rsgen.sequence.format import DEPTH_SCALE, frame_name, pose_rows
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import TRAJECTORY, Estimate
from rstrack.data.moving_masks import MovingMasks
from rstrack.images.device_frame import DeviceRig, frame_without
from rstrack.images.pyramid import depth_image
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.keyframes.surface import on_one_surface
from rstrack.mapping.color_fusion import SIGMA_PX, ColorFusion, FusedColor, linear_image
from rstrack.options import Options

_WEIGHT_SCALE = 1000.0
_FOLDERS = ("rgb", "depth", "weight")

BlurSigma = float | None
"""σ of equation (13) in px; None: constant weights."""

Colored = tuple[npt.NDArray[np.uint8], Float32Array]
"""sRGB (h, w, 3) and weights (h, w)."""


@dataclass(frozen=True)
class FusedKeyframe:
    """A keyframe when the next one takes over.

    index: its depth frame. inverse_depth (h, w): fused, and of its own frame alone (1/m, 0 missing). colors: by σ.
    most_blurred: the frame that counted least of those fused, registered, with its weights for σ = 1 px.
    """

    index: int
    reference: Reference
    frames: int
    inverse_depth: Float32Array
    single_inverse_depth: Float32Array
    colors: Mapping[BlurSigma, Colored]
    most_blurred: Colored


def fused_keyframes(
    dataset: Dataset, spline: Spline, sigmas: Sequence[BlurSigma], options: Options, covers: Callable[[float], bool],
    moving: MovingMasks | None = None,
) -> Iterator[FusedKeyframe]:  # fmt: skip
    """Fuse every frame, in order, into the newest keyframe; its successor inherits depth, colour and weights.

    spline: T_world_depth(t). covers: whether the spline is known at a time in s; frames of which it is not are left
    out. moving: what is left out of them. A new keyframe is made at the distance or angle that `options` say.
    """
    # Colour is wanted, whatever the tracker used.
    options = replace(options, method="rs-pg" if options.rolling else "gs-pg")
    e = engine(options.backend)
    device = DeviceRig(dataset.rig, options)
    maker = KeyframeMaker.of(device)
    fusions = {sigma: ColorFusion(e, sigma) for sigma in sigmas}
    viewer = ColorFusion(e, SIGMA_PX)
    ref: Reference | None = None
    colors: dict[BlurSigma, FusedColor] = {}
    count, single, most_blurred = 0, np.zeros((0, 0), np.float32), None

    def finished(ref: Reference) -> FusedKeyframe:
        assert most_blurred is not None
        rho = e.download(ref.inverse_depth, single.shape)
        images = {sigma: fusion.image(colors[sigma]) for sigma, fusion in fusions.items()}
        return FusedKeyframe(ref.index, ref, count, rho, single, images, viewer.image(most_blurred))

    for k in range(len(dataset)):
        frame = dataset.frame(k)
        new = device.upload(k, frame)
        mask = None if moving is None else moving.grid(k)
        if moving is not None and mask is not None:
            new = frame_without(e, new, mask, moving.stride)
        if not new.colors or not all(covers(t) for t in (new.first_time, new.last_time)):
            continue
        t = new.depth.exposure.mid_time
        if ref is None or options.left_behind(se3.inverse(ref.T_world_base) @ spline.pose(t), 1.0):
            if ref is not None:
                yield finished(ref)
            older, ref = ref, maker.rectified(k, new.depth, (), spline, ref)
            colors = {
                sigma: fusion.start(ref) if older is None else fusion.inherit(ref, colors[sigma], older)
                for sigma, fusion in fusions.items()
            }
            shape = ref.lens.camera.height, ref.lens.camera.width
            alone = maker.rectified(k, new.depth, (), spline, None)
            single = e.download(alone.inverse_depth, shape)
            count, most_blurred, least = 0, None, np.inf
        else:
            ref = maker.fused(ref, new.depth, spline)
        for image, color in zip(frame.colors, new.colors, strict=True):
            light = linear_image(e, color.exposure, image.pixels)
            colors = {
                sigma: fusion.add(colors[sigma], ref, light, new.depth.hider, spline)
                for sigma, fusion in fusions.items()
            }
            alone_color = viewer.add(viewer.start(ref), ref, light, new.depth.hider, spline)
            weight = e.download(alone_color.weight, single.shape)
            mean = float(weight[weight > 0].mean()) if (weight > 0).any() else np.inf
            if most_blurred is None or mean < least:
                most_blurred, least = alone_color, mean
        count += 1
    if ref is not None:
        yield finished(ref)


def depth_errors(dataset: Dataset, done: FusedKeyframe, options: Options) -> tuple[float, float, int]:
    """RMSE in m of a keyframe's depth: of its frame alone, and fused; and over how many pixels.

    Against the noise-free depth of the same frame, rectified along the true spline to the middle of its readout: what
    the keyframe would be without noise. Pixels that all three know and that do not lie at an edge. The dataset is an
    rsgen sequence.
    """
    assert dataset.sequence is not None and dataset.truth is not None
    e, device = engine(options.backend), DeviceRig(dataset.rig, options)
    exposure = device.upload(0, dataset.frame(done.index, color=False)).depth.exposure
    exact = depth_image(e, exposure, dataset.sequence.truth_depth(done.index), options.max_depth)
    truth = KeyframeMaker.of(device).rectified(done.index, exact, (), dataset.truth, None)
    rho = e.download(truth.inverse_depth, done.inverse_depth.shape)
    known = on_one_surface(rho) & (done.inverse_depth > 0) & (done.single_inverse_depth > 0)
    z = 1.0 / rho[known]
    single, fused = (1.0 / a[known] - z for a in (done.single_inverse_depth, done.inverse_depth))
    return float(np.sqrt(np.mean(single**2))), float(np.sqrt(np.mean(fused**2))), int(known.sum())


def write_keyframes(
    dataset: Dataset, estimate: Estimate, out: Path, sigma_px: float | None = 1.0, progress: Progress = no_progress
) -> int:
    """Write rgb/, depth/, weight/, rgb.txt, depth.txt, trajectory.txt and camera.yaml; returns how many keyframes.

    All are seen by one pinhole, at one moment each. Depth: 16 bit, 5000 units a metre; weights: 16 bit, 1000 for a
    sharp view; trajectory: T_world_cam in the estimate's world. sigma_px: of the blur-aware weights, equation (13);
    None: constant weights. Raises UserError if the estimate has no spline or covers no frame, or `out` is not writable.
    """
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
    fused = fused_keyframes(dataset, spline, (sigma_px,), Options(), covers, estimate.moving)
    for count, done in enumerate(fused):
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
