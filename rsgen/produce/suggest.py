"""A tour through a scene that nobody has planned one for: a config to start from, and what was found on the way."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rsgen.array_types import FloatArray
from rsgen.config.cameras import AutoExposureConfig, ColorConfig
from rsgen.config.config import Config, validate_config
from rsgen.config.motion import MAX_DURATION_S, Waypoint
from rsgen.config.sections import Up
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.files import encode_yaml
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.free_space import FloorPlan, clearance, plan_tour
from rsgen.motion.make import least_turning
from rsgen.motion.walk import AZIMUTHS, ELEVATIONS_DEG, choose_targets, ring, walk_inside
from rsgen.produce.generate import scene_triangles
from rsgen.produce.parts import load_motion
from rsgen.produce.tour import (
    REACH_M,
    Thing,
    Tour,
    TourScene,
    doubt,
    exposure_text,
    find_room,
    find_thing,
    motion_text,
    room_text,
    thing_text,
    view_times,
)
from rsgen.produce.views import (
    Exposure,
    adapted,
    path_traced,
    plainness,
    score,
    suggested_exposure,
    views_along,
)

# How much it counts, in one attempt after the other, that a view is burnt out: tours that shun windows may see little.
_SHUNNED = (0.3, 0.0, 1.0)
_CALM = (0.08, 0.2, 1.0, 4.0)
_BRISK_DEG_S = 35.0  # mean rotational speed of hand-held recordings: 15 to 40
_SWAY_SHARE, _SWAY_DEG_S = 1.08, 1.5  # what the slow turning adds to that of the tour
_SWAY_DEG = 20.0  # it turns to either side by so much at most where more is to be added: it is made faster instead
_FARTHEST_M = 9000.0
_SLACK_M = 0.04
_HAND: dict[str, Any] = {
    "sway": [0.7, 1.0, 0.7],
    "sway_hz": 0.25,
    "shake_position_m": 0.004,
    "shake_exponent": 2.5,
    "shake_band_hz": [0.5, 5.5],
    "shake_rotation_deg": 0.4,
}
_LARGE_M2, _TEXELS = 300.0, 1.15e6  # a larger surface gets coarser light than the default: about so many texels
_CAMERAS = ("color", "depth", "T_color_depth", "truth", "imu", "mocap", "tremor", "faults")
_GOOD = 0.9  # a tour whose worst views are worth so much is taken without looking for another
_LINE_S = 0.01  # exposure of an automatic camera's lines, from which it changes it, where a config has none


@dataclass(frozen=True)
class Wish:
    """What a tour should be like: seconds and m/s, least distance to surfaces in m, and a seed for all that is chance.

    rotation_deg_s: mean rotational speed; None: as the tour has it, up to what people do.

    Raises UserError, naming the option, if one of them is out of bounds.
    """

    seconds: float = 20.0
    speed_m_s: float = 0.35
    clearance_m: float = 0.2
    seed: int = 0
    rotation_deg_s: float | None = None

    def __post_init__(self) -> None:
        bounds = {
            "seconds": (self.seconds, 2.0, MAX_DURATION_S),
            "speed": (self.speed_m_s, 0.01, 10.0),
            "clearance": (self.clearance_m, 0.01, 10.0),
            "seed": (self.seed, 0, 2**31 - 1),
        }
        for option, (value, least, most) in bounds.items():
            if not least <= value <= most:
                raise UserError(f"--{option} {value:g}: must lie in {least:g} to {most:.10g}")


@dataclass(frozen=True)
class Suggestion:
    """A config whose motion keeps its distance, what was found, a line a fact, and how good each second's views are."""

    config: Config
    found: tuple[str, ...]
    seconds: tuple[str, ...] = ()

    def yaml(self, folder: Path) -> bytes:
        """The config as a file in `folder`, with what was found as its comment."""
        assert self.config.motion is not None
        data = {
            "name": self.config.name,
            "motion": self.config.motion.model_dump(mode="json", exclude_unset=True),
            "scene": {
                **self.config.scene.model_dump(mode="json", exclude_unset=True),
                "file": os.path.relpath(self.config.scene.file, folder),
            },
        }
        for section in ("light", *_CAMERAS):
            if section in self.config.model_fields_set:
                data[section] = self.config.model_dump(mode="json", include={section}, exclude_unset=True)[section]
        return "".join(f"# {line}\n" for line in self.found).encode() + encode_yaml(data)


def suggest_tour(
    file: Path, name: str | None, wish: Wish, scale: float = 1.0, up: Up = "y", like: Config | None = None,
    skip_missing: bool = False,
) -> Suggestion:  # fmt: skip
    """A tour through the scene `file`: through its largest room, or round the thing that it holds.

    name: of the sequence; None: after the file. scale, up, skip_missing: see `SceneOptions`. like: whose cameras,
    noise and truth it is to have; None: the defaults. Raises UserError naming the file if there is no place for a
    camera, no floor, or no scene, and if it is a room in another unit than metres.
    """
    mitsuba()
    from rsgen.scene.loading import load_scene
    from rsgen.scene.meshes import coarser, inhabited_box
    from rsgen.scene.placement import AS_IT_IS, SceneOptions, camera_up
    from rsgen.scene.rays import cast_rays

    options = SceneOptions(scale, up, skip_missing=skip_missing)
    placed = {k: v for k, v in vars(options).items() if v != getattr(AS_IT_IS, k)}
    if not 1e-9 <= scale <= 1e9:  # as scene.scale
        raise UserError(f"--scale {scale:g}: must lie in 1e-09 to 1e+09")
    loaded = load_scene(file, options=options)
    triangles = scene_triangles(loaded)
    fineness = 1.0 / coarser(triangles, inhabited_box([shape for shape in loaded.shapes() if shape.is_mesh()]))
    own = camera_up(file) if file.suffix.lower() == ".xml" else None
    hint = "" if own in (None, up) else f"its own camera has {own} up: --up {own}"
    scene = TourScene(file, triangles, fineness, partial(cast_rays, loaded), path_traced(loaded), placed, hint)
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", file.stem) if name is None else name
    aim = find_room(scene, wish.clearance_m) or find_thing(scene)
    if (farthest := float(np.abs(scene.triangles).max())) > _FARTHEST_M:
        raise scene.wrong(f"reaches {farthest:.0f} m from the origin: scale it to metres, or move it to the origin")
    rng = np.random.default_rng(wish.seed)
    best: tuple[Tour, Config] | None = None
    for shunned in _SHUNNED:
        tours = (
            _through(scene, aim, wish, shunned, rng) if isinstance(aim, FloorPlan) else [_round(scene, aim, wish, rng)]
        )
        config = _config(scene, tours, name, wish, like)
        spline = load_motion(config).spline
        least = clearance(spline, scene.triangles, max(REACH_M, wish.clearance_m))
        if least < wish.clearance_m:
            continue
        tour = _looked_at(scene, config, spline, least)
        if best is None or _merit(tour) > _merit(best[0]):
            best = tour, config
        if best[0].scores.worst >= _GOOD:
            break
    if best is None:
        raise scene.wrong(f"no tour found that keeps {wish.clearance_m:g} m from all surfaces: reduce --clearance")
    where = room_text(aim, wish.clearance_m) if isinstance(aim, FloorPlan) else thing_text(aim.high - aim.low)
    if isinstance(aim, FloorPlan):
        where += doubt(aim.floor.gap_m, scale)
    tour, config = best
    is_lit = bool(loaded.emitters())
    how = exposure_text(tour.exposure) if is_lit else ["it has no light, and what it shows is black: add an emitter"]
    found = (f"{file.name}: {where}", *((hint,) if hint else ()), *motion_text(tour, wish.rotation_deg_s), *how)
    seconds = tour.scores.per_second(view_times(tour.seconds))
    return Suggestion(_exposed(config, tour.exposure), found, tuple(seconds))


def _looked_at(scene: TourScene, config: Config, spline: Spline, least: float) -> Tour:
    """The tour of a config: what is seen from it, how it is exposed, and how good that is."""
    assert config.motion is not None
    seconds = config.motion.duration_s
    T_world_cam = spline.pose(view_times(seconds)) @ se3.inverse(config.T_cam_body(config.view))
    camera = config.cameras[config.view]
    gain = camera.exposure_gain if isinstance(camera, ColorConfig) else 1.0
    views = views_along(T_world_cam, camera.camera, scene.cast, scene.shine)
    # A camera that adapts already does so about another gain.
    exposure = suggested_exposure(views.light, gain)
    target = exposure.target if exposure is not None else None
    if isinstance(camera, ColorConfig) and camera.auto_exposure is not None:
        target = camera.auto_exposure.target
        exposure = None if exposure is None else replace(exposure, target=None)
    fixed = np.full(len(T_world_cam), gain if exposure is None else exposure.gain)
    scores = score(views, fixed if target is None else adapted(views.light, target))
    return Tour(spline, seconds, least, views.distance, exposure, scores)


def _merit(tour: Tour) -> float:
    """By which one of two tours is preferred: its worst views above all."""
    return tour.scores.worst + 0.3 * float(tour.scores.worth.mean())


def _through(
    scene: TourScene, plan: FloorPlan, wish: Wish, shunned: float, rng: np.random.Generator
) -> list[tuple[Waypoint, ...]]:
    """Tours through a room along one walk, whose gaze is ever calmer. shunned: one of `_SHUNNED`."""
    p_world = walk_inside(plan, wish.seconds * wish.speed_m_s, wish.clearance_m, rng)
    if p_world is None:
        raise scene.wrong(f"no walk keeps {wish.clearance_m:g} m from all surfaces: reduce --clearance")
    state = int(rng.integers(2**31))
    color = plainness(p_world, scene.shine, AZIMUTHS, ELEVATIONS_DEG) * np.reshape([1.0, shunned], (2, 1, 1, 1))
    return [
        _waypoints(*choose_targets(p_world, scene.cast, calm, np.random.default_rng(state), color)) for calm in _CALM
    ]


def _round(scene: TourScene, thing: Thing, wish: Wish, rng: np.random.Generator) -> tuple[Waypoint, ...]:
    """A tour round a thing, pushed off what else is there."""
    waypoints = _waypoints(*ring(thing.low, thing.high, thing.ground_y, rng))
    try:
        return plan_tour(scene.triangles, waypoints, wish.clearance_m + _SLACK_M)
    except UserError as error:
        raise scene.wrong(f"no way round what stands there ({error})") from None


def _waypoints(p_world: FloatArray, target: FloatArray) -> tuple[Waypoint, ...]:
    return tuple(
        Waypoint(position=p, target=t)
        for p, t in zip(np.round(p_world, 3).tolist(), np.round(target, 3).tolist(), strict=True)
    )


def wish_like(config: Config, wish: Wish) -> Wish:
    """The wish with the length and mean speeds of a config's made motion, if it has one that lasts long enough."""
    motion = config.motion
    if motion is None:
        return wish
    seconds, turning = round(max(2.0, motion.duration_s), 2), motion.mean_rotation_deg_s
    return replace(wish, seconds=seconds, speed_m_s=motion.mean_speed_m_s, rotation_deg_s=turning)


def _sections(scene: TourScene, like: Config | None) -> dict[str, Any]:
    """Sections of a config beside motion and scene: coarser light in a large one, and the cameras of another."""
    given = {} if like is None else like.model_dump(mode="json", include=set(_CAMERAS), exclude_unset=True)
    area = float((trimesh.triangles.area(scene.triangles) * scene.fineness**2).sum())
    if area > _LARGE_M2:
        given["light"] = {"texel_m": math.ceil(200.0 * math.sqrt(area / _TEXELS)) / 200.0}
    return given


def _config(
    scene: TourScene, tours: Sequence[tuple[Waypoint, ...]], name: str, wish: Wish, like: Config | None
) -> Config:
    """The config of the first tour that turns no faster than people do, or than is wished, or of the last."""
    most = _BRISK_DEG_S if wish.rotation_deg_s is None else wish.rotation_deg_s
    sections = _sections(scene, like)
    for waypoints in tours:
        motion = {
            "kind": "tour", "length_m": round(wish.seconds * wish.speed_m_s, 3), "mean_speed_m_s": wish.speed_m_s,
            "mean_rotation_deg_s": 1e4, "waypoints": [w.model_dump() for w in waypoints],
            "ramp_s": min(1.0, 0.2 * wish.seconds), **_HAND, "clearance_m": wish.clearance_m, "seed": wish.seed,
        }  # fmt: skip
        data = {"name": name, "motion": motion, "scene": {"file": scene.file, **scene.placed}, **sections}
        asked = validate_config(data, "motion suggest").motion
        assert asked is not None
        least = least_turning(asked, wish.seed)
        turning = max(_SWAY_SHARE * least, least + _SWAY_DEG_S, wish.rotation_deg_s or 0.0)
        motion["mean_rotation_deg_s"] = round(turning, 1)
        motion["sway_hz"] = max(_HAND["sway_hz"], round((turning - least) / (4.0 * _SWAY_DEG), 2))
        if _SWAY_SHARE * least <= most:
            break
    return validate_config(data, "motion suggest")


def _exposed(config: Config, exposure: Exposure | None) -> Config:
    """The config with the exposure of its tour; None: as it is."""
    if exposure is None:
        return config
    change: dict[str, Any] = {"exposure_gain": exposure.gain}
    if exposure.target is not None:
        change["auto_exposure"] = AutoExposureConfig(target=exposure.target)
        change["exposure_s"] = config.color.exposure_s or _LINE_S
    return config.model_copy(update={"color": config.color.model_copy(update=change)})
