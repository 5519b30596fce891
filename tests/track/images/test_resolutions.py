"""Images of any size: what is counted in pixels or lines means the same in small images as in large ones."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic
from rstrack_util import ENGINE, make_terms, maker

from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.alignment.block_sums import block_counts
from rstrack.data.rig import Frame, Image, Rig
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import LEVELS, color_image, depth_image, octaves_finer
from rstrack.keyframes.keyframe import rectified_lens, strides
from rstrack.metrics.association import align
from rstrack.options import Method, Options
from rstrack.tracking.spline_tracker import Tracker

SHUTTER = Shutter(readout_s=0.028)
TRUTH = synthetic.make_spline(0.5)


def camera_of(width: int) -> Camera:
    """Four to three, 67 degrees wide."""
    height = width * 3 // 4
    return Camera(width, height, 0.75 * width, 0.75 * width, (width - 1) / 2, (height - 1) / 2)


def error_mm(depth: Camera, color: Camera, method: Method, frames: int) -> float:
    """ATE of a clean sequence; no frame may be lost."""
    tracker = Tracker(Rig(depth, SHUTTER, color, SHUTTER, synthetic.T_COLOR_DEPTH), Options(method=method))
    for k in range(frames):
        stamp = k / 30.0
        z = synthetic.render_depth(TRUTH, depth, SHUTTER, stamp)
        rgb = synthetic.render_color(TRUTH, color, SHUTTER, stamp, synthetic.T_COLOR_DEPTH)
        tracker.feed(Frame(Image(stamp, z), (Image(stamp, rgb),)))
    assert not any(report.lost for report in tracker.reports)
    stamps, T = tracker.trajectory
    T_true = TRUTH.pose(stamps)
    aligned = se3.transform(align(T_true, T)[0], T[:, :3, 3])
    return float(1e3 * np.sqrt(np.mean(np.sum((aligned - T_true[:, :3, 3]) ** 2, axis=1))))


# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("width", "finest"), [(80, 1), (160, 1), (319, 1), (320, 2), (512, 2), (640, 2), (1280, 4), (1920, 6)]
)
def test_points_are_about_as_many_in_images_of_any_size(width: int, finest: int) -> None:
    height = width * 3 // 4
    assert strides(width, height) == (*(finest * 2**level for level in range(LEVELS)), 2 * finest)
    if width >= 160:
        assert 160 * 120 <= width * height / finest**2 <= 320 * 240 or width < 320


@pytest.mark.parametrize("height", [60, 120, 240, 424, 480, 1080, 1440])
def test_blocks_of_lines_take_as_long_in_images_of_any_size(height: int) -> None:
    lens, still = Lens(camera_of(height * 4 // 3), SHUTTER), rectified_lens(camera_of(height * 4 // 3))
    blocks, _, per, _ = block_counts(lens, still)
    assert 60 <= blocks <= 62 and per * SHUTTER.line_delay(lens.camera) <= 0.48e-3
    pairs = block_counts(lens, lens)
    assert pairs[0] == pairs[1] and 15 <= pairs[0] <= 17


# Coarser colour is only nearly alike: it is halved, while the keyframe's is that, enlarged and blurred.
@pytest.mark.parametrize(
    ("depth_width", "color_width", "finer", "left"), [(160, 640, 2, 0.3), (160, 160, 0, 0.0), (160, 80, -1, 0.9)]
)
def test_both_sides_of_the_photometric_term_are_low_passed_alike(
    depth_width: int, color_width: int, finer: int, left: float
) -> None:
    """A fine texture seen twice from the same place: hardly a residual at any level, `left` of those that there would
    be if levels were taken by their number."""
    depth_camera, color_camera = camera_of(depth_width), camera_of(color_width)
    assert octaves_finer(color_camera, depth_camera) == finer
    spline = synthetic.make_spline(0.0)
    lens = Lens(depth_camera, Shutter())
    z = np.full((depth_camera.height, depth_camera.width), 2.0)  # a wall
    depth = depth_image(ENGINE, Exposure(lens, 0.4, np.eye(4)), z, 10.0)
    x, y = np.moveaxis(color_camera.unproject(color_camera.pixel_grid())[..., :2], -1, 0)
    focal = min(depth_camera.fx, color_camera.fx)  # waves of 3.1 and 3.7 pixels of the coarser camera
    fine = np.sin(2 * np.pi * x * focal / 3.1) + np.sin(2 * np.pi * y * focal / 3.7)
    rgb = np.repeat(np.rint(128 + 50 * fine)[..., None], 3, axis=-1).astype(np.uint8)
    seen_at, terms = Exposure(Lens(color_camera, Shutter()), 0.4, np.eye(4)), make_terms(depth_camera)
    rms = {}
    for octaves in (finer, 0):
        color = color_image(ENGINE, seen_at, rgb, octaves)
        ref = maker(depth_camera).rectified(0, depth, (color,), spline, None)
        # With so large a σ the next one is the residuals' RMS.
        rms[octaves] = [terms.photometric(color, ref, spline, level, 1.0)().next_sigma for level in range(LEVELS)]
    assert rms[finer][0] < 1e-6
    for alike, as_they_are in zip(rms[finer][1:], rms[0][1:], strict=True):
        assert alike < max(1e-6, left * as_they_are)


def test_depth_of_eighty_pixels_is_enough() -> None:
    """Flat pixels alone leave the camera free to slide along the box: by 0.2 m, and no frame said to be lost."""
    assert error_mm(camera_of(80), camera_of(80), "rs-g", 14) < 6.0


def test_depth_four_times_as_coarse_as_colour() -> None:
    assert error_mm(camera_of(80), camera_of(320), "rs-pg", 10) < 1.5
