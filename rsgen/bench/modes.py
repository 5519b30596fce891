"""What a colour frame costs in each mode, and the ratios, all measured in one run on the same frames.

    print(time_modes(config, frames=5, spp=64, modes=MODES, progress=progress).text())

Beside the generator's own modes stand other ways to the same picture: a render for each line, many sharp renders
averaged, and Blender.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.bench.table import AVERAGED, BLUR_S, READOUT_S, BenchTimes, ModeTimes
from rsgen.check.light import lit_scene, spread_times
from rsgen.config.config import Config
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.geometry.shutter import Shutter
from rsgen.produce.frame_source import mirrored_samples
from rsgen.produce.generate import engine_versions
from rsgen.produce.ground_truth import load_motion

MODES = ("still", "rs-blur", "path", "rows", "averaged")
BLENDER_MODES = ("blender-still", "blender")
_ROWS = 32  # rows measured of mode 'rows'; the others cost the same
_PATH_SHARE = 4  # path tracing is slow and its time proportional to its samples: a quarter of them is measured
_ROUNDS = 4  # of the modes that are compared most closely, after one to warm up: what ran before leaves caches cold


@dataclass(frozen=True)
class Mode:
    """A way to make a frame. seconds: (frame's index, stamp in s) → seconds that the whole frame takes."""

    name: str
    title: str
    spp: int
    seconds: Callable[[int, float], float]
    rounds: int = 1
    measured: str = "all"


def time_modes(config: Config, frames: int, spp: int, modes: Sequence[str], progress: Progress) -> BenchTimes:
    """Time the modes, names of MODES and BLENDER_MODES, on `frames` frames spread over the config's trajectory.

    All modes render each frame before the next frame's turn comes; a frame before the first compiles kernels. spp:
    samples per pixel. Raises UserError.
    """
    if set(modes) & set(BLENDER_MODES):
        from rsgen.bench.blender import check_installed

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
    times = tuple(
        ModeTimes(m.name, m.title, m.spp, m.measured, np.array(seconds[m.name])) for m in chosen if m.name not in failed
    )
    machine = {"cores": os.cpu_count(), "processor": platform.machine()}
    return BenchTimes(camera.width, camera.height, machine | engine_versions(config), times, failed)


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
        Mode("still", "baked, sharp, all rows at once", spp, lambda k, t: _time(one.render, pose, t, k), _ROUNDS),
        Mode(
            "rs-blur", "baked, rolling shutter + blur", spp, lambda k, t: _time(blurred.render, pose, t, k), _ROUNDS
        ),
        Mode(
            "path", f"path traced to depth {config.light.max_depth}, rolling shutter + blur", spp,
            lambda k, t: _time(traced.render, pose, t, k) * spp / path_spp, measured=f"{path_spp} of {spp} spp",
        ),
        Mode(
            "rows", "baked, a render for each row, sharp", spp,
            lambda _, t: _time(render_rows, by_row, pose, t, delay, rows) * h / n, measured=f"{n} of {h} rows",
        ),
        Mode(
            "averaged", f"baked, {AVERAGED} sharp renders averaged", each * AVERAGED,
            lambda _, t: _time(render_averaged, sharp, pose, t, BLUR_S, AVERAGED),
        ),
    ]  # fmt: skip


def _blender_modes(
    config: Config, scene: Any, pose: Any, stamps: FloatArray, spp: int, names: Sequence[str], stack: ExitStack
) -> list[Mode]:
    """Blender's modes; the process lives as long as the stack. Frame k's exposure in mode i is number k · modes + i."""
    from rsgen.bench.blender import BlenderRenderer, exposure

    kinds = {
        "blender-still": (Shutter(), "sharp, all rows at once"),
        "blender": (Shutter(READOUT_S, BLUR_S), "rolling shutter + blur"),
    }
    exposures = [exposure(pose, kinds[name][0], float(t)) for t in stamps for name in names]
    depth = config.light.max_depth
    blender = stack.enter_context(BlenderRenderer(scene, config.color.camera, exposures, spp, depth))

    def mode(i: int, name: str) -> Mode:
        title = f"Blender {blender.version}, Cycles on the CPU to depth {depth}, {kinds[name][1]}"
        return Mode(name, title, spp, lambda k, _: blender.time(k * len(names) + i))

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
