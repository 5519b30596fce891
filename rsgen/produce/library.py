"""The scenes that ship: found by looking into the folder scenes, each with the script that builds it.

A script is one that defines a function `build`: scenes/X/build.py builds scenes/X/scene.xml and is called X, another
scenes/X/y.py builds scenes/X/y.xml and is called y (`scene.loading.ensure_built` builds by the same rule). It is read,
not run: what it is comes from its constant ABOUT, or else from its docstring, and it takes seeds where `build` has a
parameter of that name.
"""

from __future__ import annotations

import ast
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.config import load_config
from rsgen.config.sections import LightConfig
from rsgen.console.configs import configs_folder
from rsgen.console.tables import Table
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.files import parse_yaml
from rsgen.motion.free_space import find_floors
from rsgen.scene.loading import content_hash, load_scene
from rsgen.scene.meshes import surface

_SHORT = 110  # characters of what a scene or a config is
_PLY_TYPES = {
    b"char": "i1", b"uchar": "u1", b"short": "<i2", b"ushort": "<u2", b"int": "<i4", b"uint": "<u4", b"float": "<f4",
    b"double": "<f8",
}  # fmt: skip


@dataclass(frozen=True)
class Contents:
    """What a built scene is made of. size: (3,) m, of its box; lit: how many of the settings of light are baked."""

    triangles: int
    size: tuple[float, float, float]
    materials: tuple[str, ...]
    lit: tuple[int, int]

    def text(self) -> str:
        """In one line."""
        lit, settings = self.lit
        x, y, z = self.size
        light = f"light baked for {lit} of {settings} settings"
        if lit in (0, settings):
            light = "light baked" if lit == settings else "light not baked yet"
        return f"{x:.1f} x {y:.1f} x {z:.1f} m, {self.triangles:,} triangles, {light}"


@dataclass(frozen=True)
class ShippedScene:
    """A scene of the library. file: the Mitsuba scene that `script` builds; configs: those that render it."""

    name: str
    about: str
    script: Path
    file: Path
    takes_seed: bool
    configs: tuple[Path, ...]

    @property
    def config_lines(self) -> list[str]:
        """Of each config its name, and what it says of itself; a line that there is none."""
        told = [f"{file.stem:<14} {_first_comment(file)}".rstrip() for file in self.configs]
        return told or ["none yet"]

    @property
    def how_to_vary(self) -> str:
        """The command that builds another such scene, or that there is none."""
        return f"rsgen scenes {self.name} --seed N --out DIR" if self.takes_seed else "takes no seed"

    @cached_property
    def contents(self) -> Contents | None:
        """What its file and the meshes that it names hold; None: it is not built. Raises UserError if it is damaged."""
        if not self.file.is_file():
            return None
        try:
            meshes, materials = _named(self.file)
            counted = [_ply_box(mesh) for mesh in meshes]
        except (OSError, ET.ParseError, KeyError, ValueError, IndexError) as error:
            raise UserError(f"scene {self.file}: is damaged ({error}): delete it, then it is built again") from None
        triangles, low, high = zip(*counted, strict=True)
        x, y, z = (float(v) for v in np.max(high, axis=0) - np.min(low, axis=0))
        return Contents(sum(triangles), (x, y, z), tuple(sorted(materials)), _lit(self))

    @property
    def built(self) -> str:
        """Its contents in a line."""
        return self.contents.text() if self.contents else "not built yet: it is when it is first rendered"

    def facts(self) -> dict[str, Any]:
        """Plain values, sizes in m."""
        contents = self.contents
        return {
            "about": self.about, "file": str(self.file), "script": str(self.script), "built": contents is not None,
            "triangles": None if contents is None else contents.triangles,
            "size_m": None if contents is None else list(contents.size),
            "light_baked": None if contents is None else contents.lit[0] == contents.lit[1],
            "configs": [file.stem for file in self.configs], "takes_seed": self.takes_seed,
        }  # fmt: skip


@dataclass(frozen=True)
class Listing:
    """All scenes below a folder."""

    scenes: tuple[ShippedScene, ...]
    folder: Path

    def text(self) -> str:
        """A block of lines a scene."""
        blocks = []
        for scene in self.scenes:
            lines = [f"{scene.name}: {scene.about}", f"  {scene.built}"]
            lines += [f"  another by seed: {scene.how_to_vary}", "  configs:"]
            lines += [f"    {line}" for line in scene.config_lines]
            blocks.append("\n".join(lines))
        note = "rsgen scenes NAME tells more of one, rsgen render CONFIG renders"
        return "\n".join([*blocks, f"in {self.folder} ({note})"])

    def as_dict(self) -> dict[str, Any]:
        """The same by name, sizes in m."""
        return {scene.name: scene.facts() for scene in self.scenes}


@dataclass(frozen=True)
class Description:
    """One scene in full. floor: y of its largest floor and the free height above it, m, None without a ceiling.

    floor: None where it is not built.
    """

    scene: ShippedScene
    floor: tuple[float, float | None] | None

    def text(self) -> str:
        """A line a fact."""
        scene, contents = self.scene, self.scene.contents
        rows = [("what", scene.about), ("file", str(scene.file)), ("script", str(scene.script))]
        rows.append(("built", scene.built))
        if self.floor is not None:
            y, height = self.floor
            high = "no ceiling" if height is None else f"{height:.2f} m free above it"
            rows.append(("floor", f"at y = {y:.3f} m, {high}"))
        if contents is not None:
            rows.append(("materials", f"{len(contents.materials)}: {' '.join(contents.materials)}"))
        rows += [("configs" if k == 0 else "", line) for k, line in enumerate(scene.config_lines)]
        rows.append(("another", scene.how_to_vary))
        rows.append(("a tour", f"rsgen motion suggest {scene.file} --seed N --out my.yaml"))
        return Table((scene.name, ""), tuple(rows), words=(0, 1)).text()

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values, m."""
        y, height = self.floor or (None, None)
        contents = self.scene.contents
        return {
            "name": self.scene.name, **self.scene.facts(),
            "materials": None if contents is None else list(contents.materials),
            "floor_y_m": y, "free_height_m": height,
        }  # fmt: skip


def scenes_folder() -> Path:
    """The folder of the scenes, beside that of the configs."""
    return configs_folder().parent / "scenes"


def shipped_scenes(folder: Path, configs: Path) -> list[ShippedScene]:
    """The scenes below `folder`, by name, with those of the `configs` (a folder) that render each."""
    users: dict[Path, list[Path]] = {}
    for file in sorted(configs.glob("*.yaml")):
        data = parse_yaml(file.read_text(encoding="utf-8"))
        of = data.get("scene") if isinstance(data, dict) else None
        if isinstance(of, dict) and isinstance(of.get("file"), str):
            users.setdefault((file.parent / of["file"]).resolve(), []).append(file)
    found = []
    for script in sorted(folder.glob("*/*.py")):
        tree = ast.parse(script.read_text(encoding="utf-8"))
        build = next((n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == "build"), None)
        if build is None:
            continue
        is_main = script.name == "build.py"
        file = script.with_name("scene.xml") if is_main else script.with_suffix(".xml")
        takes_seed = "seed" in (a.arg for a in (*build.args.args, *build.args.kwonlyargs))
        name, used_by = script.parent.name if is_main else script.stem, tuple(users.get(file.resolve(), ()))
        found.append(ShippedScene(name, _about(tree), script, file, takes_seed, used_by))
    return sorted(found, key=lambda scene: scene.name)


def list_scenes() -> Listing:
    """What ships, and what is built and lit of it."""
    folder = scenes_folder()
    return Listing(tuple(shipped_scenes(folder, configs_folder())), folder)


def find_scene(name: str) -> ShippedScene:
    """The scene that is called so. Raises UserError naming those that there are."""
    scenes = {scene.name: scene for scene in shipped_scenes(scenes_folder(), configs_folder())}
    if name not in scenes:
        raise UserError(f"scene '{name}': no such scene ships: choose {', '.join(scenes)}")
    return scenes[name]


def describe_scene(name: str) -> Description:
    """One scene in full. Raises UserError for an unknown name."""
    scene = find_scene(name)
    return Description(scene, None if scene.contents is None else _largest_floor(scene.file))


def build_variant(name: str, seed: int | None, out: Path) -> Path:
    """Build the scene into the folder `out` with a seed, None: the script's own, and return the path of its file.

    Raises UserError for an unknown name, a seed where the script takes none or below 0, and if the script fails.
    """
    scene = find_scene(name)
    if seed is not None and not scene.takes_seed:
        raise UserError(f"--seed {seed}: scene '{name}' takes no seed: leave it out, or choose another scene")
    if seed is not None and seed < 0:
        raise UserError(f"--seed {seed}: must be at least 0")
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: is a file: name a folder")
    seeded = [] if seed is None else ["--seed", str(seed)]
    done = subprocess.run(
        [sys.executable, str(scene.script), "--out", str(out), *seeded], capture_output=True, text=True
    )
    if done.returncode:
        raise UserError(f"scene '{name}': {scene.script} failed ({done.stderr.strip().rpartition(chr(10))[2]})")
    return out / scene.file.name


def _about(tree: ast.Module) -> str:
    """What a script says that it builds: its constant ABOUT, or the first sentence after its docstring's first line."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and [getattr(t, "id", "") for t in node.targets] == ["ABOUT"]:
            return str(ast.literal_eval(node.value))
    head, _, rest = (ast.get_docstring(tree) or "").partition("\n\n")
    return _first_sentence(rest.partition("\n\n")[0] or head)


def _first_comment(file: Path) -> str:
    """The first sentence of the comment that a config begins with."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return _first_sentence(" ".join(line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), lines)))


def _first_sentence(text: str) -> str:
    sentence = " ".join(text.split()).partition(". ")[0].rstrip(".")
    return sentence if len(sentence) <= _SHORT else sentence[:_SHORT].rpartition(" ")[0] + " ..."


def _named(file: Path) -> tuple[list[Path], set[str]]:
    """The mesh files and the ids of the materials of a scene file and of those that it includes."""
    root = ET.fromstring(file.read_bytes())
    meshes = [
        file.parent / value.get("value", "")
        for shape in root.iter("shape")
        for value in shape.iter("string")
        if value.get("name") == "filename" and value.get("value", "").endswith(".ply")
    ]
    materials = {str(bsdf.get("id")) for bsdf in root.iter("bsdf") if bsdf.get("id")}
    for include in root.iter("include"):
        more, others = _named(file.parent / include.get("filename", ""))
        meshes, materials = meshes + more, materials | others
    return meshes, materials


def _ply_box(path: Path) -> tuple[int, FloatArray, FloatArray]:
    """Triangles of a binary PLY, and its vertices' least and largest corner (3,). Raises OSError or ValueError."""
    head, end, body = path.read_bytes().partition(b"end_header\n")
    if not end:
        raise ValueError(f"{path.name} is no PLY file")
    words = [line.split() for line in head.splitlines()]
    counts = {w[1]: int(w[2]) for w in words if w[0] == b"element"}
    after = words.index(next(w for w in words if w[:2] == [b"element", b"face"]))
    fields = [(w[2].decode(), _PLY_TYPES[w[1]]) for w in words[:after] if w[0] == b"property"]
    vertices = np.frombuffer(body, np.dtype(fields), counts[b"vertex"])
    position = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return counts[b"face"], position.min(axis=0), position.max(axis=0)


def _lit(scene: ShippedScene) -> tuple[int, int]:
    """How many of the settings of light with which its configs render it are baked, and of how many."""
    mitsuba()
    from rsgen.light.bake import cache_folder, cache_key

    lights = [load_config(file).light for file in scene.configs] or [LightConfig()]
    state = content_hash(scene.file)
    keys = {cache_key(state, light) for light in lights if light.mode == "baked"}
    folder = cache_folder(scene.file)
    return sum((folder / f"irradiance-{key}.npz").is_file() for key in keys), len(keys)


def _largest_floor(file: Path) -> tuple[float, float | None] | None:
    """`Description.floor` of a built scene: of floors with a ceiling, as `motion suggest` finds them, else of all."""
    from rsgen.scene.rays import cast_rays

    loaded = load_scene(file)
    corners = surface(loaded)[0].astype(np.float64)
    floors = find_floors(partial(cast_rays, loaded), corners.min(axis=0), corners.max(axis=0))
    if not floors:
        return None
    floor = next((floor for floor in floors if np.isfinite(floor.gap_m)), floors[0])  # a roof is larger than a room
    return floor.y, floor.gap_m if np.isfinite(floor.gap_m) else None
