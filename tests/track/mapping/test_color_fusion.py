"""Colour fusion against NumPy in float64: equation (13)'s weights, means, occlusion, holes, inheritance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import synthetic
from rstrack_util import ENGINE, SCANS, T_COLOR_DEPTH, Cast, depth_input, maker, pixel_rays, small_camera

from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter, project_rolling
from rsgen.srgb import decode, encode
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import DepthImage
from rstrack.keyframes.keyframe import Reference
from rstrack.mapping.color_fusion import (
    ColorFusion,
    FusedColor,
    LinearImage,
    linear_image,
    sweep_table,
)

WIDTH, HEIGHT = 96, 72
SHAPE = (HEIGHT, WIDTH)
CAMERA = small_camera("pinhole", WIDTH, HEIGHT)
SPLINE = synthetic.make_spline()
STAMPS = (0.40, 0.47, 0.53)
WAVES = np.array([[5.0, 2.0, 1.0], [1.0, 6.0, -2.0], [-2.0, 1.0, 7.0]])


def cast_box(p: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The box without its ball."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.max((synthetic.BOX[:, *([None] * (p.ndim - 1))] - p) / d, axis=0).min(axis=-1))


def light(p_world: np.ndarray) -> np.ndarray:
    """A smooth texture, linear RGB."""
    return np.asarray(0.5 + 0.4 * np.sin(p_world @ WAVES))


def color_of(cast: Cast, image: Exposure) -> np.ndarray:
    """What a sharp image shows, linear RGB (h, w, 3)."""
    p, d = pixel_rays(SPLINE, image)
    return light(p + d * cast(p, d)[..., None])


def seen_by(cast: Cast, image: Exposure) -> tuple[LinearImage, np.ndarray]:
    """An 8-bit image on the device, and its light."""
    byte = np.rint(255.0 * encode(np.clip(color_of(cast, image), 0.0, 1.0))).astype(np.uint8)
    return linear_image(ENGINE, image, byte), decode(byte / 255.0)


def color_exposure(
    stamp: float, exposure_s: float = 0.02, scan: Scan = "top-bottom", camera: Camera = CAMERA, readout_s: float = 0.028
) -> Exposure:
    return Exposure(Lens(camera, Shutter(readout_s, exposure_s, scan)), stamp, T_COLOR_DEPTH)


def depth_at(cast: Cast, stamp: float) -> DepthImage:
    return depth_input(cast, SPLINE, Exposure(Lens(CAMERA, Shutter(0.028)), stamp, np.eye(4)))


def keyframe(cast: Cast, stamp: float = 0.45) -> Reference:
    return maker(CAMERA).rectified(0, depth_at(cast, stamp), (), SPLINE, None)


def points(ref: Reference) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels have depth (h, w), and their points in the world (n, 3)."""
    rho = ENGINE.download(ref.inverse_depth, SHAPE).astype(float)
    camera = ref.lens.camera
    p = camera.backproject(camera.pixel_grid(), 1.0 / np.where(rho > 0, rho, 1.0))
    return rho > 0, se3.transform(ref.T_world_base, p)[rho > 0]


def planes(fused: FusedColor) -> tuple[np.ndarray, np.ndarray]:
    rgb = np.stack([ENGINE.download(plane, SHAPE) for plane in fused.rgb], axis=-1)
    return rgb.astype(float), ENGINE.download(fused.weight, SHAPE).astype(float)


def twin_lookup(ref: Reference, image: Exposure, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
    """For a keyframe's points (n,): colour (n, 3), px moved in the exposure (n,), and whether it is seen."""
    camera, shutter = image.lens.camera, image.lens.shutter
    _, p_world = points(ref)
    uv, t, valid = project_rolling(SPLINE, image.T_cam_body, camera, shutter, image.stamp, p_world)
    last = np.array([camera.width - 1.0, camera.height - 1.0])
    valid &= ((np.nan_to_num(uv, nan=-1.0) >= 1e-3) & (np.nan_to_num(uv, nan=-1.0) < last - 1e-3)).all(axis=-1)
    uv, t = np.where(valid[:, None], uv, 1.0), np.where(valid, t, image.stamp)
    ends = []
    for at in (t - shutter.exposure_s / 2, t + shutter.exposure_s / 2):
        ends.append(camera.project(se3.transform(image.T_cam_body @ se3.inverse(SPLINE.pose(at)), p_world))[0])
    x0, y0 = np.floor(uv).astype(int).T
    value = np.zeros((len(uv), 3))
    for dy in range(-1, 3):
        for dx in range(-1, 3):
            at = pixels[np.clip(y0 + dy, 0, camera.height - 1), np.clip(x0 + dx, 0, camera.width - 1)]
            value += (keys(uv[:, 0] - x0 - dx) * keys(uv[:, 1] - y0 - dy))[:, None] * at
    return np.maximum(value, 0.0), np.linalg.norm(ends[1] - ends[0], axis=-1), valid


def keys(d: np.ndarray) -> np.ndarray:
    """Cubic convolution, equation (15) of Keys 1981."""
    d = np.abs(d)
    return np.where(d < 1, 1.5 * d**3 - 2.5 * d**2 + 1, np.where(d < 2, -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2, 0.0))


@pytest.mark.parametrize(
    ("model", "scan", "readout_s", "sigma"),
    [
        *[("pinhole", scan, 0.028, 1.0) for scan in SCANS], ("radtan", "top-bottom", 0.028, 2.0),
        ("fisheye", "left-right", 0.02, 0.7), ("pinhole", "top-bottom", 0.0, 1.0),
    ],
)  # fmt: skip
def test_weights_are_those_of_equation_13(model: str, scan: Scan, readout_s: float, sigma: float) -> None:
    image = color_exposure(0.44, 0.02, scan, small_camera(model, WIDTH, HEIGHT), readout_s)
    ref = keyframe(cast_box)
    fusion = ColorFusion(ENGINE, sigma)
    shown, pixels = seen_by(cast_box, image)
    _, weight = planes(fusion.add(fusion.start(ref), ref, shown, depth_at(cast_box, 0.44), SPLINE))
    has, _ = points(ref)
    _, length, seen = twin_lookup(ref, image, pixels)
    assert seen.mean() > 0.7 and np.ptp(length[seen]) > 0.3
    want = np.maximum(np.exp(-length / sigma**2), 1e-6)
    # The distance over the window against its rate in the middle: a thousandth.
    assert np.abs(np.log(weight[has][seen] / want[seen])).max() < 5e-3 * length[seen].max() / sigma**2
    assert not weight[~has].any()


def test_the_mean_is_that_of_numpy() -> None:
    ref, has = keyframe(cast_box), points(keyframe(cast_box))[0]
    for sigma in (1.0, None):
        fusion = ColorFusion(ENGINE, sigma)
        fused, total, mean = fusion.start(ref), np.zeros(has.sum()), np.zeros((has.sum(), 3))
        for stamp in STAMPS:
            shown, pixels = seen_by(cast_box, color_exposure(stamp))
            fused = fusion.add(fused, ref, shown, depth_at(cast_box, stamp), SPLINE)
            value, length, seen = twin_lookup(ref, shown.exposure, pixels)
            w = seen * (1.0 if sigma is None else np.exp(-length / sigma**2))
            mean += w[:, None] * value
            total += w
        rgb, weight = planes(fused)
        both = (total > 0) & (weight[has] > 0)
        assert both.mean() > 0.9 and (both == (total > 0)).mean() > 0.99
        np.testing.assert_allclose(weight[has][both], total[both], rtol=2e-2)
        error = np.abs(rgb[has][both] - mean[both] / total[both][:, None]).max(axis=-1)
        assert np.percentile(error, 99) < 2e-3


def test_fused_colour_is_the_scenes() -> None:
    fusion, ref = ColorFusion(ENGINE), keyframe(synthetic.cast)
    fused = fusion.start(ref)
    for stamp in STAMPS:
        shown, _ = seen_by(synthetic.cast, color_exposure(stamp))
        fused = fusion.add(fused, ref, shown, depth_at(synthetic.cast, stamp), SPLINE)
    image, weight = fusion.image(fused)
    has, p_world = points(ref)
    known = weight > 0
    want = np.zeros((*SHAPE, 3))
    want[has] = 255.0 * encode(np.clip(light(p_world), 0.0, 1.0))
    error = np.abs(image.astype(float) - want).max(axis=-1)[known]
    assert known[has].mean() > 0.95
    # Outlines of the ball mix both sides.
    assert np.median(error) < 1.0 and np.percentile(error, 95) < 3.0
    assert not image[~known].any()


def test_hidden_points_take_no_colour_from_what_hides_them() -> None:
    """The wall behind the ball, seen from where the ball covers another part of it."""
    wall, fusion = keyframe(cast_box, 0.25), ColorFusion(ENGINE, None)
    image = color_exposure(0.60, 0.0)
    shown, _ = seen_by(synthetic.cast, image)
    _, weight = planes(fusion.add(fusion.start(wall), wall, shown, depth_at(synthetic.cast, 0.60), SPLINE))
    has, p_world = points(wall)
    uv, t, seen = project_rolling(SPLINE, T_COLOR_DEPTH, CAMERA, image.lens.shutter, image.stamp, p_world)
    eye = (SPLINE.pose(np.where(seen, t, 0.6)) @ se3.inverse(T_COLOR_DEPTH))[:, :3, 3]
    free = synthetic.cast(eye, p_world - eye)
    inside = seen & ((np.nan_to_num(uv, nan=-9.0) > 2) & (np.nan_to_num(uv) < np.array(SHAPE[::-1]) - 3)).all(axis=-1)
    covered = inside & (free < 0.9)
    assert covered.sum() > 50
    # The depth camera sits five centimetres beside: what it sees of the rim is not quite what the colour camera sees.
    assert (weight[has][covered] == 0).mean() > 0.8
    assert (weight[has][inside & (free > 0.999)] > 0).mean() > 0.9
    # Without the test they would take the ball's colour.
    blind = replace(depth_at(synthetic.cast, 0.60), z=ENGINE.upload(np.zeros(SHAPE)))
    _, weight = planes(fusion.add(fusion.start(wall), wall, shown, blind, SPLINE))
    assert (weight[has][covered] > 0).all()


def test_later_frames_fill_holes() -> None:
    fusion, ref = ColorFusion(ENGINE), keyframe(cast_box, 0.45)
    far, near = color_exposure(0.95), color_exposure(0.45)
    first = fusion.add(fusion.start(ref), ref, seen_by(cast_box, far)[0], depth_at(cast_box, 0.95), SPLINE)
    image, weight = fusion.image(first)
    holes = (weight == 0) & points(ref)[0]
    assert holes.mean() > 0.1 and not image[holes].any()
    second = fusion.add(first, ref, seen_by(cast_box, near)[0], depth_at(cast_box, 0.45), SPLINE)
    _, weight = fusion.image(second)
    assert (weight[holes] > 0).mean() > 0.7


def test_without_blur_both_weights_are_the_same_and_end_at_a_limit() -> None:
    ref, shown = keyframe(cast_box), seen_by(cast_box, color_exposure(0.45, 0.0))[0]
    depth, results = depth_at(cast_box, 0.45), []
    for sigma in (1.0, None):
        fusion = ColorFusion(ENGINE, sigma)
        fused = fusion.start(ref)
        for k in range(40):
            fused = fusion.add(fused, ref, shown, depth, SPLINE)
            if k == 2:
                assert set(np.unique(planes(fused)[1])) == {0.0, 3.0}
        results.append(planes(fused))
    assert all(np.array_equal(a, b) for a, b in zip(*results, strict=True))
    assert results[0][1].max() == 30.0


def test_a_new_keyframe_inherits_colour_and_weight() -> None:
    fusion, old, new = ColorFusion(ENGINE), keyframe(synthetic.cast, 0.40), keyframe(synthetic.cast, 0.52)
    fused = fusion.start(old)
    for stamp in STAMPS:
        shown, _ = seen_by(synthetic.cast, color_exposure(stamp))
        fused = fusion.add(fused, old, shown, depth_at(synthetic.cast, stamp), SPLINE)
    _, before = planes(fused)
    rgb, weight = planes(fusion.inherit(new, fused, old))
    has, p_world = points(new)
    p_old = se3.transform(se3.inverse(old.T_world_base), p_world)
    uv, ok = CAMERA.project(p_old)
    uv = np.where(ok[:, None], uv, -1.0)
    x0, y0 = np.floor(uv).astype(int).T
    inside = (x0 >= 0) & (y0 >= 0) & (x0 < WIDTH - 2) & (y0 < HEIGHT - 2)
    least = np.full(len(uv), np.inf)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        least[inside] = np.minimum(least[inside], before[y0[inside] + dy, x0[inside] + dx])
    given = weight[has] > 0
    assert given.mean() > 0.6 and not given[~inside & ((uv < -1e-3) | (uv > 1e4)).any(axis=-1)].any()
    both = given & inside
    assert np.mean(np.isclose(weight[has][both], least[both], rtol=1e-5)) > 0.99
    error = np.abs(rgb[has][given] - light(p_world)[given]).max(axis=-1)
    assert np.median(error) < 0.01 and np.percentile(error, 95) < 0.05


def test_what_was_hidden_from_the_older_keyframe_inherits_nothing() -> None:
    fusion, old, new = ColorFusion(ENGINE), keyframe(synthetic.cast, 0.2), keyframe(synthetic.cast, 0.7)
    full = FusedColor((old.weight,) * 3, old.weight, SHAPE)
    _, weight = planes(fusion.inherit(new, full, old))
    has, p_world = points(new)
    eye = np.broadcast_to(old.T_world_base[:3, 3], p_world.shape)
    free = synthetic.cast(eye, p_world - eye)
    uv, ok = CAMERA.project(se3.transform(se3.inverse(old.T_world_base), p_world))
    inside = ok & (uv > 3).all(axis=-1) & (uv < np.array(SHAPE[::-1]) - 4).all(axis=-1)
    hidden = inside & (free < 0.9)
    assert hidden.sum() > 50 and not weight[has][hidden].any()
    assert (weight[has][inside & (free > 0.999)] > 0).mean() > 0.85


def test_the_sweep_is_the_motion_of_the_lines_camera() -> None:
    image = color_exposure(0.44, 0.02)
    times = image.times()
    T = SPLINE.pose(np.stack([times - 0.01, times + 0.01])) @ se3.inverse(T_COLOR_DEPTH)
    np.testing.assert_allclose(sweep_table(SPLINE, image), se3.log(se3.inverse(T[0]) @ T[1]), atol=2e-4)
