"""The process that renders for the measures `light` and `render`, started by `benchmarks.measures.renderer`.

python -m benchmarks.measures.render_worker JOB

JOB, JSON, states what is to be measured, of which config, with which settings. Lines of JSON on standard output answer:
[stage, fraction, note] of progress, at last an object with `figures`, or with `error`. What libraries print goes to
standard error.

The measure `render` has what a colour frame costs in each mode, and the ratios, all measured in one run on the same
frames. Beside the generator's own modes stand other ways to the same picture: a render for each row, and many sharp
renders averaged.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.check.light import compare_light, lit_scene, spread_times, view_camera
from rsgen.config.config import Config, load_config
from rsgen.console.progress import Progress
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.geometry.shutter import Shutter
from rsgen.produce.parts import lines_of_sight, load_motion, load_scene, mirrored_samples, surfaces_hash
from rstrack.bench.record import peak_mb, reset_peak

MODES = ("still", "rs-blur", "path", "rows", "averaged")
BLUR_S, READOUT_S = 0.020, 0.028
AVERAGED = 64  # sharp renders in the place of a blurred one
# Modes that are divided by others than the still.
_RATIOS = (("path", "rs-blur"), ("rows", "rs-blur"), ("averaged", "rs-blur"))
_ROWS = 32  # rows measured of mode 'rows'; the others cost the same
_PATH_SHARE = 4  # path tracing is slow and its time proportional to its samples: a quarter of them is measured
_ROUNDS = 4  # of the modes that are compared most closely, after one to warm up: what ran before leaves caches cold


def light_figures(config: Config, settings: Mapping[str, Any], progress: Progress) -> dict[str, float]:
    """The figures of the measure `light`, with its settings, `seed` of what is rendered and `picture`, a file to write.

    bake_mb: most memory of this process until the light is there. Raises UserError.
    """
    if config.light.mode != "baked":
        raise UserError("light.mode is 'path': what is measured is baked light")
    view_camera(config, settings["width"])  # a wrong width would else be reported after the bake
    mi = mitsuba(config.backend)
    from rsgen.light.bake import baked_field
    from rsgen.light.lamps import straight_through_bulbs
    from rsgen.light.quality import estimated_quality
    from rsgen.render.baked import BakedIntegrator

    scene = load_scene(config)
    reset_peak()
    begin = time.perf_counter()
    with TemporaryDirectory(prefix="rsgen-light-") as folder:
        field = baked_field(scene, surfaces_hash(config), config.light, Path(folder), progress)
    figures = {"bake_s": time.perf_counter() - begin, "bake_mb": peak_mb()}
    with straight_through_bulbs(scene):
        estimate = estimated_quality(scene, field, config.light.texel_m, *lines_of_sight(config))
    motion = load_motion(config)
    stamps = spread_times(motion.first_stamp, motion.last_stamp, settings["views"])
    views = compare_light(
        config, motion.spline.pose, stamps, settings["spp"], settings["width"], Path(settings["picture"]), progress,
        lit=(scene, BakedIntegrator(field), mi), seed=settings["seed"],
    )  # fmt: skip
    psnr = [view.psnr_db for view in views]
    return {
        "psnr_db": float(np.mean(psnr)),
        "psnr_least_db": min(psnr),
        "surely_least_db": min(view.surely_db for view in views),
        "bias_pct": float(np.mean([view.bias_pct for view in views])),
        **figures,
        "estimate_db": estimate.psnr_db,
        "estimate_least_db": estimate.at_least_db,
        "peak_mb": peak_mb(),
    }


@dataclass(frozen=True)
class Mode:
    """A way to make a frame. seconds: (frame's index, stamp in s) → seconds that the whole frame takes."""

    name: str
    spp: int
    seconds: Callable[[int, float], float]
    rounds: int = 1


@dataclass(frozen=True)
class ModeTimes:
    """Seconds a frame of one mode (frames, rounds), and the samples that a frame has, in millions."""

    seconds: FloatArray
    msamples: float


def time_modes(
    config: Config, frames: int, spp: int, modes: Sequence[str], progress: Progress
) -> tuple[dict[str, ModeTimes], dict[str, str]]:
    """Time the modes, names of MODES, on `frames` frames spread over the config's trajectory.

    All modes render each frame before the next frame's turn comes; a frame before the first compiles kernels. spp:
    samples per pixel. Returns the times by mode, and why a mode failed, by mode. Raises UserError.
    """
    # Fitted for the shutter that is timed here, so that its lines find a pose in the shortest trajectory.
    timed = config.color.model_copy(update={"readout_s": READOUT_S, "exposure_s": BLUR_S})
    motion = load_motion(config.model_copy(update={"color": timed}))
    scene, baked, mi = lit_scene(config, progress)
    baked.glossy_spp = mirrored_samples(config.light, spp)
    stamps = spread_times(motion.first_stamp, motion.last_stamp, frames + 1)
    camera = config.color.camera
    chosen = [m for m in _modes(config, scene, baked, mi, motion.spline.pose, spp) if m.name in modes]
    seconds, failed = _measure(chosen, stamps, progress)
    pixels = camera.width * camera.height
    times = {
        m.name: ModeTimes(np.array(seconds[m.name]), 1e-6 * pixels * m.spp) for m in chosen if m.name not in failed
    }
    return times, failed


def figures_of(times: Mapping[str, ModeTimes]) -> dict[str, float]:
    """Flat figures: of every mode its median seconds a frame and millions of samples a second, and ratios of times.

    MODE_ratio: over the still; MODE_to_OTHER_ratio: over another mode. Names have _ for -.
    """
    found: dict[str, float] = {}
    for mode, t in times.items():
        median = float(np.median(t.seconds))
        found |= {f"{mode}_s": median, f"{mode}_msamples_s": t.msamples / median}
    for mode, against, name in (
        *((mode, "still", f"{mode}_ratio") for mode in times if mode != "still"),
        *((mode, against, f"{mode}_to_{against}_ratio") for mode, against in _RATIOS),
    ):
        if mode in times and against in times:
            found[name] = _ratio(times[mode].seconds, times[against].seconds)
    return {name.replace("-", "_"): value for name, value in found.items()}


def render_figures(config: Config, settings: Mapping[str, Any], progress: Progress) -> dict[str, float]:
    """The figures of the measure `render`, with its settings. Raises UserError, if no mode could be timed too."""
    times, failed = time_modes(config, settings["frames"], settings["spp"], settings["modes"], progress)
    if not times:
        raise UserError("; ".join(f"{mode}: {why}" for mode, why in failed.items()))
    return figures_of(times) | {"peak_mb": peak_mb()}


def row_renderer(scene: Any, integrator: Any, camera: Any, spp: int) -> Any:
    """A ColorRenderer of single rows: `sensor.row` is the row of `camera` that comes next."""
    import mitsuba as mi

    from rsgen.render.images import ColorRenderer
    from rsgen.render.sensor import RollingShutterSensor

    class RowSensor(RollingShutterSensor):
        """One row of a picture."""

        row = mi.Float(0)

        @property
        def state(self) -> list[Any]:
            return [*super().state, self.row]

        def _direction(self, u: Any, v: Any) -> Any:
            return super()._direction(u, v + self.row)

    line = replace(camera, height=1)
    renderer = ColorRenderer(scene, integrator, line, Shutter(), spp)
    renderer.sensor = RowSensor(line, Shutter())
    return renderer


def render_rows(renderer: Any, pose: Any, stamp: float, delay: float, rows: Sequence[int]) -> Float32Array:
    """Linear RGB (n, w, 3) of n rows, a render for each, row r at stamp + r · delay (s): sharp, rolling shutter."""
    import drjit as dr
    import mitsuba as mi

    images = []
    for row in rows:
        renderer.sensor.row = dr.opaque(mi.Float, row)  # a literal would be compiled into a kernel of its own
        images.append(renderer.render(pose, stamp + row * delay, row))
    return np.concatenate(images)


def render_averaged(renderer: Any, pose: Any, stamp: float, exposure_s: float, count: int) -> Float32Array:
    """Linear RGB (h, w, 3): mean of `count` sharp global-shutter renders over the exposure that ends at `stamp` (s)."""
    times = stamp - exposure_s * (1 - (np.arange(count) + 0.5) / count)
    return np.mean([renderer.render(pose, float(t), k) for k, t in enumerate(times)], axis=0)


def _modes(config: Config, scene: Any, baked: Any, mi: Any, pose: Any, spp: int) -> list[Mode]:
    from rsgen.render.images import ColorRenderer

    camera, still, moving = config.color.camera, Shutter(), Shutter(READOUT_S, BLUR_S)
    path = mi.load_dict({"type": "path", "max_depth": config.light.max_depth})
    path_spp, each = max(1, spp // _PATH_SHARE), max(1, spp // AVERAGED)
    h, n = camera.height, min(_ROWS, camera.height)
    rows = ((np.arange(n) + 0.5) * h / n).astype(int).tolist()
    by_row = row_renderer(scene, baked, camera, spp)
    one, blurred = (ColorRenderer(scene, baked, camera, shutter, spp) for shutter in (still, moving))
    traced = ColorRenderer(scene, path, camera, moving, path_spp)
    sharp = ColorRenderer(scene, baked, camera, still, each)
    delay = moving.line_delay(camera)
    return [
        Mode("still", spp, lambda k, t: _time(one.render, pose, t, k), _ROUNDS),
        Mode("rs-blur", spp, lambda k, t: _time(blurred.render, pose, t, k), _ROUNDS),
        Mode("path", spp, lambda k, t: _time(traced.render, pose, t, k) * spp / path_spp),
        Mode("rows", spp, lambda _, t: _time(render_rows, by_row, pose, t, delay, rows) * h / n),
        Mode("averaged", each * AVERAGED, lambda _, t: _time(render_averaged, sharp, pose, t, BLUR_S, AVERAGED)),
    ]


def _measure(
    modes: Sequence[Mode], stamps: FloatArray, progress: Progress
) -> tuple[dict[str, list[list[float]]], dict[str, str]]:
    """Seconds by mode, frame and round, the first frame left out; and why a mode failed, by name."""
    seconds: dict[str, list[list[float]]] = {m.name: [] for m in modes}
    failed: dict[str, str] = {}
    for k, stamp in enumerate(stamps):
        of_frame: dict[str, list[float]] = {m.name: [] for m in modes}
        for turn in range(_ROUNDS + 2):
            # Close comparisons in turn, the first time to warm up; the long modes once, after them.
            last = turn == _ROUNDS + 1
            for m in modes:
                if m.name in failed or last != (m.rounds == 1):
                    continue
                try:
                    of_frame[m.name].append(m.seconds(k, float(stamp)))
                except UserError as error:
                    failed[m.name] = str(error)
            progress("timing", (k + (turn + 1) / (_ROUNDS + 2)) / len(stamps), f"frame {k + 1} of {len(stamps)}")
        for m in modes:
            if k > 0:
                seconds[m.name].append(of_frame[m.name][-m.rounds :])
    return seconds, failed


def _time(function: Callable[..., object], *arguments: Any) -> float:
    begin = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - begin


def _ratio(a: FloatArray, b: FloatArray) -> float:
    """Median over pairs of the same frame: round by round where both have as many, else the frames' medians."""
    pairs = a / b if a.shape == b.shape else np.median(a, axis=1) / np.median(b, axis=1)
    return float(np.median(pairs))


def main(job: dict[str, Any]) -> None:
    """Measure and answer."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def tell(*progress: object) -> None:
        print(json.dumps(progress), file=answers)

    figures_of = {"light": light_figures, "render": render_figures}[job["what"]]
    answer: dict[str, Any]
    try:
        config = load_config(Path(job["config"]), job["fields"])
        answer = {"figures": figures_of(config, job["settings"], tell)}
    except UserError as error:
        answer = {"error": str(error)}
    print(json.dumps(answer), file=answers)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
