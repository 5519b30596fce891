"""The things on and beside the table, each about its own origin and standing on y = 0; lengths in metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scenes.kit.plants import mug
from scenes.kit.shapes import (
    Array,
    Mesh,
    Parts,
    atlas_uv,
    box,
    grid_faces,
    lathe,
    merge,
    move,
    move_parts,
    quad,
    rotation,
    rounded_box,
    slab,
    smooth,
    superellipsoid,
    tube,
)
from scenes.living_room.table_prints import CARDS, CARTONS, COVERS, LETTERS, SPINE, Rect, cell

_WRAP = (1.0, 0.0, 0.0, 1.0)  # a lathe's azimuth runs to the left of who looks at it
_JOIN = 0.0002  # left between the parts of a book


def _on_ground(parts: Parts) -> Parts:
    """The parts lifted so that their lowest point is at y = 0."""
    return move_parts(parts, (0, -min(mesh.v[:, 1].min() for _, mesh in parts), 0))


def _printed(face: Mesh, rect: Rect, turned: bool = False) -> Mesh:
    """A quad with `rect` of a texture on it, upright, or with the picture's top to the right (`turned`)."""
    mesh = atlas_uv(face, (0.0, 0.0, 1.0, 1.0))
    unit = np.stack([1 - mesh.uv[:, 1], mesh.uv[:, 0]], 1) if turned else mesh.uv
    return replace(mesh, uv=np.array(rect[:2]) + unit * (np.array(rect[2:]) - rect[:2]))


def printed_box(lo: Array, hi: Array, rects: list[Rect], turned: tuple[int, ...] = ()) -> Mesh:
    """Box with a picture upright on every face; `rects` in the order -x +x -y +y -z +z, `turned`: numbers of faces.

    The top's picture is upright for who stands at +z.
    """
    (x0, y0, z0), (x1, y1, z1) = lo, hi
    dx, dy, dz = np.diag(np.subtract(hi, lo))
    faces = [
        quad([x0, y1, z0], dz, -dy),
        quad([x1, y1, z1], -dz, -dy),
        quad([x0, y0, z1], dx, -dz),
        quad([x0, y1, z0], dx, dz),
        quad([x1, y1, z0], -dx, -dy),
        quad([x0, y1, z1], dx, -dy),
    ]
    return merge([_printed(face, rect, i in turned) for i, (face, rect) in enumerate(zip(faces, rects, strict=True))])


def book(number: int, width: float, depth: float, thick: float) -> Parts:
    """Closed book lying with cover `number` upwards: spine at -x, the title's top at -z.

    The covers are flush with the leaves: a board that stands out shows a strip too narrow for the baked light.
    """
    front, spine = cell(number, COVERS, (SPINE, 0, 1, 1)), cell(number, COVERS, (0, 0, SPINE, 1))
    plain = cell(number, COVERS, (0.02, 0.10, 0.04, 0.90))
    w, d, t, board = width / 2, depth / 2, thick, 0.0022
    back = printed_box(
        np.array([-w, 0, -d]), np.array([-w + board, t, d]), [spine, plain, plain, plain, plain, plain], (0,)
    )
    boards = [
        printed_box(
            np.array([-w + board + _JOIN, y, -d]),
            np.array([w, y + board, d]),
            [plain, plain, front, front, plain, plain],
        )
        for y in (0.0, t - board)
    ]
    block = box([-w + board + _JOIN, board + _JOIN, -d], [w, t - board - _JOIN, d])
    return [("covers", merge([back, *boards])), ("edges", block)]


def stack(books: list[tuple[int, float, float, float, float]]) -> Parts:
    """Books on one another: (number, width, depth, thickness, turn in degrees), the lowest first."""
    out: Parts = []
    y = 0.0
    for number, width, depth, thick, turn in books:
        out += move_parts(book(number, width, depth, thick), (0, y, 0), rotation("y", turn))
        y += thick + _JOIN
    return out


def open_book(width: float, depth: float) -> Parts:
    """Book lying open, `width` over both pages: leaves that rise from the fold and fall to the fore edges."""
    base = 0.003
    x, z = np.meshgrid(np.linspace(-width / 2, width / 2, 49), np.linspace(-depth / 2, depth / 2, 7), indexing="ij")
    s = np.abs(x) / (width / 2)
    y = base + 0.005 + 0.030 * s**0.45 * (1 - s) ** 0.9 + 0.004 * (1 - s)
    grid = np.stack([x, y, z], -1)
    uv = np.stack([x / width + 0.5, z / depth + 0.5], -1)
    leaves = smooth(grid.reshape(-1, 3), uv.reshape(-1, 2), grid_faces(*x.shape)[:, ::-1])
    rim = np.concatenate([grid[0, :-1], grid[:-1, -1], grid[-1, :0:-1], grid[:0:-1, 0], grid[:1, 0]])
    low = rim * (1, 0, 1) + (0, base, 0)
    along = np.cumsum(np.linalg.norm(np.diff(rim, axis=0, prepend=rim[:1]), axis=1))
    side_uv = np.stack([np.stack([along, -line[:, 1]], 1) for line in (rim, low)], 1)
    side = smooth(np.stack([rim, low], 1).reshape(-1, 3), side_uv.reshape(-1, 2), grid_faces(len(rim), 2)[:, ::-1])
    flat = grid * (1, 0, 1) + (0, base, 0)
    under = smooth(flat.reshape(-1, 3), uv.reshape(-1, 2) * 0.05, grid_faces(*x.shape))
    plain = cell(4, COVERS, (0.02, 0.10, 0.04, 0.90))
    w, d = width / 2, depth / 2
    cover = printed_box(np.array([-w, 0, -d]), np.array([w, base - _JOIN, d]), [plain] * 6)
    return [("spread", leaves), ("edges", merge([side, under])), ("covers", cover)]


def sheet(material: str, rect: Rect, width: float, depth: float, thick: float, curl: float = 0.0) -> Parts:
    """Flat printed matter, the picture's top at -z; `curl`: how far the corner at +x +z lifts."""
    z, x = np.meshgrid(np.linspace(-0.5, 0.5, 13), np.linspace(-0.5, 0.5, 13), indexing="ij")
    y = curl * np.clip((x + z) - 0.25, 0, 1) ** 2 / 0.75**2
    uv = np.stack([rect[0] + (rect[2] - rect[0]) * (x + 0.5), rect[1] + (rect[3] - rect[1]) * (z + 0.5)], -1)
    return _on_ground([(material, slab(np.stack([x * width, y, z * depth], -1), thick, uv))])


def card(number: int) -> Parts:
    """Postcard."""
    return sheet("cards", cell(number, CARDS), 0.140, 0.090, 0.0012)


def magazine(number: int, curl: float = 0.0) -> Parts:
    """Magazine, cover `number` upwards, one corner lifted by `curl`."""
    return sheet("covers", cell(number, COVERS, (SPINE, 0, 1, 1)), 0.21, 0.28, 0.005, curl)


def newspaper() -> Parts:
    """Folded newspaper."""
    return sheet("cartons", cell(5, CARTONS), 0.32, 0.22, 0.007, 0.010)


def _carton(width: float, depth: float, low: float, high: float, rects: list[Rect]) -> Mesh:
    """Printed box about the y axis, from y = low to high; `rects` as for `printed_box`."""
    w, d = width / 2, depth / 2
    return printed_box(np.array([-w, low, -d]), np.array([w, high, d]), rects)


def tea_carton() -> Parts:
    """Upright carton of tea."""
    front, side, top = cell(0, CARTONS), cell(1, CARTONS), cell(0, CARTONS, (0, 0, 1, 0.23))
    return [("cartons", _carton(0.075, 0.054, 0, 0.115, [side, side, top, top, front, front]))]


def biscuit_tin() -> Parts:
    """Flat rectangular tin with a lid a little wider than itself."""
    lid, side = cell(4, CARTONS), cell(4, CARTONS, (0.0, 0.0, 1.0, 0.14))
    tin = _carton(0.170, 0.120, 0, 0.040, [side] * 6)
    cap = _carton(0.174, 0.124, 0.040 + _JOIN, 0.052, [side, side, side, lid, side, side])
    return [("cartons", merge([tin, cap]))]


def shoe_box() -> Parts:
    """Shoe box with its lid on."""
    lid, side = cell(2, CARTONS), cell(3, CARTONS)
    rim = cell(2, CARTONS, (0.0, 0.02, 1.0, 0.32))
    body = _carton(0.320, 0.190, 0, 0.088, [side] * 6)
    cap = _carton(0.326, 0.196, 0.088 + _JOIN, 0.118, [rim, rim, rim, lid, rim, rim])
    return [("cartons", merge([body, cap]))]


def block(number: int) -> Parts:
    """Wooden toy block of 45 mm with letters, `number` upwards."""
    rects = [cell(number + k, LETTERS) for k in (1, 2, 3, 0, 4, 5)]
    return [("letters", _carton(0.045, 0.045, 0, 0.045, rects))]


def remote() -> Parts:
    """Remote control, its far end at -z."""
    body = rounded_box([-0.0225, 0, -0.078], [0.0225, 0.019, 0.078], 0.006, 4, edge=3)
    return [("remote", replace(body, uv=body.v[:, [0, 2]] / (0.045, 0.156) + 0.5))]


def striped_mug() -> Parts:
    """The room's mug, painted with rings."""
    return [("stripes", mug())]


def _china(mesh: Mesh, around: float) -> Mesh:
    """China pattern on a lathe, `around` times (a whole number: no seam); images are twice as wide as high."""
    lo, hi = mesh.uv.min(0), mesh.uv.max(0)
    high = (hi[1] - lo[1]) / (hi[0] - lo[0]) * around * 2
    return atlas_uv(mesh, (around, 0.0, 0.0, high))


def teapot() -> Parts:
    """Bellied teapot, spout to +x, handle to -x."""
    t = np.linspace(0, 1, 20)
    belly = np.stack([0.044 - 0.004 * t + 0.028 * np.sin(np.pi * t) ** 0.8, 0.004 + 0.092 * t], 1)
    knob = [[0.011, 0.122], [0.012, 0.127], [0.009, 0.132], [0.004, 0.1345], [0, 0.135]]
    lid = [[0.041, 0.097], [0.041, 0.100], [0.034, 0.107], [0.022, 0.112], [0.010, 0.1145], [0.0065, 0.117], *knob]
    body = _china(lathe([[0, 0], [0.040, 0], *belly.tolist(), *lid], 56), 2)
    s = np.linspace(0, 1, 40)
    path = np.stack([0.054 + 0.066 * s, 0.040 + 0.020 * s + 0.038 * s**2.2, 0 * s], 1)
    spout = tube(path, 0.0145 - 0.0075 * s, 28)
    a = np.linspace(0, np.pi, 22)
    grip = tube(np.stack([-0.045 - 0.062 * np.sin(a), 0.055 + 0.034 * np.cos(a), 0 * a], 1), 0.0058, 12)
    return [("china", merge([body, *(replace(m, uv=m.uv / (0.226, 0.113)) for m in (spout, grip))]))]


def cup_and_saucer() -> Parts:
    """Tea cup on its saucer."""
    t = np.linspace(0, 1, 12)
    outer = np.stack([0.024 + 0.018 * np.sin(np.pi / 2 * t), 0.003 + 0.055 * t**1.3], 1)
    inner = (outer + np.array([-0.003, 0.003]))[:-1][::-1]
    rim = [[0.0412, 0.0588], [0.0398, 0.0585]]
    cup = lathe([[0, 0], [0.022, 0], *outer.tolist(), *rim, *inner.tolist(), [0, 0.006]], 48)
    a = np.linspace(-1.35, 1.35, 14)
    ear = tube(np.stack([0.0375 + 0.022 * np.cos(a), 0.036 + 0.017 * np.sin(a), 0 * a], 1), 0.0032, 10)
    rise = [[0.035, 0.0], [0.038, 0.003], [0.055, 0.008], [0.070, 0.0145], [0.071, 0.0155], [0.070, 0.0165]]
    plate = lathe([[0, 0], *rise, [0.054, 0.0105], [0.038, 0.0065], [0.034, 0.0060], [0, 0.0060]], 64)
    high = (0, 0.0060 + _JOIN, 0)
    parts = [_china(plate, 2), move(_china(cup, 1), high), move(replace(ear, uv=ear.uv / (0.226, 0.113)), high)]
    return [("china", merge(parts))]


def oil_bottle() -> Parts:
    """Corked bottle with a label around it."""
    t = np.linspace(0, 1, 9)
    shoulder = np.stack([0.036 - 0.022 * (0.5 - 0.5 * np.cos(np.pi * t)), 0.168 + 0.048 * t], 1)
    neck = [[0.0135, 0.240], [0.0155, 0.2405], [0.0155, 0.248], [0.0105, 0.2485], [0.0105, 0.262], [0, 0.262]]
    return [("bottle", atlas_uv(lathe([[0, 0], [0.034, 0], [0.036, 0.002], *shoulder.tolist(), *neck], 56), _WRAP))]


def food_tin() -> Parts:
    """Food tin with a rim and a label around it."""
    profile = [[0.0, 0.0], [0.0375, 0.0], [0.0375, 0.110], [0.0355, 0.110], [0.0355, 0.107], [0.0, 0.107]]
    return [("tin", atlas_uv(lathe(profile, 56), _WRAP))]


def aloe(seed: int) -> Parts:
    """Small aloe in an earthen pot."""
    rng = np.random.default_rng(seed)
    outer = [[0.0, 0.0], [0.034, 0.0], [0.044, 0.058], [0.049, 0.060], [0.050, 0.074]]
    pot = lathe([*outer, [0.046, 0.074], [0.043, 0.062], [0.0, 0.062]], 48)
    soil = lathe([[0, 0.0622], [0.0432, 0.0622], [0.0450, 0.067], [0.02, 0.070], [0, 0.071]], 48)
    leaves = []
    for i in range(19):
        heading, lean = np.radians(137.5 * i + rng.uniform(-12, 12)), np.radians(14 + 2.9 * i)
        length = rng.uniform(0.085, 0.115) * (1.12 - 0.016 * i)
        s = np.linspace(0, 1, 10)
        out = length * (np.sin(lean) * s + 0.10 * s**2)
        up = length * (np.cos(lean) * s + 0.30 * s**2 * np.sin(lean))
        path = np.stack([(0.005 + out) * np.cos(heading), 0.064 + up, (0.005 + out) * np.sin(heading)], 1)
        leaves.append(tube(path, 0.0008 + 0.0085 * (1 - s) ** 0.8, 9))
    around = atlas_uv(pot, (0.0, 0.0, 1.0, 0.62))
    return [("pot", around), ("soil", soil), ("aloe", merge(leaves))]


def globe(radius: float) -> Parts:
    """Small globe on a turned foot, its axis held by half a ring and leaning by 23 degrees."""
    centre = 0.056 + 1.14 * radius
    lean = rotation("z", 23)
    ball = atlas_uv(superellipsoid([radius] * 3, 1.0, 1.0, 56, 30), _WRAP)
    a = np.linspace(-np.pi / 2 - 0.10, np.pi / 2 + 0.10, 30)
    ring = tube(np.stack([1.12 * radius * np.cos(a), 1.12 * radius * np.sin(a), 0 * a], 1), 0.0035, 10)
    pins = [tube([[0.0, s * 0.97 * radius, 0.0], [0.0, s * 1.13 * radius, 0.0]], 0.0022, 8) for s in (-1, 1)]
    turned = [[0.050, 0.0], [0.051, 0.006], [0.046, 0.010], [0.018, 0.017], [0.009, 0.030], [0.010, 0.044]]
    foot = lathe([[0, 0], *turned, [0.006, 0.056], [0, 0.056]], 48)
    held = [move(mesh, (0, centre, 0), lean) for mesh in (ring, *pins)]
    return [("globe", move(ball, (0, centre, 0), lean @ rotation("y", 70))), ("wood", merge([foot, *held]))]


def toy_ball(radius: float) -> Parts:
    """Painted ball, rolled over a little."""
    ball = atlas_uv(superellipsoid([radius] * 3, 1.0, 1.0, 64, 32), _WRAP)
    return _on_ground([("ball", move(ball, r=rotation("x", 35) @ rotation("z", 20)))])


def ring_tower() -> Parts:
    """Stacking toy: five round rings on a foot, a ball on top; soft grooves, since sharp ones bake black."""
    s = np.linspace(0, 1, 51)
    rings = np.stack([0.045 - 0.022 * s - 0.003 * np.cos(10 * np.pi * s), 0.010 + 0.1025 * s], 1)
    a = np.linspace(-1.1, np.pi / 2, 9)
    ball = np.stack([0.013 * np.cos(a), 0.124 + 0.013 * np.sin(a)], 1)
    ball[-1, 0] = 0.0
    foot = [[0.0, 0.0], [0.052, 0.0], [0.054, 0.003], [0.052, 0.009]]
    return [("rings", atlas_uv(lathe([*foot, *rings.tolist(), *ball.tolist()], 48), (0.0, 0.0, 1.0, 1.0)))]


def pencil() -> Parts:
    """Six-sided pencil along x."""
    body = tube([[0.0, 0.0, 0.0], [0.150, 0.0, 0.0], [0.170, 0.0, 0.0]], [0.0037, 0.0037, 0.0008], 6)
    return _on_ground([("pencil", move(atlas_uv(body, (0.0, 0.0, 1.0, 1.0)), (-0.085, 0, 0)))])
