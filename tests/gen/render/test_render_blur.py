"""Blur: a blurred frame is the mean of sharp ones over each line's own window, pixel by pixel, up to random noise.

Sharp frames are stamped at 64 sub-times, one drawn in each 64th of the exposure: a sharp frame stamped τ before the
stamp shows every line τ before that line's exposure ends. Noise of both sides is taken from independent repetitions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tiny
from rendering import constant_twist, mi
from scipy import stats

from rsgen.config.config import load_config
from rsgen.config.sections import TruthConfig
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.produce import parts
from rsgen.render.images import ColorRenderer
from rsgen.sensors.color import to_srgb8
from rsgen.truth.renderer import TruthRenderer

CAMERA = Camera(tiny.WIDTH, tiny.HEIGHT, 36.0, 36.0, 23.5, 17.5)
MOTION = constant_twist((0.5, -0.3, 0.4, 0.5, -0.9, 0.6), se3.exp(np.array([0.0, 0.1, -0.5, 0.05, -0.1, 0.1])))
STAMP, READOUT, EXPOSURE = 0.12, 0.028, 0.02
STRATA = 64
BLURRED, SHARP = 48, 5  # repetitions
SCANS: tuple[Scan, Scan] = ("top-bottom", "left-right")


@pytest.fixture(scope="module")
def lit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, Any]:
    """The tiny room with its baked light: scene, integrator, config."""
    config = load_config(tiny.write_config(tmp_path_factory.mktemp("tiny"), color={"exposure_s": EXPOSURE}))
    scene = parts.load_scene(config)
    return scene, parts.make_integrator(mi, scene, config, lambda *_: None), config


def frames(lit: Any, shutter: Shutter, spp: int, seeds: range, stamp: float = STAMP) -> np.ndarray:
    """Linear frames (n, h, w, 3) of the tiny room, one a seed."""
    renderer = ColorRenderer(lit[0], lit[1], CAMERA, shutter, spp)
    return np.stack([renderer.render(MOTION, stamp, seed) for seed in seeds]).astype(np.float64)


@pytest.fixture(scope="module", params=SCANS)
def references(request: pytest.FixtureRequest, lit: Any) -> tuple[Scan, np.ndarray]:
    """The scan and means (n, h, w, 3) of sharp frames over the exposure, one sub-time drawn in each 64th of it."""
    renderer = ColorRenderer(lit[0], lit[1], CAMERA, Shutter(READOUT, 0.0, request.param), 16)
    rng = np.random.default_rng(5)
    means = []
    for k in range(SHARP):
        before = EXPOSURE * (np.arange(STRATA) + rng.random(STRATA)) / STRATA
        sharp = [renderer.render(MOTION, STAMP - t, 1000 * k + 100 + j) for j, t in enumerate(before)]
        means.append(np.mean(sharp, axis=0, dtype=np.float64))
    return request.param, np.stack(means)


def z_squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Squared z-score per pixel and channel of the difference of the means of two sets of frames (n, h, w, 3)."""
    floor = 1e-6**2  # float32
    variance = a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b)
    return np.asarray((a.mean(axis=0) - b.mean(axis=0)) ** 2 / (variance + floor))


def test_a_blurred_line_is_the_mean_of_sharp_ones_over_its_window(lit: Any, references: Any) -> None:
    scan, sharp = references
    blurred = frames(lit, Shutter(READOUT, EXPOSURE, scan), 16, range(BLURRED))
    z2 = z_squared(blurred, sharp)
    # The variance is known from BLURRED frames (the other side's is far smaller): Student's t, whose square has this
    # mean. Five standard errors with neighbours and channels taken as if only a third of the values were independent.
    degrees = BLURRED - 1
    mean = stats.f.mean(1, degrees)
    error = np.sqrt(stats.f.var(1, degrees) / (z2.size / 3))
    assert abs(z2.mean() - mean) < 5 * error
    assert z2.max() < stats.f.isf(1e-5 / z2.size, 1, degrees)
    # Line by line: none stands out.
    lines = z2.mean(axis=(1, 2)) if scan == "top-bottom" else z2.mean(axis=(0, 2))
    assert lines.max() < 2 and lines.min() > 0.4


@pytest.mark.parametrize("shift, expected", [(-0.5, 300), (0.5, 300), (0.05, 3)])
def test_a_shifted_window_is_noticed(lit: Any, references: Any, shift: float, expected: float) -> None:
    """The same statistics with a window off by half, or a twentieth, of the exposure: outside what is allowed above."""
    scan, sharp = references
    stamp = STAMP + shift * EXPOSURE
    z2 = z_squared(frames(lit, Shutter(READOUT, EXPOSURE, scan), 16, range(BLURRED), stamp), sharp)
    assert z2.mean() > expected and z2.max() > 10 * expected
    lines = z2.mean(axis=(1, 2)) if scan == "top-bottom" else z2.mean(axis=(0, 2))
    assert np.median(lines) > 0.5 * expected


def test_the_other_scan_is_noticed(lit: Any, references: Any) -> None:
    scan, sharp = references
    other = SCANS[1 - SCANS.index(scan)]
    assert z_squared(frames(lit, Shutter(READOUT, EXPOSURE, other), 16, range(BLURRED)), sharp).mean() > 10


def test_no_exposure_is_the_limit_of_short_ones(lit: Any) -> None:
    sharp, nearly, blurred = (frames(lit, Shutter(READOUT, t), 16, range(2)) for t in (0.0, 1e-7, EXPOSURE))
    assert np.mean(np.abs(nearly - sharp) < 1e-4) > 0.99  # the rest: texture edges within a sample's rounding
    assert np.mean(np.abs(blurred - sharp) < 1e-4) < 0.6


@pytest.mark.parametrize("scan", SCANS)
def test_the_sharp_twin_shows_the_middle_of_the_exposure(lit: Any, scan: Scan) -> None:
    """Of the sharp frames within the exposure, none resembles the blurred one more than the twin."""
    scene, integrator, config = lit
    color = config.color.model_copy(update={"readout_s": READOUT, "scan": scan})
    twin = TruthRenderer(scene, integrator, color, TruthConfig(sharp=True, spp=256)).render(MOTION, STAMP, None, 1)
    blurred = to_srgb8(frames(lit, Shutter(READOUT, EXPOSURE, scan), 256, range(1))[0].astype(np.float32))
    before = EXPOSURE * np.linspace(0, 1, 11)
    sharp = [frames(lit, Shutter(READOUT, 0, scan), 256, range(1), STAMP - t)[0].astype(np.float32) for t in before]

    def distance(image: np.ndarray) -> float:
        return float(np.mean((image.astype(float) - blurred) ** 2))

    distances = [distance(to_srgb8(s)) for s in sharp]
    assert int(np.argmin(distances)) == 5
    # Its samples lie elsewhere in the pixels than those of the others, which share theirs with the blurred frame.
    assert distance(twin["sharp"]) < min(distances[4], distances[6]) < 0.5 * min(distances[0], distances[-1])
