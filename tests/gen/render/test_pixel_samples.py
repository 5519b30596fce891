"""Samples of a pixel: as evenly spread as Sobol's sequence, scrambled by chance, and frames that are replayed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lit import bake, scene_of
from rendering import constant_twist, dr, mi
from scipy.stats import qmc

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.baked import BakedIntegrator
from rsgen.render.images import ColorRenderer, PixelSamples
from rsgen.render.irradiance import IrradianceField

LOOK_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
LOOK_DOWN[:3, 3] = 0.1, 0.0, 1.4
MOTION = constant_twist((0.3, 0.2, 0.0, 0.1, 0.2, 0.3), LOOK_DOWN)


def drawn(count: int, pixels: int, key: int = 5) -> np.ndarray:
    """(pixels, count, 5) numbers."""
    sample = mi.UInt32(np.tile(np.arange(count, dtype=np.uint32), pixels))
    pixel = mi.UInt32(np.repeat(np.arange(pixels, dtype=np.uint32), count))
    numbers = PixelSamples(count, 5).at(sample, pixel, mi.UInt32(key), 0, 5)
    return np.stack([np.array(x) for x in numbers], axis=-1).reshape(pixels, count, 5)


@pytest.mark.parametrize("count", [1, 8, 16, 64])
def test_each_of_equal_parts_has_one_sample(count: int) -> None:
    """In every dimension, and in the first two together in every shape of box (a (0, m, 2)-net, Niederreiter 1987)."""
    u = drawn(count, 200)
    assert u.min() >= 0 and u.max() < 1
    parts = np.sort(np.floor(u * count).astype(int), axis=1)
    np.testing.assert_array_equal(parts, np.broadcast_to(np.arange(count)[:, None], parts.shape))
    for across in 2 ** np.arange(count.bit_length()):
        box = np.floor(u[..., 0] * across) * (count // across) + np.floor(u[..., 1] * (count // across))
        np.testing.assert_array_equal(np.sort(box, axis=1), np.broadcast_to(np.arange(count), box.shape))


def test_it_is_sobols_sequence_but_for_the_scrambling() -> None:
    """Which two points' highest bits agree is kept: so is how fine the box is that both are in."""
    ours, theirs = drawn(32, 50), qmc.Sobol(5, scramble=False).random_base2(5)

    def shared(u: np.ndarray) -> np.ndarray:
        bits = (u * 2**24).astype(np.int64)
        return np.frexp((bits[..., :, None, :] ^ bits[..., None, :, :]).astype(float))[1]

    # Beyond the fifth bit Sobol's first 32 points are alike, and scrambled ones are not.
    kept = np.maximum(shared(theirs), 19)
    np.testing.assert_array_equal(np.maximum(shared(ours), 19), np.broadcast_to(kept, (50, *kept.shape)))


def test_pixels_and_keys_share_nothing() -> None:
    u = drawn(8, 20_000)
    first = u[:, 0]
    for k in range(5):
        ordered = np.sort(first[:, k])
        assert np.abs(ordered - (np.arange(20_000) + 0.5) / 20_000).max() < 0.015  # Kolmogorov: 0.0115 at 1 %
    other = drawn(8, 20_000, key=6)[:, 0]
    for a, b in ((first[1:], first[:-1]), (first, other), (first[:, 1:], first[:, :-1])):
        correlation = [np.corrcoef(a[:, k], b[:, k])[0, 1] for k in range(a.shape[1])]
        assert np.abs(correlation).max() < 0.03  # four standard deviations


def test_an_edge_errs_much_less_than_with_random_samples() -> None:
    rng = np.random.default_rng(3)
    pixels, count = 2000, 16
    angle, offset = rng.uniform(0, np.pi, (pixels, 1)), rng.uniform(-0.4, 0.4, (pixels, 1))

    def share(u: np.ndarray) -> np.ndarray:
        """Of points (pixels or 1, n, 2 or more) that are beyond each pixel's edge."""
        beyond = (u[..., 0] - 0.5) * np.cos(angle) + (u[..., 1] - 0.5) * np.sin(angle) > offset
        return np.asarray(beyond.mean(axis=1))

    grid = (np.arange(64) + 0.5) / 64
    whole = share(np.stack(np.meshgrid(grid, grid), axis=-1).reshape(1, -1, 2))

    def error(u: np.ndarray) -> float:
        return float(np.mean((share(u) - whole) ** 2))

    # 16^-1.5 to 16^-1, Mitchell 1996
    assert error(drawn(count, pixels)) < 0.4 * error(rng.random((pixels, count, 5)))


# --- frames


@pytest.fixture(scope="module")
def lacquered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, BakedIntegrator]:
    return _lit(tmp_path_factory.mktemp("lacquered"), "0.6,0.3,0.1")


def _lit(folder: Path, color: str) -> tuple[Any, BakedIntegrator]:
    """A lacquered floor beneath two lamps with triangles."""
    floor = f"""<shape type="rectangle"><bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="{color}"/>
        <float name="alpha" value="0.2"/></bsdf></shape>"""
    lamps = [
        f"""<shape type="rectangle"><transform name="to_world"><scale value="0.2"/><rotate x="1" angle="180"/>
        <translate x="{x}" y="0.4" z="{1.0 + abs(x)}"/></transform>
        <emitter type="area"><rgb name="radiance" value="{8 + x},7,6"/></emitter></shape>"""
        for x in (-0.5, 0.6)
    ]
    scene = scene_of(folder, floor, *lamps)
    return scene, BakedIntegrator(IrradianceField(*bake(scene, texel_m=0.1, direct_samples=4)), glossy_spp=2)


def _renderer(lit: tuple[Any, BakedIntegrator]) -> ColorRenderer:
    return ColorRenderer(*lit, Camera(24, 16, 20.0, 20.0, 11.5, 7.5), Shutter(0.02, 0.01), 4)


def _plain(renderer: ColorRenderer, monkeypatch: pytest.MonkeyPatch, *args: Any) -> np.ndarray:
    """A frame by the same code, traced anew."""
    with monkeypatch.context() as patch:
        patch.setattr(renderer, "_replay_direct", renderer._direct)
        patch.setattr(renderer, "_replay_traced", renderer._traced)
        return renderer.render(*args)


def test_a_replayed_frame_is_the_traced_one(lacquered: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """To the bit: other poses, other exposures, another number of mirrored samples."""
    renderer = _renderer(lacquered)
    for k, exposure in enumerate((0.01, 0.01, 0.004, 0.0)):
        args = MOTION, 0.1 * k, k, exposure
        frame = renderer.render(*args)
        np.testing.assert_array_equal(frame, _plain(renderer, monkeypatch, *args))
        assert frame.std() > 0.01
    lacquered[1].glossy_spp = 4
    np.testing.assert_array_equal(renderer.render(*args), _plain(renderer, monkeypatch, *args))
    lacquered[1].glossy_spp = 2


def test_frames_of_scenes_that_come_and_go(lacquered: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = _renderer(lacquered)
    before = renderer.render(MOTION, 0.1, 3)
    other = _lit(tmp_path, "0.1,0.3,0.9")
    np.testing.assert_array_equal(renderer.render(MOTION, 0.1, 3), before)
    there = _renderer(other)
    args = MOTION, 0.1, 3
    np.testing.assert_array_equal(there.render(*args), _plain(there, monkeypatch, *args))
    assert np.abs(there.render(*args) - before).max() > 0.05
    del there, other
    np.testing.assert_array_equal(renderer.render(MOTION, 0.1, 3), before)


def test_exposures_and_readouts_share_their_kernels(lacquered: Any) -> None:
    """An automatic camera has another exposure in each frame, a sweep another readout in each sequence."""

    def renderer(readout: float) -> ColorRenderer:
        return ColorRenderer(*lacquered, Camera(24, 16, 20.0, 20.0, 11.5, 7.5), Shutter(readout, 0.01), 4)

    renderer(0.02).render(MOTION, 0.1, 3, 0.008)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for k, readout in enumerate((0.01, 0.028)):
            other = renderer(readout)
            for frame in range(2):
                other.render(MOTION, 0.1 * frame, frame, 0.001 * (k + frame + 1))
        compiled = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert compiled and all(entry["cache_hit"] and not entry["cache_disk"] for entry in compiled)
