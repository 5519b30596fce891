"""What a colour frame costs in each mode, and the ratios, all measured in one run on the same frames.

times, failed = time_modes(config, frames=5, spp=64, modes=MODES, progress=progress)
print(figures_of(times))          # {"still_s": ..., "rs_blur_s": ..., "rs_blur_ratio": ...}

Beside the generator's own modes stand other ways to the same picture: a render for each line, many sharp renders
averaged, and Blender.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.check.light import lit_scene, spread_times
from rsgen.config.config import Config
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry.shutter import Shutter
from rsgen.produce.frame_source import mirrored_samples
from rsgen.produce.ground_truth import load_motion
from rstrack.bench.machine import peak_mb

MODES = ("still", "rs-blur", "path", "rows", "averaged")
BLENDER_MODES = ("blender-still", "blender")
BLUR_S, READOUT_S = 0.020, 0.028
AVERAGED = 64  # sharp renders in the place of a blurred one
# Modes that are divided by others than the still.
_RATIOS = (
    ("path", "rs-blur"), ("rows", "rs-blur"), ("averaged", "rs-blur"), ("blender", "rs-blur"), ("blender", "path"),
    ("blender", "blender-still"),
)  # fmt: skip
_ROWS = 32  # rows measured of mode 'rows'; the others cost the same
_PATH_SHARE = 4  # path tracing is slow and its time proportional to its samples: a quarter of them is measured
_ROUNDS = 4  # of the modes that are compared most closely, after one to warm up: what ran before leaves caches cold


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
    """Time the modes, names of MODES and BLENDER_MODES, on `frames` frames spread over the config's trajectory.

    All modes render each frame before the next frame's turn comes; a frame before the first compiles kernels. spp:
    samples per pixel. Returns the times by mode, and why a mode failed, by mode. Raises UserError.
    """
    if set(modes) & set(BLENDER_MODES):
        from benchmarks.rendering.blender import check_installed

        check_installed()
    # Fitted for the shutter that is timed here, so that its lines find a pose in the shortest trajectory.
    timed = config.color.model_copy(update={"readout_s": READOUT_S, "exposure_s": BLUR_S})
    motion = load_motion(config.model_copy(update={"color": timed}))
    scene, baked, mi = lit_scene(config, progress)
    baked.glossy_spp = mirrored_samples(config.light, spp)
    stamps = spread_times(motion, frames + 1)
    camera = config.color.camera
    with ExitStack() as stack:
        chosen = [m for m in _our_modes(config, scene, baked, mi, motion.spline.pose, spp) if m.name in modes]
        names = [name for name in BLENDER_MODES if name in modes]
        if names:
            progress("starting Blender", 0.0, "handing the scene over")
            chosen += _blender_modes(config, scene, motion.spline.pose, stamps, spp, names, stack)
            progress("starting Blender", 1.0, "ready")
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
    """A ColorRenderer of single rows: `sensor.row` says which row of `camera` comes next."""
    import mitsuba as mi

    from rsgen.render.images import ColorRenderer
    from rsgen.render.sensor import RollingShutterSensor

    class RowSensor(RollingShutterSensor):
        """One row of a picture."""

        row = mi.Float(0)

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


def _our_modes(config: Config, scene: Any, baked: Any, mi: Any, pose: Any, spp: int) -> list[Mode]:
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


def _blender_modes(
    config: Config, scene: Any, pose: Any, stamps: FloatArray, spp: int, names: Sequence[str], stack: ExitStack
) -> list[Mode]:
    """Blender's modes; the process lives as long as the stack. Frame k's exposure in mode i is number k · modes + i."""
    from benchmarks.rendering.blender import BlenderRenderer, exposure

    shutters = {"blender-still": Shutter(), "blender": Shutter(READOUT_S, BLUR_S)}
    exposures = [exposure(pose, shutters[name], float(t)) for t in stamps for name in names]
    blender = stack.enter_context(BlenderRenderer(scene, config.color.camera, exposures, spp, config.light.max_depth))

    def mode(i: int, name: str) -> Mode:
        return Mode(name, spp, lambda k, _: blender.time(k * len(names) + i))

    return [mode(i, name) for i, name in enumerate(names)]


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
