"""Load any Mitsuba scene XML, or a mesh file through trimesh, as one Mitsuba scene made of triangles only.

Rectangles, disks, spheres, cylinders and instances become meshes on the way in, so that depth, `scene.ply` and the
baked light all speak of the same triangles. A scene folder that holds a `build.py` but no scene yet is built first;
there, a scene x.xml with an `x.py` of its own beside it is built by that, and seedN/scene.xml by `build.py --seed N`.
"""

from __future__ import annotations

import hashlib
import logging
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsgen.array_types import ByteArray, FloatArray, IntArray
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.formats import scene_reader, xml_helper
from rsgen.geometry import se3
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.image_codecs import encode_png
from rsgen.inputs import check_input
from rsgen.scene.meshes import meshes_of, ply_bytes, repair_meshes, split_terrain
from rsgen.scene.placement import ANALYTIC, AS_IT_IS, SceneOptions, place, place_lamps, tessellated, turn_mirrored
from rsgen.scene.xml_scene import (
    check_files,
    explained,
    log_renamed,
    messages_to_log,
    missing_file,
    parse,
    prepare,
    unknown_properties,
)

log = logging.getLogger("rsgen")

_UNSUPPORTED = ("sdfgrid", "bsplinecurve", "linearcurve", "ellipsoids", "ellipsoidsmesh")


def load_scene(path: Path, board: Board | None = None, options: SceneOptions = AS_IT_IS) -> Any:
    """Mitsuba scene of the file at `path`: .xml, or a mesh that trimesh reads, with its colours and a light of ours.

    board: to be put into it, as its last shape. options: how the file is placed, and a mesh file lit. Raises
    UserError, naming the file, if it is missing, unreadable, empty or of shapes that cannot become triangles.
    """
    ensure_built(path)
    mi = mitsuba()
    scratch_folder = tempfile.TemporaryDirectory(prefix="rsgen-scene-")
    with scratch_folder as scratch, messages_to_log(mi) as messages, _faults_of(path):
        if path.suffix.lower() == ".xml":
            scene = _load_xml(mi, path, Path(scratch), board, messages, options)
        else:
            shapes = scene_reader(path.suffix).scene_dict(mi, path, Path(scratch), options)
            if board is not None:
                shapes["target"] = mi.load_string(board_xml(board, Path(scratch)))
            # Else shapes would be merged, and ordered by memory address.
            scene = mi.load_dict(shapes, parallel=False, optimize=False)
    if not meshes_of(scene):
        raise UserError(f"scene {path}: has no surfaces to render: add a shape")
    return split_terrain(mi, repair_meshes(mi, scene, path))


def ensure_built(path: Path) -> None:
    """If the scene file is absent but a `build.py` stands beside it, run that, or for x.xml the `x.py` there if any.

    ROOM/seedN/scene.xml is the variant that `ROOM/build.py --seed N` makes. Raises UserError if there is no scene then.
    """
    own, script = path.parent / f"{path.stem}.py", path.parent / "build.py"
    words = [str(own if own.is_file() else script)]
    variant = re.fullmatch(r"seed([0-9]{1,9})", path.absolute().parent.name)
    if variant and not script.is_file():
        script = path.parent.parent / "build.py"
        words = [str(script), "--seed", variant[1], "--out", str(path.parent)]
    if not path.is_file() and script.is_file():
        log.info("building %s (once)", path)
        child = subprocess.run([sys.executable, *words], capture_output=True, text=True)
        if child.returncode:
            raise UserError(
                f"scene {path}: {words[0]} failed ({_first_line(child.stderr.strip().rpartition(chr(10))[2])})"
            )
    if not path.is_file():
        raise UserError(f"scene {path}: no such file: name a Mitsuba 3 .xml or a mesh file in scene.file")
    check_input(path)


def content_hash(path: Path, options: SceneOptions = AS_IT_IS) -> str:
    """SHA-256 over the scene file, every file that it includes or names (meshes, textures), and the options.

    Raises UserError if one is missing, unless they say to leave it out, or the scene file is malformed.
    """
    ensure_built(path)
    digest = hashlib.sha256(path.read_bytes())
    if path.suffix.lower() != ".xml":
        try:
            scene_reader(path.suffix).hash_into(digest, path, options)
        except (AttributeError, KeyError, TypeError) as error:  # JSON of another shape than glTF's
            raise UserError(f"scene {path}: is malformed ({_first_line(error)}): export it again") from None
    else:
        mi = mitsuba()
        with tempfile.TemporaryDirectory(prefix="rsgen-scene-") as scratch, messages_to_log(mi), _faults_of(path):
            state, changes, _ = parse(mi, mi.parser.ParserConfig(mi.variant()), path, Path(scratch))
        if changes is not None:
            digest.update(xml_helper("older version").METHOD)
        if options != replace(AS_IT_IS, skip_missing=options.skip_missing):
            digest.update(f"\0{options.scale!r} {options.up}".encode())
        for included in state.files[1:] if changes is None else changes.files:
            digest.update(hashlib.sha256(Path(str(included)).read_bytes()).digest())
        names = {str(n.props["filename"]) for n in state.nodes if "filename" in n.props.keys()}  # noqa: SIM118
        for name in sorted(names):
            file = path.parent / name
            if not file.is_file():
                if not options.skip_missing:
                    raise UserError(missing_file(path, name))
                digest.update(name.encode() + b"\0missing")
                continue
            data = file.read_bytes()
            digest.update(name.encode() + b"\0" + hashlib.sha256(data).digest())
            if file.suffix.lower() == ".obj":
                digest.update(xml_helper("mesh files").triangles_mark(data))
    return digest.hexdigest()


@contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """Mitsuba and trimesh raise whatever their parsers do: UserErrors, naming the scene."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"scene {path}: {_first_line(error)}") from None


def _load_xml(
    mi: Any, path: Path, scratch: Path, board: Board | None, messages: list[str], options: SceneOptions
) -> Any:
    config = mi.parser.ParserConfig(mi.variant())
    # Merging orders meshes by memory address: emitters and shapes would be numbered anew in each process.
    config.merge_meshes = False
    shape = None if board is None else board_xml(board, scratch)
    state, changes, renamed = parse(mi, config, path, scratch, shape)
    log_renamed(path, renamed)
    resolver = mi.file_resolver()
    resolver.prepend(str(path.resolve().parent))
    try:
        with _threads_to_read_with():
            scene = _instantiated(mi, config, state, changes is not None, path, scratch, options)
    finally:
        del resolver[0]  # else the next scene would find what it lacks, an include say, in this one's folder
    if changes is not None:
        changes.dropped.update(unknown_properties(messages))
        log.log(logging.WARNING if changes.lossy else logging.DEBUG, "scene %s: %s", path, changes.summary())
    return scene


@contextmanager
def _threads_to_read_with() -> Iterator[None]:
    """Two threads at least: with one, as on a machine of one core, Mitsuba 3.9 waits for ever to read an EXR."""
    import drjit as dr

    before = dr.thread_count()
    if before < 2:
        dr.set_thread_count(2)
    try:
        yield
    finally:
        if before < 2:
            dr.set_thread_count(before)


def _instantiated(
    mi: Any, config: Any, state: Any, upgraded: bool, path: Path, scratch: Path, options: SceneOptions
) -> Any:
    prepare(mi, config, state, path)
    if options != AS_IT_IS:
        place(mi, state, path, options, BOARD_ID)
    for index, node in enumerate(state.nodes):
        if node.type != mi.ObjectType.Shape:
            continue
        plugin = node.props.plugin_name()
        if plugin in _UNSUPPORTED:
            raise UserError(f"scene {path}: shape '{plugin}' cannot become triangles: export it as a mesh (.ply, .obj)")
        if plugin in ANALYTIC:
            node.props = tessellated(mi, node.props, scratch / f"{index}.ply")
    check_files(mi, state, path, options.skip_missing)
    if any(node.type == mi.ObjectType.Shape and node.props.plugin_name() == "obj" for node in state.nodes):
        xml_helper("mesh files").read_polygons(mi, state, scratch)
    if upgraded:
        xml_helper("older version").multiply_images(mi, state)
    mi.parser.transform_all(config, state)
    untouched = mi.parser.ParserState(state)  # objects made of it, also by an attempt that fails, stay in the other
    try:
        scene = _made(mi, config, state, path)
    except UserError:
        if not xml_helper("mesh files").read_refused(mi, untouched, path, scratch):
            raise
        scene = _made(mi, config, untouched, path)
    scene = scene[0] if isinstance(scene, (list, tuple)) else scene
    place_lamps(mi, scene, options.scale)
    return turn_mirrored(mi, scene)


def _made(mi: Any, config: Any, state: Any, path: Path) -> Any:
    try:
        return mi.parser.instantiate(config, state)
    except Exception as error:  # of whatever kind Mitsuba's plugins raise
        raise UserError(f"scene {path}: {explained(mi, state, str(error))}") from None


def _first_line(error: object) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 300 else text[:297] + "..."


BOARD_ID = "rsgen_target"  # of its shape in a scene
_TAG_PX = 100  # ten cells of a tag; a hundredth of a tag is one pixel
_CELLS, _BORDER_CELLS = 10, 2
_WHITE, _BLACK = 217, 13  # reflectances of paper and toner, of 255


@dataclass(frozen=True)
class Board:
    """A calibration board of Kalibr's and where it is: T_world_target (4, 4).

    Drawn as `kalibr_create_target_pdf` does: tags 36h11 with a black border of two cells, and black squares in the
    corners between them.
    """

    grid: AprilGrid
    T_world_target: FloatArray


def board_surface(board: Board) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Corners (4, 3) in the world, m, two triangles (2, 3), normals (4, 3), and texture coordinates (4, 2)."""
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    p_target = np.column_stack([unit * board.grid.size_m, np.zeros(4)]) + board.grid.lower_left
    uv = unit * [1.0, -1.0] + [0.0, 1.0]  # textures are read from the upper row on
    normals = np.tile(board.T_world_target[:3, 2], (4, 1))
    return se3.transform(board.T_world_target, p_target), np.array([[0, 1, 2], [0, 2, 3]]), normals, uv


def board_drawing(grid: AprilGrid) -> ByteArray:
    """The whole board (h, w), upper row first, a pixel a hundredth of a tag: reflectances of 255."""
    gap = round(grid.spacing * _TAG_PX)
    width, height = (count * _TAG_PX + (count + 3) * gap for count in (grid.columns, grid.rows))
    image = np.full((height, width), _WHITE, np.uint8)
    step = _TAG_PX + gap
    for row in range(grid.rows + 1):
        for column in range(grid.columns + 1):
            below, left = gap + row * step, gap + column * step  # of the black square
            image[height - below - gap : height - below, left : left + gap] = _BLACK
            if row < grid.rows and column < grid.columns:
                below, left = below + gap, left + gap
                image[height - below - _TAG_PX : height - below, left : left + _TAG_PX] = _tag(
                    row * grid.columns + column
                )
    return image


def _tag(number: int) -> ByteArray:
    """A tag (_TAG_PX, _TAG_PX), upright: its code row by row from the upper left, highest bit first, 1 is white."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    # OpenCV draws this family upside down.
    cells = np.rot90(cv2.aruco.generateImageMarker(family, number, _CELLS, borderBits=_BORDER_CELLS), 2)
    scale = _TAG_PX // _CELLS
    return np.where(cells > 0, _WHITE, _BLACK).astype(np.uint8).repeat(scale, axis=0).repeat(scale, axis=1)


def board_xml(board: Board, folder: Path) -> str:
    """A Mitsuba <shape> of the board, matte, its back grey; its files go into `folder`."""
    (folder / "board.ply").write_bytes(ply_bytes(*board_surface(board)))
    (folder / "board.png").write_bytes(encode_png(np.repeat(board_drawing(board.grid)[..., None], 3, axis=2)))
    return f"""\
<shape version="3.0.0" type="ply" id="{BOARD_ID}">
  <string name="filename" value="{folder / "board.ply"}"/>
  <bsdf type="twosided">
    <bsdf type="diffuse">
      <texture type="bitmap" name="reflectance">
        <string name="filename" value="{folder / "board.png"}"/>
        <string name="filter_type" value="nearest"/>
        <boolean name="raw" value="true"/>
      </texture>
    </bsdf>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf>
  </bsdf>
</shape>
"""
