"""From a configuration to a sequence folder: read, fit, light, render, write. A run can be stopped and resumed."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.config import Config
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml
from rsgen.fit import FitResult, fit_spline
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence_format import STREAMS, stream_stamps
from rsgen.sequence_writer import SequenceWriter
from rsgen.trajectory import read_trajectory

log = logging.getLogger("rsgen")

# About 12 days. Up to here a float64 tells 0.1 ns apart; in Unix time 0.24 us, half a percent of a line delay.
_LARGEST_STAMP_S = 1e6
# Written frames that may wait for the disk: bounds memory and how much a kill can lose.
_WRITE_AHEAD = 4

# What a sequence folder remembers of the machine that rendered it, for commands that render again. Not part of the
# format: a sequence is whole without it.
ORIGIN = "origin.yaml"

Progress = Callable[[str, float, str], None]  # stage ("light" or "frames"), fraction done in [0, 1], note


@dataclass(frozen=True)
class Motion:
    """The ground truth of a config: fitted spline of the body (depth camera), what the fit missed, recorded stamps."""

    spline: Spline
    fit: FitResult
    first_stamp: float
    last_stamp: float


def load_motion(config: Config) -> Motion:
    """Read, place and fit the config's trajectory; the spline covers every line of every frame.

    Stamps stay those of the file unless they are too large to time a line by (Unix time): then the first becomes 0.
    Raises UserError naming the trajectory's file and line.
    """
    settings = config.trajectory
    trajectory = read_trajectory(settings.file, format=settings.format, icl_start=settings.icl_start)
    if np.abs(trajectory.stamps).max() >= _LARGEST_STAMP_S:
        log.info("%s: large stamps, so time counts from the first, %.9f s", settings.file, trajectory.stamps[0])
        trajectory = trajectory.rebased()
    if settings.T_world_file is not None:
        trajectory = trajectory.moved(np.asarray(settings.T_world_file, float))
    streams = (config.color, config.depth)
    before = max(s.exposure_s - min(s.offset_s, 0.0) for s in streams)
    after = max(s.readout_s for s in streams)
    fit = fit_spline(
        trajectory, dt=settings.knot_spacing_s, smoothing=settings.smoothing, pad_begin_s=before, pad_end_s=after
    )
    return Motion(fit.spline, fit, float(trajectory.stamps[0]), float(trajectory.stamps[-1]))


def sequence_stamps(config: Config, motion: Motion) -> dict[str, NDArray[np.float64]]:
    """Stamps (n,) in seconds of all frames of both streams."""
    return {s: stream_stamps(motion.first_stamp, motion.last_stamp, getattr(config, s)) for s in STREAMS}


def load_scene(config: Config) -> Any:
    """The config's Mitsuba scene. Raises UserError."""
    from rsgen.backend import mitsuba

    mitsuba(config.backend)
    from rsgen import scene

    return scene.load_scene(config.scene.file)


class FrameSource:
    """Frames of a config's two streams, rendered on demand; with `global_shutter` all lines at once."""

    def __init__(
        self,
        config: Config,
        progress: Progress = lambda *_: None,
        global_shutter: bool = False,
        scene: Any = None,
    ) -> None:
        """Load the scene, unless it is given, and its light (baked now if no cache has it). Raises UserError."""
        from rsgen.backend import mitsuba

        mi = mitsuba(config.backend)
        from rsgen import render

        self._config = config
        self.scene = scene or load_scene(config)
        integrator = make_integrator(mi, self.scene, config, lambda f, what: progress("light", f, what))
        pick = render.global_shutter if global_shutter else lambda shutter: shutter
        color, depth = config.color, config.depth
        self._color = render.ColorRenderer(self.scene, integrator, color.camera, pick(color.shutter), color.spp)
        self._depth = render.DepthRenderer(self.scene, depth.camera, pick(depth.shutter))
        self._T_depth_color = se3.inverse(np.asarray(config.T_color_depth, float))

    def linear_color(self, spline: Spline, stamp: float, frame: int) -> NDArray[np.float32]:
        """Linear RGB (h, w, 3) of the colour frame at `stamp` (s); seeded by the config's seed and `frame`."""
        seed = int(np.random.SeedSequence([self._config.seed, frame]).generate_state(1)[0])
        return self._color.render(lambda t: spline.pose(t) @ self._T_depth_color, stamp, seed)

    def color(self, spline: Spline, stamp: float, frame: int) -> NDArray[np.uint8]:
        """8-bit sRGB (h, w, 3) of the colour frame at `stamp` (s)."""
        from rsgen.render import to_srgb8

        return to_srgb8(self.linear_color(spline, stamp, frame), self._config.color.exposure_gain)

    def depth(self, spline: Spline, stamp: float) -> NDArray[np.float32]:
        """Planar z (h, w) in metres of the depth frame at `stamp` (s); 0 where there is nothing."""
        return self._depth.render(spline.pose, stamp)


def make_integrator(mi: Any, scene: Any, config: Config, progress: Callable[[float, str], None]) -> Any:
    """Mitsuba integrator of the config's light: `path`, or `BakedIntegrator` over the scene's baked irradiance."""
    light = config.light
    if light.mode == "path":
        return mi.load_dict({"type": "path", "max_depth": light.max_depth})
    from rsgen.integrator import BakedIntegrator
    from rsgen.lighting import baked_field, cache_folder
    from rsgen.scene import content_hash

    file = config.scene.file
    return BakedIntegrator(baked_field(scene, content_hash(file), light, cache_folder(file), progress))


def render_sequence(config: Config, out: Path, frames: slice, progress: Progress) -> Path:
    """Render the missing frames among `frames` into `out` and (re)write its listings and truth; returns `out`.

    Raises UserError on any bad input, or if `out` holds another sequence; nothing already written is lost.
    """
    motion = load_motion(config)
    stamps = sequence_stamps(config, motion)
    if frames.start is not None and frames.start >= (longest := max(map(len, stamps.values()))):
        raise UserError(f"--frames: the sequence has no frame {frames.start}, only 0 to {longest - 1}")
    identity = engine_versions(config), input_hashes(config)
    # In a new folder: a scene that does not load must not leave one behind that its mended self cannot continue.
    scene = None if (out / "sequence.yaml").exists() else load_scene(config)
    writer = SequenceWriter.open(out, config, motion.spline, stamps["color"], stamps["depth"], *identity)
    write_origin(out, config)
    todo = sorted(
        [(k, stream) for stream in STREAMS for k in _chosen(writer.missing(stream), frames, len(stamps[stream]))],
    )
    source = FrameSource(config, progress, scene=scene) if todo or not (out / "scene.ply").is_file() else None
    if source is not None and not (out / "scene.ply").is_file():
        write_scene_ply(source.scene, out / "scene.ply")
    done = 0
    with ThreadPoolExecutor(max_workers=2) as pool:
        pending: list[Future[None]] = []
        try:
            for k, stream in todo:
                assert source is not None
                stamp = float(writer.stamps(stream)[k])
                if stream == "color":
                    pending.append(pool.submit(writer.write_color, k, source.color(writer.spline, stamp, k)))
                else:
                    pending.append(pool.submit(writer.write_depth, k, source.depth(writer.spline, stamp)))
                while len(pending) > _WRITE_AHEAD:
                    pending.pop(0).result()
                done += 1
                progress("frames", done / len(todo), f"frame {k}")
            for write in pending:
                write.result()
        except (KeyboardInterrupt, SystemExit):
            # A run that the user ends here leaves a readable, shorter sequence.
            for write in pending:
                write.result()
            writer.finish()
            raise
    writer.finish()
    return out


def _chosen(missing: Iterable[int], frames: slice, count: int) -> list[int]:
    wanted = set(range(*frames.indices(count)))
    return [k for k in missing if k in wanted]


def write_scene_ply(scene: Any, path: Path) -> None:
    """All triangles of the scene, world frame, metres, as binary PLY. Raises UserError if it cannot be written."""
    from rsgen.scene import ply_bytes, surface

    vertices, faces = surface(scene)
    atomic_write(path, ply_bytes(vertices, faces))


def write_origin(out: Path, config: Config) -> None:
    """Note where the scene and trajectory of the sequence in `out` are on this machine. Raises UserError."""
    where = {"scene": str(config.scene.file.resolve()), "trajectory": str(config.trajectory.file.resolve())}
    atomic_write(out / ORIGIN, encode_yaml(where))


def engine_versions(config: Config) -> dict[str, str]:
    """Versions of the programs that decide a sequence's bytes, and the Dr.Jit variant that runs."""
    from rsgen.backend import mitsuba

    names = ("rolling-shutter-rgbd", "mitsuba", "drjit", "numpy", "scipy")
    return {name: version(name) for name in names} | {"variant": mitsuba(config.backend).variant()}


def input_hashes(config: Config) -> dict[str, str]:
    """Content hashes of the trajectory file and of the scene with all its files. Raises UserError."""
    return {
        "trajectory": hashlib.sha256(config.trajectory.file.read_bytes()).hexdigest(),
        "scene": scene_hash(config),
    }


def scene_hash(config: Config) -> str:
    """Content hash of the config's scene with all its files. Raises UserError."""
    from rsgen.backend import mitsuba

    mitsuba(config.backend)
    from rsgen.scene import content_hash

    return content_hash(config.scene.file)
