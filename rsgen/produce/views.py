"""How good the views of a tour are, and how they are to be exposed: small path-traced pictures and the shape they show.

Pictures come as two independent halves of their samples: an edge is what both show, noise is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from rsgen import srgb
from rsgen.array_types import BoolArray, Float32Array, FloatArray
from rsgen.geometry.camera import Camera
from rsgen.motion.free_space import Cast
from rsgen.motion.walk import unit_directions
from rsgen.produce.camera_sources import small_camera

Shine = Callable[[FloatArray, FloatArray], Float32Array]
"""From points (n, 3), m, along unit directions (n, 3), world: linear radiance (2, n, 3), independent halves."""

MOST_CLIPPED = 0.02
"""Of a tour's pixels, that may be white in a channel."""

_WIDTH, _SPP, _DEPTH = 48, 4, 8  # samples of either half
_AIMED = 0.75  # of MOST_CLIPPED, in the instants that are looked at: others lie between them
_GREY = 0.18  # what half of the pixels are to be brighter than
_MOST, _WHITE = 0.7, 0.6  # of the pixels, that are not to be brighter than this: windows may, white walls not
_ENOUGH = 2.0  # a factor that is not worth the while
_DARK = 0.02  # linear: 38 of 255 in sRGB, where noise hides what little contrast is left
_MUCH_DARK, _LIGHTER = 0.25, 0.7  # of the pixels; automatic exposure must leave less than that part of it
_TARGETS = (0.53, 0.46, 0.4, 0.34, 0.28, 0.22)  # of automatic exposure: its default, then ever less
_EDGE = 0.03  # of the intensity, 0..1, from one pixel of so small a picture to the next
_FAR_M = 8.0  # a depth camera sees no farther
# What is enough of a view: furnished public rooms have about twice that shape in the mean, bare walls a tenth.
_EDGES, _SHAPE, _NEAR_M = 0.05, 0.01, 0.4
_FLAT = 0.1  # of that shape: bare walls have no more
_BAD_CLIPPED, _BAD_DARK = 0.4, 0.8  # of a view's pixels: it is worth nothing
_WORST = 0.1  # of the views, by which a tour is judged
_PANORAMA_DEG = 3.75


@dataclass(frozen=True, eq=False)
class Views:
    """What a camera sees at instants of a tour. light: (2, n, h, w, 3) linear radiance, independent halves, each
    pixel the mean of nine. shape: (n,) smallest eigenvalue of the point-to-plane information a pixel, rotations scaled
    by the mean depth: near 0 where depth leaves a motion open. distance: (n, pixels) m, inf for nothing.
    """

    light: Float32Array
    shape: FloatArray
    distance: FloatArray

    @property
    def nearest(self) -> FloatArray:
        """(n,) m, of all but a hundredth of the pixels."""
        return np.quantile(self.distance, 0.01, axis=1, method="lower")


@dataclass(frozen=True)
class Exposure:
    """How a tour is exposed. gain: factor on the light; target: of automatic exposure, None where there is none."""

    gain: float
    target: float | None = None


@dataclass(frozen=True, eq=False)
class Scores:
    """Of each view (n,): shares of clipped and dark pixels and of colour edges, shape and nearest as in `Views`."""

    clipped: FloatArray
    dark: FloatArray
    edges: FloatArray
    shape: FloatArray
    nearest: FloatArray

    @property
    def worth(self) -> FloatArray:
        """(n,) 0..1: how much there is of what the view has least of."""
        parts = (
            self.edges / _EDGES, self.shape / _SHAPE, self.nearest / _NEAR_M,
            (_BAD_CLIPPED - self.clipped) / (_BAD_CLIPPED - MOST_CLIPPED), (_BAD_DARK - self.dark) / (_BAD_DARK - 0.5),
        )  # fmt: skip
        return np.clip(np.min(parts, axis=0), 0.0, 1.0)

    @property
    def flat(self) -> float:
        """Share of the views along or about whose one plane depth tells next to nothing of a motion."""
        return float(np.mean(self.shape < _FLAT * _SHAPE))

    @property
    def worst(self) -> float:
        """Mean worth of the worst tenth of the views."""
        return float(np.sort(self.worth)[: max(1, round(_WORST * len(self.worth)))].mean())

    def text(self) -> str:
        """The tour in a line."""
        return (
            f"score {self.worst:.2f} (worst tenth of the views; {self.worth.mean():.2f} in the mean, of 1): "
            f"{100 * self.clipped.mean():.1f} % of the pixels clipped, {100 * self.dark.mean():.0f} % dark, "
            f"{100 * self.edges.mean():.0f} % colour edges ({100 * self.edges.min():.0f} % at least), "
            f"shape {self.shape.mean():.3f} ({self.shape.min():.4f} at least), nearest {self.nearest.min():.2f} m"
        )

    def per_second(self, t: FloatArray) -> list[str]:
        """A line for each second of instants t (n,), s, the means of its views; the nearest surface of all."""
        lines = ["second  score  clipped  dark  edges   shape  nearest"]
        for second in np.unique(np.floor(t)):
            own = np.floor(t) == second
            lines.append(
                f"{second:6.0f}  {self.worth[own].mean():5.2f}  {100 * self.clipped[own].mean():5.1f} %"
                f"  {100 * self.dark[own].mean():2.0f} %  {100 * self.edges[own].mean():3.0f} %"
                f"  {self.shape[own].mean():6.4f}  {self.nearest[own].min():5.2f} m"
            )
        return lines


def views_along(T_world_cam: FloatArray, camera: Camera, cast: Cast, shine: Shine) -> Views:
    """What the camera, made small, sees at poses (n, 4, 4), m."""
    small = small_camera(camera, _WIDTH)
    rays = small.unproject(small.pixel_grid())
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    sees: BoolArray = np.asarray(np.isfinite(rays).all(axis=-1))
    rays = np.where(sees[..., None], rays, [0.0, 0.0, 1.0])  # a lens may see nothing in its corners
    shape = len(T_world_cam), rays.shape[0] * rays.shape[1]
    direction = np.einsum("nij,rj->nri", T_world_cam[:, :3, :3], rays.reshape(-1, 3)).reshape(-1, 3)
    origin = np.repeat(T_world_cam[:, :3, 3], shape[1], axis=0)
    distance, normal = cast(origin, direction)
    p = np.where(np.isfinite(distance), distance, 0.0)[:, None] * direction
    seen = zip(p.reshape(*shape, 3), normal.reshape(*shape, 3), distance.reshape(shape), strict=True)
    constraint = np.array([_constraint(p, n, d < _FAR_M) for p, n, d in seen])
    light = shine(origin, direction).reshape(2, len(T_world_cam), *rays.shape)
    return Views(_smoothed(light), constraint, distance.reshape(shape))


def _smoothed(light: Float32Array) -> Float32Array:
    """Pictures (2, n, h, w, 3), each pixel the mean of the nine about it: so few samples scatter much."""
    return np.array([[cv2.blur(picture, (3, 3)) for picture in half] for half in light.astype(np.float32)])


def _constraint(p: FloatArray, normal: FloatArray, counts: BoolArray) -> float:
    """`Views.shape` of points and normals (n, 3) of all pixels, from the camera's centre, of those that count."""
    if not counts.any():
        return 0.0
    p, normal = p[counts], normal[counts]
    scale = float(np.linalg.norm(p, axis=1).mean())
    J = np.concatenate([normal, np.cross(p, normal) / scale], axis=1)
    return max(0.0, float(np.linalg.eigvalsh(J.T @ J / len(counts))[0]))


def score(views: Views, brightness: FloatArray) -> Scores:
    """How good views are with their light multiplied by brightness (n,)."""
    exposed = views.light * brightness.astype(np.float32)[None, :, None, None, None]
    peak = _peak(exposed)
    clipped, dark = (peak > 1).mean(axis=(1, 2)), (peak < _DARK).mean(axis=(1, 2))
    edges = _edge_map(exposed).mean(axis=(1, 2))
    return Scores(clipped, dark, np.maximum(edges, 0.0), views.shape, views.nearest)


def _peak(light: Float32Array) -> Float32Array:
    """(n, h, w): the largest channel of pictures (2, n, h, w, 3), of the darker half: a speck is in one of them."""
    return np.asarray(light.max(axis=-1).min(axis=0))


def _edge_map(exposed: Float32Array) -> FloatArray:
    """(n, h, w): 1 at edges of pictures (2, n, h, w, 3), halves that have noise of their own, and now and then -1.

    Noise makes the product of the two gradients as often negative as positive, so that their mean is not biased.
    """
    grey = srgb.encode(np.clip(exposed, 0, 1)).mean(axis=-1)
    product = sum(np.prod(np.gradient(grey, axis=axis), axis=0) for axis in (2, 3))
    return np.asarray(product > _EDGE**2, float) - (product < -(_EDGE**2))


def suggested_exposure(light: Float32Array, gain: float) -> Exposure | None:
    """How views with that light (2, n, h, w, 3) are to be exposed; None: as now, by `gain`, or where all is dark.

    The typical surface becomes mid-grey, or darker where most of the bright part would be white, or more than
    MOST_CLIPPED of the pixels clipped. Automatic exposure where that leaves much of the tour dark and it would less.
    """
    peak, typical = _peak(light), _typical_gain(light)
    if typical is None:
        return None
    most = 1.0 / max(float(np.quantile(peak, 1.0 - _AIMED * MOST_CLIPPED)), 1e-12)
    wanted = min(typical, most)
    dark = float((peak * wanted < _DARK).mean())
    for target in _TARGETS if dark > _MUCH_DARK else ():
        gains = adapted(light, target)
        exposed = peak * gains[:, None, None]
        if (exposed > 1).mean() <= _AIMED * MOST_CLIPPED:
            if (exposed < _DARK).mean() < _LIGHTER * dark:
                return Exposure(float(f"{np.median(gains):.2g}"), target)
            break
    if 1 / _ENOUGH <= wanted / gain <= _ENOUGH and gain <= most:
        return None
    return Exposure(_rounded_down(wanted))


def _typical_gain(light: Float32Array) -> float | None:
    """The factor that makes the typical surface mid-grey, or darker where most of the bright part would be white."""
    grey = light.mean(axis=(0, -1), dtype=np.float64)
    lit = grey[grey > 0]
    if not len(lit):
        return None
    return min(_GREY / float(np.median(lit)), _WHITE / max(float(np.quantile(lit, _MOST)), 1e-12))


def _rounded_down(x: float) -> float:
    """To two digits, but for a hundredth of the last."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return float(f"{math.floor(x / unit + 0.01) * unit:.2g}")


def adapted(light: Float32Array, target: float) -> FloatArray:
    """Factors (n,) on light (2, n, h, w, 3) with which automatic exposure gives each view the mean intensity `target`,
    or nearly so.
    """
    mean = light.mean(axis=0)
    low, high = np.full(len(mean), -20.0), np.full(len(mean), 20.0)  # stops
    for _ in range(16):
        middle = 0.5 * (low + high)
        exposed = mean * (2.0**middle).astype(np.float32)[:, None, None, None]
        is_bright = srgb.encode(np.clip(exposed, 0, 1)).mean(axis=(1, 2, 3)) > target
        low, high = np.where(is_bright, low, middle), np.where(is_bright, middle, high)
    return np.asarray(2.0 ** (0.5 * (low + high)))


def plainness(p_world: FloatArray, shine: Shine, azimuths: int, elevations_deg: FloatArray) -> FloatArray:
    """(2, n, azimuths, elevations): shares of colour edges and of clipped pixels around places (n, 3), in cells about
    directions, azimuths from the x axis to z; exposed so that the typical surface is mid-grey, whatever clips then.
    """
    step = elevations_deg[1] - elevations_deg[0]
    wide, high = round(360.0 / azimuths / _PANORAMA_DEG), round(step / _PANORAMA_DEG)
    columns = ((np.arange(azimuths * wide) + 0.5) / wide - 0.5) * (math.tau / azimuths)
    rows = np.radians((np.arange(len(elevations_deg) * high) + 0.5) / high * step - 0.5 * step + elevations_deg[0])
    rays = unit_directions(*np.meshgrid(columns, rows, indexing="ij"))
    flat = np.tile(rays.reshape(-1, 3), (len(p_world), 1))
    light = shine(np.repeat(p_world, rays[..., 0].size, axis=0), flat).reshape(2, len(p_world), *rays.shape)
    light = _smoothed(light)
    gain = _typical_gain(light)
    exposed = light * np.float32(1.0 if gain is None else gain)
    maps = np.stack([_edge_map(exposed), _peak(exposed) > 1])
    cells = maps.reshape(2, len(p_world), azimuths, wide, len(elevations_deg), high)
    return np.asarray(cells.mean(axis=(3, 5)))


def path_traced(scene: Any) -> Shine:
    """Radiance in a scene by path tracing; the glass about lamps bends nothing, as while light is baked."""
    import mitsuba as mi

    from rsgen.light.lamps import straight_through_bulbs
    from rsgen.scene.rays import radiance_along

    integrator = mi.load_dict({"type": "path", "max_depth": _DEPTH})

    def shine(p_world: FloatArray, direction: FloatArray) -> Float32Array:
        with straight_through_bulbs(scene):
            halves = [radiance_along(scene, integrator, p_world, direction, _SPP, seed) for seed in range(2)]
        return np.stack(halves)

    return shine
