"""The parts of a sequence, each made from its own sections of the config: motion, scene, objects, light and frames."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.cameras import ColorConfig
from rsgen.config.config import Backend, Config
from rsgen.config.sections import LightConfig, TrajectoryConfig
from rsgen.console.progress import Progress, no_progress
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import FitResult, fit_spline
from rsgen.motion.make import make_motion, with_tremor
from rsgen.motion.object_paths import object_spline
from rsgen.motion.stretch import along, cut
from rsgen.produce.camera_sources import FrameSource, Stage
from rsgen.produce.records import fingerprint
from rsgen.scene import loading
from rsgen.scene.loading import Board
from rsgen.scene.object_meshes import load_object, object_hash
from rsgen.scene.placement import SceneOptions
from rsgen.sequence.format import stream_stamps
from rsgen.sequence.trajectory import Trajectory, read_trajectory

log = logging.getLogger("rsgen")

# About 12 days. Up to here a float64 tells 0.1 ns apart; in Unix time 0.24 us, half a percent of a line delay.
_LARGEST_STAMP_S = 1e6
_INSTANTS = 64  # of lines of sight, and as many lines at each
_LIGHT_STEP_S = 0.1  # between the places along an object's path at which light is gathered
_LEAST_MIRRORED = 4


# --- motion


@dataclass(frozen=True)
class TrueMotion:
    """The ground truth of a config: fitted spline of the body (depth camera), recorded stamps, and `fit`.

    fit: of the recorded or made trajectory, before any tremor: what it missed. objects: T_world_object(t) of the
    config's.
    """

    spline: Spline
    fit: FitResult
    first_stamp: float
    last_stamp: float
    objects: tuple[Spline, ...] = ()


def load_motion(config: Config) -> TrueMotion:
    """Read or make, place and fit the config's trajectory; the spline covers every line of every frame.

    Stamps stay those of the file unless they are too large to time a line by (Unix time): then the first becomes 0.
    Raises UserError naming the trajectory's file and line, or what a motion cannot meet.
    """
    settings = config.trajectory
    trajectory = make_motion(config.motion, config.seed) if config.motion is not None else _recorded(settings)
    if settings.T_world_file is not None:
        trajectory = trajectory.moved(np.asarray(settings.T_world_file, float))
    spacing, smoothing, recorded = settings.knot_spacing_s, settings.smoothing, None
    if config.tremor is not None:
        recorded = fit_spline(trajectory, dt=spacing, smoothing=smoothing)
        trajectory, spacing = with_tremor(recorded.spline, config.tremor, config.seed, trajectory.stamps[[0, -1]])
        smoothing = 0.0
    # Lines of frames are exposed before the first pose and read after the last.
    before = max(s.longest_exposure_s - min(s.offset_s, 0.0) for s in config.cameras.values())
    after = max(s.readout_s for s in config.cameras.values())
    if config.stretch is not None:
        return _stretch(config, trajectory, recorded, before, after, spacing, smoothing)
    fit = fit_spline(trajectory, dt=spacing, smoothing=smoothing, pad_begin_s=before, pad_end_s=after)
    first, last = float(trajectory.stamps[0]), float(trajectory.stamps[-1])
    objects = tuple(object_spline(thing, first, last, before, after) for thing in config.objects)
    return TrueMotion(fit.spline, recorded or fit, first, last, objects)


def _stretch(
    config: Config, trajectory: Trajectory, recorded: FitResult | None, before: float, after: float, spacing: float,
    smoothing: float,
) -> TrueMotion:  # fmt: skip
    """The config's stretch of a trajectory, with `before` and `after` s (of its own time) beyond its ends."""
    stretch = config.stretch
    assert stretch is not None
    speed, duration = stretch.speed, stretch.duration_s
    first, last = (float(stamp) for stamp in trajectory.stamps[[0, -1]])
    if stretch.start_s + speed * duration > last - first + 1e-9:
        raise UserError(
            f"stretch: {stretch.start_s:g} s and {duration:g} s at {speed:g} times the speed are more than the motion "
            f"lasts, {last - first:g} s: begin earlier or make it shorter"
        )
    beyond = max(speed, 1.0)
    fit = fit_spline(trajectory, dt=spacing, smoothing=smoothing, pad_begin_s=beyond * before, pad_end_s=beyond * after)
    moved = along(fit.spline, first + stretch.start_s, speed, np.radians(stretch.turn_deg), np.eye(4))
    # A little more than is needed: stamps are rounded.
    begin, end = max(moved.t_begin, -before - moved.dt), min(moved.t_end, duration + after + moved.dt)
    objects = tuple(object_spline(thing, 0.0, duration, before, after) for thing in config.objects)
    return TrueMotion(cut(moved, begin, end), recorded or fit, 0.0, duration, objects)


def sequence_stamps(config: Config, motion: TrueMotion) -> dict[str, FloatArray]:
    """Stamps (n,) in seconds of all frames of all streams."""
    return {s: stream_stamps(motion.first_stamp, motion.last_stamp, stream) for s, stream in config.cameras.items()}


def _recorded(settings: TrajectoryConfig) -> Trajectory:
    assert settings.file is not None  # or there were a motion
    trajectory = read_trajectory(settings.file, format=settings.format, icl_start=settings.icl_start)
    if np.abs(trajectory.stamps).max() >= _LARGEST_STAMP_S:
        log.info("%s: large stamps, so time counts from the first, %.9f s", settings.file, trajectory.stamps[0])
        trajectory = trajectory.rebased()
    return trajectory


def lines_of_sight(config: Config) -> tuple[FloatArray, FloatArray]:
    """What the config's (first) colour camera looks along, at random over picture and recording. Raises UserError."""
    motion = load_motion(config)
    camera = config.cameras[config.view].camera
    rng = np.random.default_rng(config.seed)
    stamps = rng.uniform(motion.first_stamp, motion.last_stamp, _INSTANTS)
    T_world_color = motion.spline.pose(stamps) @ se3.inverse(config.T_cam_body(config.view))
    pixels = rng.uniform(-0.5, (camera.width - 0.5, camera.height - 0.5), (_INSTANTS, _INSTANTS, 2))
    ray = camera.unproject(pixels)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    direction = np.einsum("nij,nkj->nki", T_world_color[:, :3, :3], ray)
    seen = np.isfinite(direction).all(axis=-1)  # a lens may see nothing in its corners
    eye = np.broadcast_to(T_world_color[:, None, :3, 3], direction.shape)
    return eye[seen], direction[seen]


# --- scene and objects


def load_scene(config: Config) -> Any:
    """The config's Mitsuba scene, with its target if it has one. Raises UserError."""
    mitsuba(config.backend)
    target = config.target
    board = None if target is None else Board(target.grid, np.array(target.T_world_target, float))
    return loading.load_scene(config.scene.file, board, _options(config))


def scene_hash(config: Config) -> str:
    """Content hash of the config's scene with all its files. Raises UserError."""
    mitsuba(config.backend)
    return loading.content_hash(config.scene.file, _options(config))


def _options(config: Config) -> SceneOptions:
    scene = config.scene
    return SceneOptions(scene.scale, scene.up, scene.light, scene.skip_missing)


def surfaces_hash(config: Config) -> str:
    """Hash of all that is lit: the scene, and its target if it has one. Raises UserError."""
    scene, target = scene_hash(config), config.target
    return scene if target is None else fingerprint({"scene": scene, "target": target.model_dump(mode="json")})


def mesh_hashes(config: Config) -> dict[str, str]:
    """Content hashes of the objects' meshes, by names for sequence.yaml. Raises UserError."""
    mitsuba(config.backend)
    return {f"object {thing.name}": object_hash(thing) for thing in config.objects}


def input_hashes(config: Config) -> dict[str, str]:
    """Content hashes of all files that decide the sequence's bytes, by names for sequence.yaml. Raises UserError."""
    hashes, file = {}, config.trajectory.file
    if file is not None:
        hashes["trajectory"] = hashlib.sha256(file.read_bytes()).hexdigest()
    hashes |= {"scene": scene_hash(config)} | mesh_hashes(config)
    for thing in config.objects:
        if thing.motion.file is not None:
            hashes[f"motion of {thing.name}"] = _file_hash(thing.motion.file, thing.name)
    return hashes


def _file_hash(path: Path, name: str) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise UserError(f"objects.{name}.motion: file {path}: cannot be read ({error.strerror})") from None


def engine_versions(backend: Backend) -> dict[str, str]:
    """Versions of the programs that decide a sequence's bytes, and the Dr.Jit variant that runs."""
    names = ("rolling-shutter-rgbd", "mitsuba", "drjit", "numpy", "scipy")
    return {name: version(name) for name in names} | {"variant": mitsuba(backend).variant()}


# --- light and frames


@dataclass(frozen=True)
class LoadedScene:
    """A config's scene and light, loaded, which sequences without objects share."""

    scene: Any
    integrator: Any


def load_scene_and_light(
    config: Config, progress: Progress = no_progress, scene: Any = None, objects: Sequence[Spline] = ()
) -> LoadedScene:
    """Load the scene, unless it is given, and its light, baked now if no cache has it. Raises UserError.

    objects: T_world_object(t) of the config's, all of them, where they are to be seen.
    """
    mi, scene = mitsuba(config.backend), scene or load_scene(config)
    return LoadedScene(scene, make_integrator(mi, scene, config, progress, objects))


def open_frames(
    config: Config, progress: Progress = no_progress, global_shutter: bool = False, scene: Any = None,
    objects: Sequence[Spline] = (), loaded: LoadedScene | None = None,
) -> FrameSource:  # fmt: skip
    """Frames of the config's cameras. scene, objects: see `load_scene_and_light`, which is used if nothing is loaded.

    global_shutter: all lines of a frame at once. loaded: of an equal scene, light and spp. Raises UserError.
    """
    loaded = loaded or load_scene_and_light(config, progress, scene, objects)
    things = loaded.integrator.objects if objects else None
    instances = scene_instances(loaded.scene, config) if config.truth.labels else None
    return FrameSource(Stage(loaded.scene, loaded.integrator, things, config.seed, global_shutter, instances), config)


def scene_instances(scene: Any, config: Config) -> Any:
    """`rsgen.truth.instances.Instances` of the config's loaded scene. Raises UserError."""
    from rsgen.truth.instances import find_instances

    return find_instances(scene, config.scene.file, _options(config))


def make_integrator(mi: Any, scene: Any, config: Config, progress: Progress, objects: Sequence[Spline] = ()) -> Any:
    """Mitsuba integrator of the config's light: `path`, or `BakedIntegrator` over the scene's baked irradiance.

    objects: T_world_object(t) of the config's objects; without any the scene alone is shown.
    """
    light = config.light
    if light.mode == "path":
        return mi.load_dict({"type": "path", "max_depth": light.max_depth})
    from rsgen.light.bake import baked_field, cache_folder
    from rsgen.render.baked import BakedIntegrator

    try:
        cache = cache_folder(config.scene.file)
        field = baked_field(scene, surfaces_hash(config), light, cache, progress, lambda: lines_of_sight(config))
    except UserError as error:
        text = str(error)
        raise UserError(text if text.startswith("scene ") else f"scene {config.scene.file}: {text}") from None
    things = _lit_objects(scene, field, list(map(load_object, config.objects)), objects) if objects else None
    view = config.cameras[config.view]
    spp = view.spp if isinstance(view, ColorConfig) else 1
    return BakedIntegrator(field, glossy_spp=mirrored_samples(light, spp), objects=things)


def mirrored_samples(light: LightConfig, spp: int) -> int:
    """Samples of what surfaces mirror, at most, of so many of a pixel."""
    return light.glossy_spp or max(_LEAST_MIRRORED, spp // 4)


def _lit_objects(scene: Any, field: Any, meshes: Sequence[Any], splines: Sequence[Spline]) -> Any:
    """`MovingObjects` of meshes along splines in a scene whose baked irradiance is `field`."""
    from rsgen.light.probes import gathered_light
    from rsgen.scene.moving_objects import MovingObject, MovingObjects, ObjectLight

    things = []
    for mesh, spline in zip(meshes, splines, strict=True):
        count = max(2, math.ceil((spline.t_end - spline.t_begin) / _LIGHT_STEP_S) + 1)
        t = np.linspace(spline.t_begin, spline.t_end, count)
        middles = se3.transform(spline.pose(t), np.broadcast_to(mesh.middle, (count, 3)))
        light = ObjectLight(gathered_light(scene, field, middles), spline.t_begin, float(t[1] - t[0]))
        things.append(MovingObject(mesh, spline, light))
    return MovingObjects(things)
