"""A calibration board of Kalibr's as a surface: what is printed on it, and where its triangles are.

Drawn as `kalibr_create_target_pdf` does: tags 36h11 with a black border of two cells, and black squares in the corners
between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rsgen.array_types import ByteArray, FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.image_codecs import encode_png
from rsgen.scene.meshes import ply_bytes

BOARD_ID = "rsgen_target"  # of its shape in a scene
_TAG_PX = 100  # ten cells of a tag; a hundredth of a tag is one pixel
_CELLS, _BORDER_CELLS = 10, 2
_WHITE, _BLACK = 217, 13  # reflectances of paper and toner, of 255


@dataclass(frozen=True)
class Board:
    """A target and where it is: T_world_target (4, 4)."""

    grid: AprilGrid
    T_world_target: FloatArray


def surface(board: Board) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Corners (4, 3) in the world, m, two triangles (2, 3), normals (4, 3), and texture coordinates (4, 2)."""
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    p_target = np.column_stack([unit * board.grid.size_m, np.zeros(4)]) + board.grid.lower_left
    uv = unit * [1.0, -1.0] + [0.0, 1.0]  # textures are read from the upper row on
    normals = np.tile(board.T_world_target[:3, 2], (4, 1))
    return se3.transform(board.T_world_target, p_target), np.array([[0, 1, 2], [0, 2, 3]]), normals, uv


def drawing(grid: AprilGrid) -> ByteArray:
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
    (folder / "board.ply").write_bytes(ply_bytes(*surface(board)))
    (folder / "board.png").write_bytes(encode_png(np.repeat(drawing(board.grid)[..., None], 3, axis=2)))
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
