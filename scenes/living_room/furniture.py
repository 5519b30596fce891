"""The large pieces: sofas, armchair, tables, sideboard, bookshelf, lamps; each about its own origin, floor at y = 0."""

from __future__ import annotations

import numpy as np

from scenes.kit.shapes import (
    Mesh,
    Parts,
    atlas_uv,
    box,
    lathe,
    merge,
    move,
    move_parts,
    pillow,
    rotation,
    rounded_box,
    shift_uv,
    slab,
    superellipsoid,
    tube,
)
from scenes.living_room.pictures import book_rect


def sofa(cloth: str, width: float, depth: float, pillows: list[tuple[str, float, float]], backs: int = 3) -> Parts:
    """Three-seater about x = 0, back at z = 0, front at z = depth; seat 0.51, arms 0.68, back 0.84 above the floor.

    `pillows`: (material, x, size). `backs`: how many of the three seats, from +x on, have a loose back cushion.
    """
    arm = 0.21
    inner = width / 2 - arm - 0.004
    cloths = [
        rounded_box([-width / 2 + 0.01, 0.12, 0.02], [width / 2 - 0.01, 0.33, depth - 0.03], 0.05, 12, 0.005),
        rounded_box([-width / 2 + 0.02, 0.332, 0.0], [width / 2 - 0.02, 0.84, 0.19], 0.08, 18, 0.012),
    ]
    for s in (-1, 1):
        lo, hi = sorted((s * width / 2, s * (width / 2 - arm)))
        cloths.append(rounded_box([lo, 0.13, 0.03], [hi, 0.68, depth - 0.01], 0.09, 14, 0.012))
    n, gap = 3, 0.006
    w = 2 * inner / n
    turn = rotation("x", -9)
    for i in range(n):
        a, b = -inner + i * w + gap, -inner + (i + 1) * w - gap
        seat = rounded_box([a, 0.345, 0.20], [b, 0.492, depth], 0.06, 16, 0.02, 5)
        cloths.append(shift_uv(seat, 0.43 * i, 0.29 * i))
        if i >= n - backs:
            back = superellipsoid([(b - a) / 2, 0.205, 0.085], 0.32, 0.32, 60, 32)
            cloths.append(shift_uv(move(back, ((a + b) / 2, 0.68, 0.285), turn), 0.37 * i + 0.2, 0.5))
        cloths.append(_piping(a, b, 0.20, depth, 0.492))
    feet = []
    for x in (-width / 2 + 0.12, width / 2 - 0.12):
        for z in (0.1, depth - 0.12):
            feet.append(move(lathe([[0.0, 0.0], [0.018, 0], [0.028, 0.12], [0, 0.12]], 20), (x, 0.0, z)))
    parts: Parts = [(cloth, merge(cloths)), ("walnut", merge(feet))]
    for i, (name, x, size) in enumerate(pillows):
        r = rotation("y", 14 * (-1) ** i) @ rotation("x", -22 - 3 * i) @ rotation("z", 7 * (-1) ** i)
        parts.append((name, move(pillow(size, size, 0.15), (x, 0.505 + size / 2, 0.47), r)))
    return parts


def _piping(a: float, b: float, z0: float, z1: float, y: float) -> Mesh:
    """Welt cord around the top edge of a seat cushion."""
    r, m = 0.055, np.linspace(0, np.pi / 2, 7)
    corners = [(b - r, z1 - r, 0), (a + r, z1 - r, 1), (a + r, z0 + r, 2), (b - r, z0 + r, 3)]
    points = [
        [x + r * np.cos(q + k * np.pi / 2), y - 0.014, z + r * np.sin(q + k * np.pi / 2)]
        for x, z, k in corners
        for q in m
    ]
    return tube([*points, points[0]], 0.006, 8)


def throw_blanket(width: float) -> Parts:
    """Knitted blanket laid over a sofa's arm that runs along z: flat across the arm, hanging on both sides."""
    s, t = np.linspace(-1, 1, 70), np.linspace(0, 1, 40)
    u, v = np.meshgrid(s, t, indexing="ij")
    half, drop = 0.118, 0.36
    along = u * (half + drop)
    over = np.clip(along, -half, half)
    down = np.abs(along) - np.abs(over)
    ripple = 0.012 * np.sin(9 * v * 2 * np.pi / 2 + 2 * u) * np.clip(down / 0.15, 0, 1)
    x = over + np.sign(along) * (ripple + 0.012 * np.clip(down / 0.03, 0, 1) + 0.006)
    y = 0.698 - down * (0.9 + 0.1 * np.cos(5 * v)) - 0.018 * (np.abs(over) / half) ** 4
    z = v * width + 0.01 * np.sin(7 * u)
    return [("pillow_c", slab(np.stack([x, y, z], -1)[:, ::-1], 0.008, np.stack([along, z], -1)[:, ::-1]))]


def folded_blanket(width: float, depth: float) -> Parts:
    """Blanket folded to a soft pile on y = 0."""
    folds = [
        rounded_box(
            [-width / 2 + 0.006 * i, 0.024 * i, -depth / 2 + 0.004 * i],
            [width / 2 - 0.004 * i, 0.024 * i + 0.023, depth / 2],
            0.011,
            10,
            0.002,
        )
        for i in range(4)
    ]
    return [("pillow_c", merge([shift_uv(f, 0.13 * i, 0.21 * i) for i, f in enumerate(folds)]))]


def armchair() -> Parts:
    """Shell armchair on four splayed legs, facing +z, back towards z = 0."""
    cloths = [
        rounded_box([-0.33, 0.24, 0.10], [0.33, 0.335, 0.70], 0.045, 16, 0.01),
        rounded_box([-0.29, 0.34, 0.16], [0.29, 0.46, 0.72], 0.055, 20, 0.02, 6),
    ]
    a = np.radians(np.linspace(-200, 20, 70))
    t = np.linspace(0, 1, 26)
    aa, tt = np.meshgrid(a, t, indexing="ij")
    rise = 0.30 + 0.28 * np.clip(-np.sin(aa), 0, 1) ** 2
    x = (0.36 + 0.05 * tt) * np.cos(aa)
    z = 0.44 + (0.34 + 0.08 * tt) * np.sin(aa)
    y = 0.27 + rise * tt
    arc = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x[:, 0]), np.diff(z[:, 0])))])
    uv = np.stack(np.broadcast_arrays(arc[:, None], -y), -1)
    cloths.append(slab(np.stack([x, y, z], -1), 0.055, uv))
    rim = tube(np.stack([x[:, -1], y[:, -1], z[:, -1]], -1), 0.036, 14)
    cloths.append(rim)
    cloths += [move(superellipsoid([0.037, 0.037, 0.037]), (x[i, -1], y[i, -1], z[i, -1])) for i in (0, -1)]
    legs = [
        tube([[sx * 0.25, 0.245, 0.44 + sz * 0.22], [sx * 0.32, 0.006, 0.44 + sz * 0.30]], [0.019, 0.012], 14)
        for sx in (-1, 1)
        for sz in (-1, 1)
    ]
    cushion = move(pillow(0.42, 0.36, 0.13), (0.02, 0.64, 0.22), rotation("x", -14))
    return [("armchair", merge(cloths)), ("walnut", merge(legs)), ("pillow_b", cushion)]


def low_table(width: float, depth: float, height: float) -> Parts:
    """Low table about the origin: lacquered top with rounded edges, shelf, four turned legs."""
    top = rounded_box([-width / 2, height - 0.035, -depth / 2], [width / 2, height, depth / 2], 0.014, 20)
    shelf = rounded_box(
        [-width / 2 + 0.07, 0.12, -depth / 2 + 0.07], [width / 2 - 0.07, 0.14, depth / 2 - 0.07], 0.008, 6
    )
    y = np.array([0, 0.02, 0.10, 0.16, 0.22, height - 0.09, height - 0.036])
    leg = lathe(
        [*np.stack([[0.016, 0.02, 0.024, 0.03, 0.024, 0.026, 0.032], y], 1).tolist(), [0.0, height - 0.036]],
        28,
    )
    leg = merge([leg, lathe([[0, 0], [0.016, 0]], 28)])
    legs = [move(leg, (sx * (width / 2 - 0.06), 0, sz * (depth / 2 - 0.06))) for sx in (-1, 1) for sz in (-1, 1)]
    apron = [
        box(
            [-width / 2 + 0.095, height - 0.10, s * (depth / 2 - 0.06) - 0.01],
            [width / 2 - 0.095, height - 0.037, s * (depth / 2 - 0.06) + 0.01],
        )
        for s in (-1, 1)
    ]
    return [("lacquer", top), ("oak", merge([shelf, *apron])), ("walnut", merge(legs))]


def round_table(radius: float, height: float) -> Parts:
    """Side table on a turned pedestal."""
    r, h = radius, height
    profile: list[list[float]] = [
        [0, 0],
        [0.13, 0],
        [0.135, 0.012],
        [0.06, 0.03],
        [0.026, 0.07],
        [0.022, 0.2],
        [0.034, 0.26],
        [0.022, 0.33],
    ]
    profile += [
        [0.02, h - 0.08],
        [0.05, h - 0.028],
        [r - 0.01, h - 0.026],
        [r, h - 0.014],
        [r - 0.004, h - 0.003],
        [r - 0.012, h],
        [0, h],
    ]
    return [("oak", lathe(profile, 64))]


def bookshelf(width: float, depth: float, height: float) -> Parts:
    """Open bookcase about x = 0, back at z = 0: five boards (see `SHELF_BOARDS`), sides, back panel, plinth."""
    t = 0.024
    boards = [
        rounded_box([-width / 2 + t + 0.001, y, 0.014], [width / 2 - t - 0.001, y + t, depth - 0.006], 0.003, 4, edge=2)
        for y in SHELF_BOARDS
    ]
    sides = [rounded_box([x, 0, 0.0], [x + t, height, depth], 0.003, 4, edge=2) for x in (-width / 2, width / 2 - t)]
    top = rounded_box(
        [-width / 2 - 0.015, height + 0.001, 0.0], [width / 2 + 0.015, height + 0.03, depth + 0.015], 0.008, 6
    )
    panel = box([-width / 2 + t + 0.001, 0.05, 0.002], [width / 2 - t - 0.001, height - 0.001, 0.012])
    plinth = box(
        [-width / 2 + t + 0.001, 0.001, depth - 0.05], [width / 2 - t - 0.001, SHELF_BOARDS[0] - 0.001, depth - 0.035]
    )
    return [("oak", merge([*boards, *sides, top, panel, plinth]))]


SHELF_BOARDS = (0.06, 0.42, 0.77, 1.11, 1.45)


def book_row(x0: float, x1: float, depth: float, seed: int, tallest: float) -> Parts:
    """Upright books on y = 0 from x0 to x1, spines at z ≈ depth; some lean, some lie."""
    rng = np.random.default_rng(seed)
    covers, blocks = [], []
    x = x0
    while x < x1 - 0.05:
        w, h, d = rng.uniform(0.016, 0.045), tallest * rng.uniform(0.66, 1.0), rng.uniform(0.14, 0.2)
        turn, back = np.eye(3), depth - d - rng.uniform(0.005, 0.03)
        book = _book(w, h, d, int(rng.integers(0, 48)))
        if rng.uniform() < 0.12 and x < x1 - 0.16:  # leans on the one before
            lean = rng.uniform(5, 11)
            turn = rotation("z", lean)
            x += h * np.sin(np.radians(lean))
        placed = move_parts(book, (x, 0.0, back), turn)
        covers.append(placed[0][1])
        blocks.append(placed[1][1])
        x += w / np.cos(np.radians(11)) + 0.0015
        if rng.uniform() < 0.06:
            x += rng.uniform(0.03, 0.07)
    return [("book", merge(covers)), ("pages", merge(blocks))]


def _book(w: float, h: float, d: float, spine: int) -> Parts:
    """One book, spine towards +z, standing on y = 0 from x = 0 to w."""
    u0, v0, u1, v1 = book_rect(spine)
    curve = np.linspace(-1, 1, 7)
    back = np.stack(
        np.broadcast_arrays(w / 2 * (1 + curve)[:, None], np.array([h, 0.0]), (d + 0.004 * (1 - curve**2))[:, None]), -1
    )
    uv = np.stack(np.broadcast_arrays((u0 + (u1 - u0) * (1 + curve) / 2)[:, None], np.array([v0, v1])), -1)
    hull = slab(back - [0, 0, 0.003], 0.002, uv)
    boards = [
        atlas_uv(box([a, 0, 0.0], [a + 0.0025, h, d - 0.0035]), (u0, v0, u0 + 0.3 * (u1 - u0), v1))
        for a in (0, w - 0.0025)
    ]
    block = box([0.003, 0.004, 0.004], [w - 0.003, h - 0.004, d - 0.006])
    return [("book", merge([hull, *boards])), ("pages", block)]


def book_pile(sizes: list[tuple[float, float, float]], seed: int) -> Parts:
    """Books lying on each other on y = 0; sizes (thickness, height, depth)."""
    rng = np.random.default_rng(seed)
    out, y = [], 0.0
    for w, h, d in sizes:
        flat = move_parts(_book(w, h, d, int(rng.integers(0, 48))), (h / 2, 0, -d / 2), rotation("z", 90))
        out += move_parts(flat, (0, y, 0), rotation("y", rng.uniform(-16, 16)))
        y += w + 0.001
    return out


def sideboard(width: float, depth: float, height: float) -> Parts:
    """Sideboard about x = 0, back at z = 0: carcass on tapered legs, three fluted doors with knobs."""
    body = rounded_box([-width / 2, 0.16, 0.0], [width / 2, height, depth - 0.022], 0.012, 16)
    doors, knobs = [], []
    w = (width - 0.04) / 3
    for i in range(3):
        a = -width / 2 + 0.02 + i * w + 0.003
        b = a + w - 0.006
        n = 14
        for j in range(n):
            c, e = a + (b - a) * j / n, a + (b - a) * (j + 1) / n
            doors.append(
                rounded_box(
                    [c + 0.001, 0.185, depth - 0.021], [e - 0.001, height - 0.035, depth - 0.002], 0.0085, 4, edge=3
                )
            )
        knobs.append(
            move(superellipsoid([0.013, 0.013, 0.013], nu=20, nv=12), ((a + b) / 2, height - 0.12, depth + 0.011))
        )
    legs = [
        move(lathe([[0.0, 0.0], [0.012, 0], [0.024, 0.159], [0, 0.159]], 20), (x, 0, z))
        for x in (-width / 2 + 0.08, width / 2 - 0.08)
        for z in (0.07, depth - 0.09)
    ]
    return [("walnut", merge([body, *doors, *legs])), ("brass", merge(knobs))]


def foot_lamp(height: float) -> tuple[Parts, Mesh]:
    """Floor lamp about the origin: stand, and its glowing shade (closed, double-walled) centred at `height`."""
    profile: list[list[float]] = [
        [0, 0],
        [0.15, 0],
        [0.155, 0.012],
        [0.13, 0.024],
        [0.03, 0.034],
        [0.013, 0.06],
        [0.013, height - 0.22],
    ]
    stand = lathe([*profile, [0.022, height - 0.2], [0.022, height - 0.12], [0.0, height - 0.12]], 48)
    spokes = [
        tube([[0, height - 0.13, 0], [0.19 * np.cos(a), height - 0.12, 0.19 * np.sin(a)]], 0.003, 8)
        for a in (0.3, 2.4, 4.5)
    ]
    return [("black", merge([stand, *spokes]))], lamp_shade(0.215, 0.165, 0.30, height)


def lamp_shade(bottom: float, top: float, tall: float, y: float) -> Mesh:
    """Conical shade, 4 mm thick, centred at height y; closed surface, open tube."""
    a, b = y - tall / 2, y + tall / 2
    inner = [[top - 0.004, b], [bottom - 0.004, a]]
    side = [[bottom + (top - bottom) * t, a + tall * t] for t in np.linspace(0, 1, 9)]
    return lathe([inner[1], *side, inner[0], inner[1]], 64)
