"""Keyframes of a sequence along a known spline, with fused depth and colour, and how good those are.

for done in fused_keyframes(dataset, spline, (None, 1.0)):
    image, weight = done.colors[1.0]
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rsgen.device.arrays import engine
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.data.moving_masks import MovingMasks
from rstrack.images.pyramid import depth_image
from rstrack.keyframes.keyframe import Reference
from rstrack.options import Options

Sigma = float | None
"""σ of equation (13) in px; None: constant weights."""

Colored = tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]
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
    inverse_depth: npt.NDArray[np.float32]
    single_inverse_depth: npt.NDArray[np.float32]
    colors: Mapping[Sigma, Colored]
    most_blurred: Colored


def fused_keyframes(
    dataset: Dataset,
    spline: Spline,
    sigmas: Sequence[Sigma],
    options: Options | None = None,
    frames: Sequence[int] | None = None,
    covers: Callable[[float], bool] = lambda t: True,
    moving: MovingMasks | None = None,
) -> Iterator[FusedKeyframe]:
    """Fuse every frame, in order, into the newest keyframe; its successor inherits depth, colour and weights.

    spline: T_world_depth(t). frames: indices into the dataset, increasing (default: all). covers: whether the spline is
    known at a time in s; frames of which it is not are left out. moving: what is left
    out of them. A new keyframe is made at the distance or angle that
    `options` say.
    """
    options = options or Options()
    # Colour is wanted, whatever the tracker used.
    options = replace(options, method="rs-pg" if options.rolling else "gs-pg")
    e = engine(options.backend)
    # After the engine: it chooses the libLLVM that Dr.Jit loads.
    from rstrack.images.device_frame import DeviceRig, frame_without
    from rstrack.keyframes.maker import KeyframeMaker
    from rstrack.mapping.color_fusion import SIGMA_PX, ColorFusion, FusedColor, linear_image

    device = DeviceRig(dataset.rig, options)
    maker = KeyframeMaker.of(device)
    fusions = {sigma: ColorFusion(e, sigma) for sigma in sigmas}
    viewer = ColorFusion(e, SIGMA_PX)
    ref: Reference | None = None
    colors: dict[Sigma, FusedColor] = {}
    count, single, most_blurred = 0, np.zeros((0, 0), np.float32), None

    def finished(ref: Reference) -> FusedKeyframe:
        assert most_blurred is not None
        rho = e.download(ref.inverse_depth, single.shape)
        images = {sigma: fusion.image(colors[sigma]) for sigma, fusion in fusions.items()}
        return FusedKeyframe(ref.index, ref, count, rho, single, images, viewer.image(most_blurred))

    for k in range(len(dataset)) if frames is None else frames:
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


def depth_errors(dataset: Dataset, done: FusedKeyframe, options: Options | None = None) -> tuple[float, float, int]:
    """RMSE in m of a keyframe's depth: of its frame alone, and fused; and over how many pixels.

    Against the noise-free depth of the same frame, rectified along the true spline to the middle of its readout: what
    the keyframe would be without noise. Pixels that all three know and that do not lie at an edge. The dataset is an
    rsgen sequence.
    """
    from rstrack.images.device_frame import DeviceRig
    from rstrack.keyframes.keyframe import on_one_surface
    from rstrack.keyframes.maker import KeyframeMaker

    assert dataset.sequence is not None and dataset.truth is not None
    options = options or Options()
    e, device = engine(options.backend), DeviceRig(dataset.rig, options)
    exposure = device.upload(0, dataset.frame(done.index, color=False)).depth.exposure
    exact = depth_image(e, exposure, dataset.sequence.truth_depth(done.index), options.max_depth)
    truth = KeyframeMaker.of(device).rectified(done.index, exact, (), dataset.truth, None)
    rho = e.download(truth.inverse_depth, done.inverse_depth.shape)
    known = on_one_surface(rho) & (done.inverse_depth > 0) & (done.single_inverse_depth > 0)
    z = 1.0 / rho[known]
    single, fused = (1.0 / a[known] - z for a in (done.single_inverse_depth, done.inverse_depth))
    return float(np.sqrt(np.mean(single**2))), float(np.sqrt(np.mean(fused**2))), int(known.sum())
