"""The error of baked light against path tracing; and what all measurements of the renderer start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen import srgb
from rsgen.array_types import FloatArray
from rsgen.config.config import Config
from rsgen.console.progress import Progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.produce.camera_sources import small_camera
from rsgen.produce.parts import load_scene, make_integrator, mirrored_samples

Poses = Callable[[Any], FloatArray]
PSNR_FLOOR_DB = 36.0
_REFERENCE_DEPTH = 64  # path length of the reference; Russian roulette ends most paths long before
_REFERENCE_PASS = 64  # samples per pixel of one pass, for progress
_SEEDS = 1_000_000  # of one run's samples
_BAKED_SPP = 256  # samples of the baked picture: what is compared is its light, not its noise


@dataclass(frozen=True)
class LightView:
    """Baked light against path tracing in one view, `stamp` (s).

    psnr_db: in 8-bit-range sRGB before quantisation. surely_db: what it is at least (two standard errors). bias_pct: by
    how much brighter the baked picture is.
    """

    stamp: float
    psnr_db: float
    surely_db: float
    bias_pct: float


def check_light(
    config: Config, spline: Spline, views: int, spp: int, width: int, picture: Path | None, progress: Progress
) -> tuple[str, bool]:
    """`compare_light` of views along a spline as a table, and whether every view is sure to reach PSNR_FLOOR_DB.

    Raises UserError.
    """
    table: list[tuple[str, ...]] = []
    stamps = spread_times(spline.t_begin, spline.t_end, views)
    found = compare_light(config, spline.pose, stamps, spp, width, picture, progress)
    for k, v in enumerate(found):
        numbers = fixed(v.stamp, 2), fixed(v.psnr_db, 1), fixed(v.surely_db, 1), fixed(v.bias_pct, 2, sign="+")
        sure, likely = v.surely_db >= PSNR_FLOOR_DB, v.psnr_db >= PSNR_FLOOR_DB
        table.append((str(k), *numbers, "yes" if sure else "unsure: more --light-spp" if likely else "no"))
    head = ("view", "time, s", "PSNR, dB", "surely, dB", "bias, %", f"at least {PSNR_FLOOR_DB:g}")
    return Table(head, tuple(table)).text(), min(v.surely_db for v in found) >= PSNR_FLOOR_DB


def compare_light(
    config: Config, pose: Poses, stamps: FloatArray, spp: int, width: int, picture: Path | None, progress: Progress,
    lit: tuple[Any, Any, Any] | None = None, seed: int = 0,
) -> list[LightView]:  # fmt: skip
    """Baked against path-traced global-shutter views, of the poses T_world_depth at `stamps` (s), `width` pixels wide.

    Noise is taken out, both pictures': the squared error is the product of two errors, of different samples throughout.
    So is what sRGB's bend makes of the reference's noise (see `_encoded`).
    The uncertainty that this leaves is estimated from the scatter over pixels.
    Writes baked, path-traced and eight times their difference as one picture if a path is given. lit: what `lit_scene`
    returns, if it is at hand. seed: of all samples. Raises UserError.
    """
    scene, baked, mi = lit or lit_scene(config, progress)
    baked.glossy_spp = mirrored_samples(config.light, _BAKED_SPP)
    from rsgen.figures import save_grid
    from rsgen.render.images import ColorRenderer

    camera = view_camera(config, width)
    reference = mi.load_dict({"type": "path", "max_depth": _REFERENCE_DEPTH})
    ours = ColorRenderer(scene, baked, camera, Shutter(), _BAKED_SPP)
    theirs = ColorRenderer(scene, reference, camera, Shutter(), _REFERENCE_PASS)
    found: list[LightView] = []
    rows: list[list[FloatArray]] = []
    passes = 4 * max(1, round(spp / (4 * _REFERENCE_PASS)))
    for view, stamp in enumerate(stamps):
        first_seed = seed * _SEEDS
        mine = [ours.render(pose, float(stamp), first_seed + 2 * view + k).astype(np.float64) for k in (0, 1)]
        quarters = np.zeros((4, *mine[0].shape))
        for k in range(passes):
            quarters[k % 4] += theirs.render(pose, float(stamp), first_seed + 1000 * (view + 1) + k)
            progress(
                "path tracing", (view * passes + k + 1) / (len(stamps) * passes), f"view {view + 1} of {len(stamps)}"
            )
        ours_linear, whole = (mine[0] + mine[1]) / 2, quarters.sum(axis=0) / passes
        quarters *= (4 / passes) * config.color.exposure_gain
        one, other = _encoded(quarters[::2]), _encoded(quarters[1::2])
        exposed = [np.clip(image * config.color.exposure_gain, 0, 1) for image in (*mine, ours_linear, whole)]
        first, second, ours_srgb, their_srgb = map(srgb.encode, exposed)
        psnr, least = srgb.psnr_without_noise((first, second), (one, other))
        # Of what is exposed: a lamp in the picture, a few pixels of a hundred times the light, would be all there is.
        bias = 100 * float(exposed[2].mean() / exposed[3].mean() - 1)
        found.append(LightView(float(stamp), psnr, least, bias))
        rows.append([ours_srgb, their_srgb, np.clip(0.5 + 8 * (ours_srgb - their_srgb), 0, 1)])
    if picture is not None:
        save_grid(rows, ["baked", f"path traced, {passes * _REFERENCE_PASS} spp", "difference x 8"], picture)
    return found


def _encoded(pair: FloatArray) -> FloatArray:
    """sRGB of the mean of two noisy linear images (2, h, w, 3).

    sRGB is concave: noise makes it darker, half as much in the mean of two as in each. So much is put back (jackknife).
    """
    apart = srgb.encode(np.clip(pair, 0, 1)).mean(axis=0)
    return 2 * srgb.encode(np.clip(pair.mean(axis=0), 0, 1)) - apart


def lit_scene(config: Config, progress: Progress) -> tuple[Any, Any, Any]:
    """Scene, baked integrator and the Mitsuba module of a config. Raises UserError."""
    from rsgen.device.backend import mitsuba

    mi = mitsuba(config.backend)
    if config.light.mode != "baked":
        raise UserError("light.mode is 'path': these measurements are about baked light, leave it at 'baked'")
    scene = load_scene(config)
    baked = make_integrator(mi, scene, config, progress)
    return scene, baked, mi


def view_camera(config: Config, width: int) -> Camera:
    """The colour camera with images `width` pixels wide. Raises UserError for more than it has, or less than 8."""
    camera = config.color.camera
    if not 8 <= width <= camera.width:
        raise UserError(f"--light-width {width}: choose 8 to {camera.width}")
    return small_camera(camera, width)


def spread_times(begin: float, end: float, count: int) -> FloatArray:
    """`count` instants spread evenly from begin to end, these left out."""
    return begin + (np.arange(count) + 0.5) / count * (end - begin)
