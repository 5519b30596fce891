"""Workbench with a vice, hand tools, and the board that they hang on; each about its own origin, back towards -z."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scenes.kit.shapes import Mesh, Parts, box, merge, move_parts, rotation, rounded_box, tube
from scenes.workshop.solids import ball, beam, rod, turned

BENCH_TOP = 0.87
BENCH_DEPTH = 0.72


def workbench(width: float, paint: str, drawers_left: bool) -> Parts:
    """Bench with a wooden top on steel legs, a shelf below, and a cabinet of five drawers at one end; on y = 0."""
    w, d = width / 2, BENCH_DEPTH / 2
    top = rounded_box([-w, BENCH_TOP - 0.06, -d], [w, BENCH_TOP, d], 0.006, 6, edge=2)
    legs = [
        box([s * (w - 0.09) - 0.03, 0.0, t * (d - 0.07) - 0.03], [s * (w - 0.09) + 0.03, 0.809, t * (d - 0.07) + 0.03])
        for s in (-1, 1)
        for t in (-1, 1)
    ]
    rails = [box([-w + 0.121, 0.74, t * (d - 0.07) - 0.02], [w - 0.121, 0.808, t * (d - 0.07) + 0.02]) for t in (-1, 1)]
    shelf = box([-w + 0.125, 0.16, -d + 0.11], [w - 0.125, 0.18, d - 0.11])
    rests = [box([s * (w - 0.09) - 0.02, 0.12, -d + 0.101], [s * (w - 0.09) + 0.02, 0.159, d - 0.101]) for s in (-1, 1)]
    c = (-1.0 if drawers_left else 1.0) * (w - 0.42)
    cabinet = box([c - 0.24, 0.181, -d + 0.13], [c + 0.24, 0.735, d - 0.115])
    fronts, grips = [], []
    for k in range(5):
        y = 0.19 + 0.108 * k
        fronts.append(rounded_box([c - 0.23, y, d - 0.114], [c + 0.23, y + 0.10, d - 0.098], 0.004, 2, edge=2))
        grips.append(box([c - 0.07, y + 0.06, d - 0.0975], [c + 0.07, y + 0.075, d - 0.08]))
    return [
        ("bench_wood", top), ("frame", merge([*legs, *rails, *rests, cabinet])), ("ply", shelf), (paint, merge(fronts)),
        ("bright", merge(grips)),
    ]  # fmt: skip


def vice(paint: str) -> Parts:
    """Engineer's vice on y = 0, jaws across x, screw towards +z."""
    body = [
        turned("y", (0, 0, 0), [[0, 0], [0.09, 0], [0.09, 0.02], [0.06, 0.05], [0, 0.05]], 32),
        rounded_box([-0.06, 0.051, -0.10], [0.06, 0.13, 0.07], 0.012, 3, edge=2),
        rounded_box([-0.075, 0.131, -0.10], [0.075, 0.19, -0.035], 0.012, 3, edge=2),
        rounded_box([-0.075, 0.10, 0.095], [0.075, 0.19, 0.155], 0.012, 3, edge=2),
    ]
    bright = [
        box([-0.07, 0.15, -0.034], [0.07, 0.188, -0.024]),
        box([-0.07, 0.15, 0.084], [0.07, 0.188, 0.094]),
        box([-0.035, 0.07, 0.071], [0.035, 0.12, 0.094]),
        rod("z", (0, 0.125, 0.156), 0.07, 0.014, 16),
        rod("x", (-0.10, 0.125, 0.21), 0.20, 0.006, 10),
    ]
    return [
        (paint, merge(body)),
        ("bright", merge(bright)),
        ("rubber", merge([ball((s * 0.1, 0.125, 0.21), 0.011) for s in (-1, 1)])),
    ]


def hammer(size: float = 1.0) -> Parts:
    """Hammer lying in the x-z plane on y = 0, its handle along x."""
    handle = tube(
        np.array([[-0.16, 0.014, 0], [-0.08, 0.014, 0], [0.10, 0.014, 0.0], [0.135, 0.014, 0]]),
        [0.013, 0.014, 0.010, 0.010],
        12,
    )
    head = merge([box([0.11, 0.001, -0.055], [0.145, 0.031, 0.03]), rod("z", (0.1275, 0.016, 0.031), 0.025, 0.015, 16)])
    return _sized([("handle_wood", handle), ("cast", head)], size)


def spanner(size: float = 1.0) -> Parts:
    """Open-ended spanner lying on y = 0 along x."""
    shaft = box([-0.085, 0.001, -0.009], [0.085, 0.007, 0.009])
    ends = []
    for s in (-1, 1):
        ends.append(rod("y", (s * 0.093, 0.0, 0), 0.009, 0.017, 20))
        for side in (-1, 1):
            ends.append(beam((s * 0.107, 0.0045, side * 0.012), (s * 0.124, 0.0045, side * 0.010), 0.009, 0.006))
    return _sized([("bright", merge([shaft, *ends]))], size)


def screwdriver(size: float = 1.0) -> Parts:
    """Screwdriver lying on y = 0 along x."""
    shape = [[0.0, 0.0], [0.011, 0.004], [0.0145, 0.02], [0.0145, 0.075], [0.009, 0.09], [0.009, 0.10], [0.0, 0.10]]
    grip = turned("x", (-0.11, 0.0148, 0), shape, 14)
    return _sized([("handle_red", grip), ("bright", rod("x", (-0.0095, 0.0148, 0), 0.12, 0.0035, 10))], size)


def saw(size: float = 1.0) -> Parts:
    """Hack saw lying on y = 0 along x."""
    bow = tube([[-0.15, 0.008, -0.002], [-0.15, 0.008, -0.09], [0.16, 0.008, -0.09], [0.16, 0.008, -0.002]], 0.007, 8)
    blade = box([-0.15, 0.007, -0.012], [0.16, 0.0085, 0.0])
    return _sized(
        [
            ("bright", merge([bow, blade])),
            ("handle_red", tube([[-0.16, 0.014, 0.0], [-0.20, 0.014, 0.04], [-0.235, 0.014, 0.05]], 0.013, 10)),
        ],
        size,
    )


def pliers(size: float = 1.0) -> Parts:
    """Pliers lying on y = 0 along x."""
    grips = [
        tube([[0.0, 0.009, s * 0.006], [-0.05, 0.009, s * 0.022], [-0.12, 0.009, s * 0.026]], 0.008, 10)
        for s in (-1, 1)
    ]
    jaws = [beam((0.006, 0.009, s * 0.006), (0.06, 0.009, s * 0.0055), 0.008, 0.012) for s in (-1, 1)]
    return _sized(
        [("handle_red", merge(grips)), ("cast", merge([*jaws, rod("y", (0.004, 0.0, 0), 0.0178, 0.011, 16)]))], size
    )


def _sized(parts: Parts, size: float) -> Parts:
    return [(name, Mesh(mesh.v * size, mesh.n, mesh.uv * size, mesh.f)) for name, mesh in parts]


TOOLS: tuple[Callable[[float], Parts], ...] = (hammer, spanner, screwdriver, saw, pliers)


def tin(radius: float, height: float, paint: str) -> Parts:
    """Paint tin or jar with a rim and a lid, on y = 0."""
    r, h = radius, height
    profile = [
        [0.0, 0.0],
        [r, 0.0],
        [r, 0.006],
        [0.96 * r, 0.01],
        [0.96 * r, h - 0.012],
        [r, h - 0.008],
        [r, h],
        [0.86 * r, h],
    ]
    return [(paint, turned("y", (0, 0, 0), [*profile, [0.84 * r, h - 0.006], [0.0, h - 0.006]], 32))]


def tool_box(paint: str) -> Parts:
    """Cantilever tool box with a handle, on y = 0."""
    body = [
        rounded_box([-0.22, 0.0, -0.10], [0.22, 0.09, 0.10], 0.008, 3, edge=2),
        rounded_box([-0.225, 0.091, -0.104], [0.225, 0.15, 0.104], 0.008, 3, edge=2),
        rounded_box([-0.22, 0.151, -0.085], [0.22, 0.20, 0.085], 0.018, 3, edge=2),
    ]
    handle = tube([[-0.12, 0.199, 0], [-0.12, 0.25, 0], [0.12, 0.25, 0], [0.12, 0.199, 0]], 0.009, 10)
    return [
        (paint, merge(body)),
        ("bright", handle),
        ("cast", merge([box([x, 0.10, 0.1045], [x + 0.03, 0.17, 0.109]) for x in (-0.14, 0.11)])),
    ]


def block(size: tuple[float, float, float], material: str) -> Parts:
    """Workpiece: a sawn block on y = 0."""
    x, y, z = size
    return [(material, rounded_box([-x / 2, 0, -z / 2], [x / 2, y, z / 2], 0.003, 2, edge=2))]


def tool_board(width: float, height: float, rng: np.random.Generator) -> Parts:
    """Perforated board about the origin on the plane z = 0, facing +z, with tools hung in two rows."""
    w, h = width / 2, height / 2
    panel = box([-w, -h, 0.02], [w, h, 0.032])
    battens = [box([-w + 0.02, y, 0.0], [w - 0.02, y + 0.03, 0.0195]) for y in (-h + 0.05, h - 0.08)]
    parts: Parts = [("pegboard", panel), ("frame", merge(battens))]
    upright = rotation("z", 90) @ rotation("x", 90)  # what lies on y = 0 along x hangs before z = 0, its +x end up
    for row in range(2):
        y = h - 0.23 - 0.40 * row
        x = -w + 0.13 + float(rng.uniform(0, 0.05))
        while x < w - 0.13:
            size = float(rng.uniform(0.8, 1.15))
            parts += move_parts(TOOLS[int(rng.integers(len(TOOLS)))](size), (x, y, 0.0335), upright)
            parts.append(
                ("bright", tube([[x, y + 0.07, 0.0325], [x, y + 0.07, 0.066], [x, y + 0.084, 0.07]], 0.0022, 6))
            )
            x += float(rng.uniform(0.13, 0.19))
    return parts
