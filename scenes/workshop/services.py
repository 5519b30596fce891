"""What runs and hangs along walls and columns: pipes, conduits, switch boxes, signs, extinguishers, notice boards."""

from __future__ import annotations

import numpy as np

from scenes.kit.shapes import Parts, atlas_uv, box, merge, move_parts, rotation, rounded_box, tube
from scenes.workshop.drawings import sign_rect
from scenes.workshop.hall import COLUMN_Z, COLUMNS, LONG, WIDE
from scenes.workshop.solids import GAP, rod, turned

PIPES = (("pipe_a", 2.50, 0.024), ("pipe_b", 2.61, 0.030), ("conduit", 2.71, 0.016))  # material, height, radius


def pipes(side: int) -> Parts:
    """Pipes along a long wall on brackets, their sleeves, and a cable duct above them."""
    z, end = side * (WIDE - 0.07), LONG - 0.35
    parts: Parts = [(name, rod("x", (-end, y, z), 2 * end, r, 16)) for name, y, r in PIPES]
    near, far = sorted((side * (WIDE - 0.09), side * (WIDE - GAP)))
    duct = box([-LONG + 0.3, 2.78, near], [LONG - 0.3, 2.88, far])
    brackets = []
    for x in np.arange(-8.9, 9.3, 1.25).tolist():
        a, b = sorted((side * (WIDE - 0.068), side * (WIDE - GAP)))
        brackets.append(box([x - 0.02, 2.465, a], [x + 0.02, 2.735, b]))
    sleeves = [
        rod("x", (x, y, z), 0.07, 1.2 * r, 16) for x in np.arange(-7.4, 8.0, 3.1).tolist() for _, y, r in PIPES[:2]
    ]
    return [*parts, ("conduit", duct), ("frame", merge(brackets)), ("cast", merge(sleeves))]


def switch_box(rng: np.random.Generator) -> Parts:
    """Sockets and a switch on a back plate, fed by a conduit from the duct above; z = 0 is the wall, facing +z."""
    plate = rounded_box([-0.14, 1.10, GAP], [0.14, 1.42, 0.05], 0.008, 3, edge=2)
    parts: Parts = [("conduit", plate), ("conduit", rod("y", (0.0, 1.421, 0.015), 1.355, 0.010, 12))]
    for k, x in enumerate((-0.065, 0.065)):
        name = ("extinguisher", "pipe_b")[int(rng.integers(2))]
        socket = turned("z", (x, 1.19, 0.0505), [[0, 0], [0.048, 0], [0.042, 0.05], [0.030, 0.055], [0, 0.055]], 24)
        parts.append((name, socket))
        parts.append((("button_green", "button_red")[k], rod("z", (x, 1.34, 0.0505), 0.012, 0.018, 16)))
    return parts


def cabinet(conduits: int) -> Parts:
    """Electrical cabinet of 0.8 x 1.9 x 0.3 m on a plinth, with conduits going up the wall; back at z = 0."""
    body = rounded_box([-0.40, 0.10, 0.01], [0.40, 1.90, 0.30], 0.01, 4, edge=2)
    door = rounded_box([-0.37, 0.14, 0.3005], [0.37, 1.86, 0.318], 0.006, 4, edge=2)
    plinth = box([-0.38, 0, 0.02], [0.38, 0.099, 0.28])
    ups = [rod("y", (-0.2 + 0.12 * k, 1.901, 0.06), 1.55, 0.016, 12) for k in range(conduits)]
    handle = box([0.28, 0.95, 0.3185], [0.31, 1.10, 0.335])
    warning = box([-0.12, 1.40, 0.3183], [0.12, 1.64, 0.320])
    lights = [rod("z", (-0.2 + 0.1 * k, 1.74, 0.3183), 0.014, 0.018, 16) for k in range(3)]
    return [
        ("locker", merge([body])), ("trim", door), ("frame", plinth), ("conduit", merge(ups)), ("bright", handle),
        ("sign", atlas_uv(warning, sign_rect(2))), ("button_green", merge(lights[:2])), ("button_red", lights[2]),
    ]  # fmt: skip


def sign(index: int, size: float) -> Parts:
    """A square sign about the origin on the plane z = 0, facing +z."""
    h = size / 2
    return [("sign", atlas_uv(box([-h, -h, 0.001], [h, h, 0.005]), sign_rect(index)))]


def notice_board(rng: np.random.Generator) -> Parts:
    """Framed board of 1.5 x 1.0 m with sheets pinned to it, about the origin on z = 0."""
    parts: Parts = [("ply", box([-0.75, -0.5, 0.001], [0.75, 0.5, 0.015]))]
    frame = [box([-0.79, s * 0.52 - 0.019, 0.001], [0.79, s * 0.52 + 0.019, 0.025]) for s in (-1, 1)]
    frame += [box([s * 0.771 - 0.019, -0.5, 0.001], [s * 0.771 + 0.019, 0.5, 0.025]) for s in (-1, 1)]
    parts.append(("frame", merge(frame)))
    for k, x in enumerate((-0.52, -0.17, 0.18, 0.53)):
        for y in (-0.24, 0.22):
            if rng.uniform() < 0.8:
                sheet = move_parts(
                    sign(9 + int(rng.integers(3)), 0.30 + 0.02 * (k % 2)),
                    (x, y, 0.0148),
                    rotation("z", float(rng.uniform(-4, 4))),
                )
                parts += sheet
    return parts


def extinguisher() -> Parts:
    """Fire extinguisher on a bracket, about the origin on z = 0, facing +z; its foot 0.55 below."""
    t = np.linspace(0, np.pi / 2, 6)
    dome = np.stack([0.02 + 0.058 * np.cos(t), -0.06 + 0.06 * np.sin(t)], 1).tolist()
    body = turned("y", (0, 0, 0.09), [[0, -0.55], [0.078, -0.55], *dome, [0.016, 0.03], [0, 0.03]], 32)
    valve = [rod("y", (0, 0.0305, 0.09), 0.04, 0.022, 16), box([-0.012, 0.071, 0.04], [0.012, 0.085, 0.17])]
    hose = tube([[0.024, 0.05, 0.09], [0.10, 0.02, 0.10], [0.105, -0.2, 0.11], [0.095, -0.42, 0.12]], 0.011, 8)
    bracket = box([-0.04, -0.35, GAP], [0.04, -0.05, 0.0115])
    return [("extinguisher", body), ("cast", merge(valve)), ("rubber", hose), ("frame", bracket)]


def on_columns(rng: np.random.Generator) -> list[tuple[str, Parts]]:
    """Extinguishers and signs on some of the columns' inner flanges, by name."""
    out: list[tuple[str, Parts]] = []
    for side in (-1, 1):
        turn = rotation("y", 0 if side < 0 else 180)
        for i, x in enumerate(COLUMNS):
            z = side * (COLUMN_Z[0] - GAP / 2)
            out.append((f"sign {side} {i}", move_parts(sign(int(rng.integers(9)), 0.19), (x, 1.95, z), turn)))
            if rng.uniform() < 0.5:
                out.append((f"extinguisher {side} {i}", move_parts(extinguisher(), (x, 1.15, z), turn)))
            out.append((f"number {side} {i}", move_parts(sign(9 + int(rng.integers(3)), 0.19), (x, 1.70, z), turn)))
    return out
