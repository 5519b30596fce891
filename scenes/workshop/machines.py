"""Machine tools about their own origin on y = 0, the operator's side towards +z; `paint` names the body's material."""

from __future__ import annotations

import numpy as np

from scenes.kit.shapes import Mesh, Parts, atlas_uv, box, merge, move, rotation, rounded_box, tube
from scenes.workshop.drawings import label_rect
from scenes.workshop.solids import ball, beam, buttons, handwheel, ring, rod, turned


def _wheels(*wheels: tuple[Mesh, Mesh]) -> Parts:
    return [("bright", merge([w for w, _ in wheels])), ("rubber", merge([g for _, g in wheels]))]


def _lever(start: tuple[float, float, float], end: tuple[float, float, float], knob: float = 0.016) -> Parts:
    return [("bright", tube([start, end], 0.007, 10)), ("rubber", ball(end, knob))]


def turning_lathe(paint: str) -> Parts:
    """Centre lathe of 2.1 m: bed on two cabinets, headstock with a chuck, carriage, tailstock, splash guard."""
    body = [
        rounded_box([-1.05, 0.0, -0.30], [-0.45, 0.62, 0.30], 0.02, 3, edge=2),
        rounded_box([0.55, 0.0, -0.30], [1.00, 0.62, 0.30], 0.02, 3, edge=2),
        rounded_box([-1.02, 0.661, -0.24], [-0.43, 1.24, 0.25], 0.03, 3, edge=3),
        box([-0.42, 0.661, -0.345], [1.02, 1.38, -0.330]),
        box([-0.05, 0.69, 0.242], [0.30, 0.885, 0.30]),
        rounded_box([0.56, 0.887, -0.11], [0.84, 1.0, 0.11], 0.015, 2, edge=2),
    ]
    cast = [
        box([-1.09, 0.621, -0.38], [1.05, 0.66, 0.38]),
        box([-0.42, 0.661, -0.15], [1.00, 0.86, 0.15]),
        box([-0.05, 0.887, -0.23], [0.30, 0.93, 0.23]),
        box([0.03, 0.931, -0.17], [0.20, 0.978, 0.19]),
        turned("x", (0.53, 1.08, 0), [[0, 0], [0.05, 0], [0.075, 0.03], [0.075, 0.36], [0, 0.36]]),
        box([0.07, 0.979, 0.06], [0.17, 1.07, 0.16]),
    ]
    bright = [
        box([-0.42, 0.861, -0.125], [1.00, 0.886, -0.07]),
        box([-0.42, 0.861, 0.07], [1.00, 0.886, 0.125]),
        rod("x", (-0.42, 0.75, 0.20), 1.42, 0.013, 12),
        rod("x", (-0.42, 0.71, 0.20), 1.42, 0.010, 12),
        turned("x", (-0.429, 1.08, 0), [[0, 0], [0.09, 0], [0.09, 0.03], [0.125, 0.03], [0.125, 0.12], [0, 0.12]], 40),
        rod("x", (-0.308, 1.08, 0), 0.66, 0.034),
        turned("x", (0.37, 1.08, 0), [[0, 0], [0.03, 0.05], [0.03, 0.159], [0, 0.159]], 20),
    ]
    for k in range(3):
        jaw = box([-0.3075, 0.042, -0.02], [-0.26, 0.115, 0.02])
        bright.append(move(jaw, (0, 1.08, 0), rotation("x", 120 * k)))
    panel = box([-0.93, 0.98, 0.252], [-0.55, 1.16, 0.285])
    parts: Parts = [(paint, merge(body)), ("cast", merge(cast)), ("bright", merge(bright)), ("panel", panel)]
    parts += buttons((-0.74, 1.10, 0.286), 0.07, 5)
    for x, lean in ((-0.86, 0.04), (-0.62, -0.03)):
        parts += _lever((x, 0.86, 0.245), (x + lean, 0.78, 0.33))
    parts += _wheels(
        handwheel("z", (0.05, 0.79, 0.335), 0.075), handwheel("x", (0.925, 1.08, 0), 0.085),
        handwheel("z", (0.115, 0.955, 0.235), 0.05),
    )  # fmt: skip
    return parts


def pillar_drill(paint: str) -> Parts:
    """Pillar drill of 1.9 m: foot, column, round table, head with belt cover and motor, star handle."""
    cast = [
        rounded_box([-0.25, 0.0, -0.36], [0.25, 0.075, 0.30], 0.015, 3, edge=2),
        turned("y", (0, 0.0755, -0.16), [[0, 0], [0.10, 0], [0.085, 0.10], [0, 0.10]]),
        turned("y", (0, 0.76, -0.16), [[0, 0], [0.082, 0], [0.082, 0.14], [0, 0.14]]),
        box([-0.05, 0.79, -0.13], [0.05, 0.861, 0.08]),
        turned("y", (0, 0.862, 0.10), [[0, 0], [0.17, 0], [0.20, 0.02], [0.20, 0.045], [0, 0.045]], 40),
    ]
    body = [
        rounded_box([-0.13, 1.30, -0.28], [0.13, 1.70, 0.22], 0.03, 3, edge=3),
        rounded_box([-0.165, 1.702, -0.56], [0.165, 1.86, 0.25], 0.04, 3, edge=3),
    ]
    bright = [
        rod("y", (0, 0.176, -0.16), 1.2, 0.048),
        rod("y", (0, 1.17, 0.10), 0.129, 0.034),
        turned("y", (0, 1.06, 0.10), [[0, 0], [0.018, 0], [0.032, 0.04], [0.032, 0.109], [0, 0.109]], 20),
        rod("y", (0, 0.955, 0.10), 0.1045, 0.006, 8),
    ]
    motor = turned("y", (0, 1.34, -0.44), [[0, 0], [0.085, 0], [0.10, 0.03], [0.10, 0.361], [0, 0.361]])
    fins = [ring("y", (0, 1.40 + 0.045 * k, -0.44), 0.10, 0.006) for k in range(6)]
    parts: Parts = [
        (paint, merge(body)), ("cast", merge(cast)), ("bright", merge(bright)), ("panel", merge([motor, *fins])),
        ("bright", rod("x", (0.131, 1.44, 0.06), 0.07, 0.03)),
    ]  # fmt: skip
    for k in range(3):
        a = np.radians(120 * k + 35)
        tip = (0.20, 1.44 + 0.22 * np.sin(a), 0.06 + 0.22 * np.cos(a))
        parts += _lever((0.175, 1.44, 0.06), tip, 0.02)
    parts += buttons((0.0, 1.58, 0.2205), 0.06, 2)
    plate = box([-0.09, 1.745, 0.2505], [0.09, 1.82, 0.254])
    return [*parts, ("label", atlas_uv(plate, label_rect(3)))]


def milling_machine(paint: str) -> Parts:
    """Knee-type milling machine of 2.1 m: column, knee, slotted table with a vice, ram, head, pendant panel."""
    body = [
        rounded_box([-0.36, 0.0, -0.52], [0.36, 0.14, 0.50], 0.02, 3, edge=2),
        rounded_box([-0.25, 0.141, -0.50], [0.25, 1.60, -0.10], 0.03, 3, edge=3),
        rounded_box([-0.20, 0.55, -0.098], [0.20, 0.85, 0.34], 0.02, 3, edge=2),
        rounded_box([-0.15, 1.601, -0.50], [0.15, 1.80, 0.34], 0.02, 3, edge=2),
        rounded_box([-0.13, 1.24, -0.02], [0.13, 1.599, 0.30], 0.03, 3, edge=3),
    ]
    cast = [
        box([-0.26, 0.851, -0.08], [0.26, 0.92, 0.30]),
        box([-0.66, 0.921, -0.02], [0.66, 0.975, 0.27]),
        *[box([-0.66, 0.976, z], [0.66, 1.0, z + 0.055]) for z in (-0.02, 0.058, 0.136, 0.215)],
        turned("y", (0, 0.141, 0.16), [[0, 0], [0.09, 0], [0.06, 0.05], [0.06, 0.408], [0, 0.408]]),
        turned("y", (0, 1.801, 0.12), [[0, 0], [0.12, 0], [0.12, 0.26], [0.09, 0.30], [0, 0.30]], 32),
    ]
    bright = [
        turned("y", (0, 1.11, 0.14), [[0, 0], [0.035, 0], [0.035, 0.05], [0.055, 0.06], [0.055, 0.129], [0, 0.129]]),
        rod("y", (0, 1.075, 0.14), 0.034, 0.018, 12),
        box([-0.055, 1.042, 0.10], [0.055, 1.0725, 0.18]),
    ]
    parts: Parts = [(paint, merge(body)), ("cast", merge(cast)), ("bright", merge(bright))]
    parts += machine_vice()
    parts += [
        ("bright", tube([[0.249, 1.45, -0.30], [0.42, 1.56, -0.25], [0.60, 1.58, -0.02], [0.62, 1.54, 0.06]], 0.018)),
        ("panel", box([0.51, 1.20, 0.02], [0.73, 1.535, 0.10])),
    ]
    parts += buttons((0.62, 1.27, 0.101), 0.05, 4) + buttons((0.62, 1.33, 0.101), 0.05, 3)
    parts.append(("glass", box([0.54, 1.39, 0.101], [0.70, 1.51, 0.104])))
    parts += _wheels(
        handwheel("x", (0.70, 0.95, 0.12), 0.08), handwheel("x", (-0.70, 0.95, 0.12), 0.08, -1.0),
        handwheel("z", (0.0, 0.885, 0.345), 0.065), handwheel("z", (0.12, 0.70, 0.385), 0.07),
    )  # fmt: skip
    return parts


def machine_vice() -> Parts:
    """The machine vice on the milling machine's table."""
    jaws = [
        box([-0.14, 1.001, 0.06], [0.14, 1.025, 0.22]),
        box([-0.12, 1.026, 0.07], [-0.06, 1.07, 0.21]),
        box([0.06, 1.026, 0.07], [0.12, 1.07, 0.21]),
    ]
    return [("cast", merge(jaws)), ("bright", rod("x", (0.141, 1.013, 0.14), 0.1, 0.010, 12))]


def band_saw(paint: str) -> Parts:
    """Band saw of 1.9 m: cabinet, spine, wheel housings with their doors, tilting table, blade with its guide."""
    body = [
        rounded_box([-0.40, 0.0, -0.25], [0.34, 0.80, 0.20], 0.03, 3, edge=3),
        box([-0.40, 0.802, -0.14], [-0.24, 1.32, 0.06]),
        rounded_box([-0.42, 1.322, -0.16], [0.34, 1.92, 0.12], 0.05, 3, edge=3),
    ]
    doors = [
        turned("z", (-0.03, 1.62, 0.1205), [[0, 0], [0.27, 0], [0.25, 0.02], [0, 0.02]], 48),
        turned("z", (-0.03, 0.42, 0.2005), [[0, 0], [0.30, 0], [0.28, 0.02], [0, 0.02]], 48),
    ]
    cast = [box([-0.12, 0.802, -0.12], [0.20, 0.93, 0.12]), box([-0.22, 0.931, -0.27], [0.40, 0.965, 0.30])]
    cast.append(box([-0.22, 0.966, -0.20], [0.40, 1.02, -0.17]))
    bright = [box([0.118, 0.966, -0.008], [0.1195, 1.149, 0.008]), box([0.09, 1.15, -0.03], [0.15, 1.32, 0.03])]
    knobs = [rod("z", (0.20, 1.62, 0.1215), 0.03, 0.02, 16), rod("z", (0.23, 0.42, 0.2015), 0.03, 0.02, 16)]
    parts: Parts = [
        (paint, merge(body)), ("trim", merge(doors)), ("cast", merge(cast)), ("bright", merge(bright)),
        ("rubber", merge(knobs)),
    ]  # fmt: skip
    parts += _wheels(handwheel("y", (-0.2, 1.962, -0.02), 0.07))
    return parts + buttons((-0.32, 1.20, 0.0605), 0.05, 2)


def grinder(paint: str) -> Parts:
    """Double-ended bench grinder on a cast pedestal, 1.2 m."""
    foot = turned(
        "y", (0, 0, 0),
        [[0, 0], [0.22, 0], [0.22, 0.03], [0.09, 0.10], [0.075, 0.75], [0.14, 0.82], [0.14, 0.85], [0, 0.85]], 32,
    )  # fmt: skip
    motor = turned(
        "x", (-0.17, 1.02, 0),
        [[0, 0], [0.05, 0], [0.115, 0.04], [0.115, 0.30], [0.05, 0.34], [0, 0.34]], 32,
    )  # fmt: skip
    saddle = box([-0.10, 0.851, -0.09], [0.10, 0.93, 0.09])
    stones, covers, rests = [], [], []
    for s in (-1, 1):
        x = 0.235 * s
        stones.append(rod("x", (x - 0.016, 1.02, 0), 0.032, 0.10, 40))
        inner, outer = sorted((0.171 * s, 0.214 * s))
        covers.append(rod("x", (inner, 1.02, 0), outer - inner, 0.118, 40))
        covers.append(beam((x, 1.06, -0.128), (x, 1.14, -0.03), 0.05, 0.006))
        rests.append(box([x - 0.035, 0.99, 0.112], [x + 0.035, 1.0, 0.17]))
        rests.append(beam((0.19 * s, 0.985, 0.14), (0.14 * s, 0.90, 0.06), 0.03, 0.008))
    return [
        (paint, merge([foot, motor, saddle])), ("trim", merge(covers)), ("stone", merge(stones)),
        ("cast", merge(rests)),
        *buttons((0.0, 0.89, 0.0905), 0.05, 2),
    ]  # fmt: skip


def hydraulic_press(paint: str) -> Parts:
    """H-frame press of 1.9 m: two posts, head, ram and cylinder, bed on pins, a pump with its gauge."""
    frame = []
    for s in (-1, 1):
        lo, hi = sorted((0.34 * s, 0.44 * s))
        frame.append(box([lo, 0.051, -0.07], [hi, 1.86, 0.07]))
        frame.append(box([lo - 0.03, 0.0, -0.32], [hi + 0.03, 0.05, 0.32]))
    frame += [box([-0.339, 1.62, z], [0.339, 1.84, z + 0.03]) for z in (-0.08, 0.05)]
    bed = [box([-0.339, 0.72, z], [0.339, 0.86, z + 0.025]) for z in (-0.10, 0.075)]
    bed += [box([-0.15, 0.861, -0.12], [0.12, 0.90, 0.12])]
    bright = [
        rod("y", (0, 1.10, 0), 0.219, 0.035),
        turned("y", (0, 1.06, 0), [[0, 0], [0.05, 0], [0.05, 0.039], [0, 0.039]]),
    ]
    bright += [rod("z", (x, y, -0.12), 0.24, 0.014, 12) for x in (-0.39, 0.39) for y in (0.70,)]
    pump = [rod("y", (0, 1.32, 0), 0.29, 0.085), box([0.441, 1.05, -0.09], [0.60, 1.30, 0.09])]
    gauge = turned("z", (0.52, 1.38, -0.01), [[0, 0], [0.06, 0], [0.06, 0.035], [0, 0.035]], 32)
    bright.append(rod("y", (0.52, 1.301, 0.008), 0.022, 0.010, 12))
    hose = tube([[0.52, 1.301, -0.04], [0.50, 1.5, -0.02], [0.34, 1.52, 0.0], [0.087, 1.5, 0.0]], 0.011, 10)
    return [
        (paint, merge(frame)), ("cast", merge(bed)), ("bright", merge(bright)), ("panel", merge(pump)),
        ("stone", gauge), ("rubber", hose), *_lever((0.601, 1.12, 0), (0.70, 1.42, 0.06), 0.02),
    ]  # fmt: skip


MACHINES = {
    "lathe": turning_lathe, "drill": pillar_drill, "mill": milling_machine, "saw": band_saw, "grinder": grinder,
    "press": hydraulic_press,
}  # fmt: skip
