"""Sequence folders: read one, strictly.

sequence = read_sequence(Path("out/lr_kt2"))
z, rows = sequence.depth(0), sequence.rows("depth")[0]     # metres (h, w); T_world_depth of each line (h, 7)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array, FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import listed_file, read_text
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import read_exr, read_npy, read_png
from rsgen.limits import rigid
from rsgen.sequence.camera_yaml import read_true_cameras
from rsgen.sequence.format import (
    DEPTH_OBJECT_IDS,
    FRAME_TABLES,
    LISTINGS,
    OBJECT_CHANNELS,
    OBJECT_IDS,
    ROWS,
    STAMP_TOLERANCE_S,
    TRUTH_DEPTH,
    Line,
    StreamName,
    StreamYaml,
    color_truth_path,
    parse_listing,
    poses_of_rows,
    read_sequence_yaml,
)
from rsgen.sequence.truth_files import FrameTable, SequenceObject, read_frame_table, read_objects

_LONGEST_S = 1e6  # as long as stamps may grow


@dataclass(frozen=True)
class ImageStream:
    """One camera's images: n of them are on disk, of `frames` in the whole sequence.

    stamps (n,) s, true ones; listed (n,): those of the listing, which a driver may have made; paths n files; indices
    (n,) frame numbers in the whole sequence (the files' names). depth_scale: stored units per metre; 0 in the colour
    stream. registered: the images were warped into the colour camera; camera and shutter are those of the sensor that
    they were warped from. table: what was true of each image, where listing, clock and shutter do not tell it.
    """

    name: StreamName
    camera: Camera
    shutter: Shutter
    rate_hz: float
    offset_s: float
    depth_scale: float
    frames: int
    first_stamp_s: float
    stamps: FloatArray
    listed: FloatArray
    paths: tuple[Path, ...]
    indices: IntArray
    registered: bool = False
    table: FrameTable | None = None

    @property
    def line_count(self) -> int:
        """Lines that are read out one after the other: image rows, or columns if it scans sideways."""
        return self.shutter.line_count(self.camera)


@dataclass(frozen=True)
class Sequence:
    """A sequence on disk. T_color_depth (4, 4); `spline` is T_world_depth(t); `meta` is sequence.yaml as it is.

    Cameras are as sequence.yaml declares them; where that is wrong on purpose, `as_taken` has the true ones.
    Frames are counted as listed: k-th line of rgb.txt or depth.txt. Every reading method raises UserError naming the
    file if it is missing, damaged or of another size than in sequence.yaml.
    """

    root: Path
    name: str
    streams: dict[StreamName, ImageStream]
    T_color_depth: FloatArray
    spline: Spline
    meta: dict[str, Any]
    objects: tuple[SequenceObject, ...] = ()  # that move by themselves

    @property
    def depth_image_camera(self) -> Camera:
        """The camera of the images in depth/: the colour camera where they are registered, else the depth sensor."""
        return self.streams["color" if self.streams["depth"].registered else "depth"].camera

    @property
    def T_image_depth(self) -> FloatArray:
        """(4, 4) from the depth sensor's coordinates to those of the camera of the images in depth/."""
        return self.T_color_depth if self.streams["depth"].registered else np.eye(4)

    @cached_property
    def as_taken(self) -> Sequence:
        """The sequence with the cameras that took it: itself, unless others are declared. Raises UserError."""
        if not self.meta.get("declared"):
            return self
        true = read_true_cameras(self.root)
        streams: dict[StreamName, ImageStream] = {
            "color": replace(self.streams["color"], camera=true.color, shutter=true.color_shutter),
            "depth": replace(
                self.streams["depth"], camera=true.depth, shutter=true.depth_shutter, depth_scale=true.depth_scale
            ),
        }
        return replace(self, streams=streams, T_color_depth=true.T_color_depth, meta=self.meta | {"declared": False})

    @cached_property
    def _rows(self) -> dict[StreamName, FloatArray]:
        return {}

    def color(self, k: int) -> ByteArray:
        """Colour image k, sRGB (h, w, 3)."""
        camera = self.streams["color"].camera
        return read_png(self.streams["color"].paths[k], (camera.height, camera.width, 3), np.uint8)

    def depth_units(self, k: int) -> npt.NDArray[np.uint16]:
        """Depth image k as stored (h, w), 0 where nothing was measured."""
        camera = self.depth_image_camera
        return read_png(self.streams["depth"].paths[k], (camera.height, camera.width), np.uint16)

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in metres that the sensor reports, 0 where nothing was measured."""
        return np.asarray(self.depth_units(k) / np.float32(self.streams["depth"].depth_scale), np.float32)

    def truth_depth(self, k: int) -> Float32Array:
        """Exact planar z (h, w) in metres, noise-free, with the same rolling shutter; 0 where there is none."""
        camera = self.streams["depth"].camera
        z = read_exr(self.truth_depth_path(k), (camera.height, camera.width))
        if not (np.isfinite(z).all() and (z >= 0).all()):
            raise UserError(f"{self.truth_depth_path(k)}: holds negative or non-finite depths: render it again")
        return z

    def truth_depth_path(self, k: int) -> Path:
        """File of `truth_depth(k)`."""
        return self.root / TRUTH_DEPTH / self.streams["depth"].paths[k].with_suffix(".exr").name

    @property
    def truth_images(self) -> dict[str, tuple[str, ...]]:
        """Names of the exact images beside every colour frame, each with its EXR channels (none: 8-bit sRGB)."""
        return {name: tuple(channels) for name, channels in (self.meta.get("truth") or {}).items()}

    def truth(self, name: str, k: int) -> npt.NDArray[Any]:
        """Exact image `name` of colour frame k: uint8 RGB (h, w, 3), or float32 (h, w) or (h, w, n) for n EXR channels.

        Raises UserError if the sequence has none of that name, or the file is missing or damaged.
        """
        images, stream = self.truth_images, self.streams["color"]
        if name not in images:
            has = ", ".join(sorted(images)) or "none"
            raise UserError(f"{self.root}: has no truth images '{name}' (has: {has}): render with truth.* set")
        shape = stream.camera.height, stream.camera.width
        path = self.root / color_truth_path(name, images[name], stream.paths[k].stem)
        return read_exr(path, shape, images[name]) if images[name] else read_png(path, (*shape, 3), np.uint8)

    def object_ids(self, stream: StreamName, k: int) -> npt.NDArray[np.uint8]:
        """Which of `objects` each pixel (h, w) of exact image k shows: 0 none, else its number."""
        s = self.streams[stream]
        if not self.objects:
            return np.zeros((s.camera.height, s.camera.width), np.uint8)
        folder = DEPTH_OBJECT_IDS if stream == "depth" else f"truth/{OBJECT_IDS}"
        path = self.root / folder / s.paths[k].with_suffix(".exr").name
        ids = read_exr(path, (s.camera.height, s.camera.width), OBJECT_CHANNELS)
        if not np.isin(ids, np.arange(len(self.objects) + 1)).all():
            raise UserError(f"{path}: names objects that there are not: render it again")
        return ids.astype(np.uint8)

    def rows(self, stream: StreamName) -> FloatArray:
        """Poses (n, lines, 7) tx ty tz qx qy qz qw of each line's camera in the world at mid-exposure.

        Line i is image row i, or column i for the sideways scans, whatever the order of readout.
        """
        if stream not in self._rows:
            s = self.streams[stream]
            self._rows[stream] = read_npy(self.root / ROWS[stream], (s.frames, s.line_count, 7))[s.indices]
        return self._rows[stream]

    def pixel_poses(self, stream: StreamName, k: int, uv: npt.ArrayLike) -> FloatArray:
        """Exact poses T_world_cam (..., 4, 4) with which image k was taken at pixels uv (..., 2): their lines'."""
        line = np.rint(np.asarray(uv)[..., self.streams[stream].shutter.axis]).astype(np.int64)
        return poses_of_rows(self.rows(stream)[k])[line]


def read_sequence(path: Path) -> Sequence:
    """Read the description, listings and spline of a sequence folder; images are read when asked for.

    Raises UserError, one line, if the folder or one of its files is missing or damaged, of another format version, if a
    listing is malformed (naming the line), its stamps do not increase, or one of its paths leaves the folder.
    """
    root = Path(path)
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; expected a sequence that 'rsgen render' wrote")
    if not (root / "sequence.yaml").exists():
        raise UserError(f"{root}: has no sequence.yaml, so it is not a sequence that 'rsgen render' wrote")
    description, meta = read_sequence_yaml(root / "sequence.yaml")
    try:
        T_color_depth = rigid(description.T_color_depth)
    except ValueError as error:
        raise UserError(f"{root / 'sequence.yaml'}: T_color_depth: {error}") from None
    if description.streams.depth.depth_scale is None:
        raise UserError(f"{root / 'sequence.yaml'}: streams.depth.depth_scale is missing")
    streams: dict[StreamName, ImageStream] = {
        "color": _read_stream(root, "color", description.streams.color),
        "depth": _read_stream(root, "depth", description.streams.depth),
    }
    spline = _read_spline(root / "spline.npz", streams)
    span = (f(s.stamps[k] for s in streams.values()) for f, k in ((min, 0), (max, -1)))
    objects = read_objects(root, description.objects, *map(float, span)) if description.objects else ()
    return Sequence(root, description.name, streams, T_color_depth, spline, meta, objects)


def _read_spline(path: Path, streams: dict[StreamName, ImageStream]) -> Spline:
    """The spline, which has to cover the frames and not much more: a huge knot spacing would take all memory."""
    spline = Spline.load(path)
    first = min(stream.stamps[0] for stream in streams.values())
    last = max(stream.stamps[-1] for stream in streams.values())
    if not (spline.t_begin - STAMP_TOLERANCE_S <= first and last <= spline.t_end + STAMP_TOLERANCE_S):
        raise UserError(
            f"{path}: covers {spline.t_begin:g} to {spline.t_end:g} s, the frames {first:g} to {last:g} s: "
            "restore it or render again"
        )
    if not spline.t_end - spline.t_begin <= _LONGEST_S:
        raise UserError(f"{path}: lasts {spline.t_end - spline.t_begin:g} s, absurdly long: restore it or render again")
    return spline


def _read_stream(root: Path, name: StreamName, yaml: StreamYaml) -> ImageStream:
    listing = root / LISTINGS[name]
    lines = parse_listing(listing, read_text(listing))
    if not lines:
        raise UserError(f"{listing}: lists no frame: run 'rsgen render' again to finish it")
    real_root = root.resolve()
    missing = "run the same 'rsgen render' again"
    paths = tuple(listed_file(root, real_root, line.path, f"{listing} line {line.number}", missing) for line in lines)
    indices = np.array([_frame_number(listing, line, yaml) for line in lines], np.int64)
    listed = np.array([line.stamp for line in lines])
    table = _table_of(root, name, indices) if yaml.frame_table else None
    with np.errstate(over="ignore"):  # of an absurd rate, which fits no stamp
        expected = yaml.first_stamp_s + indices / yaml.rate_hz if table is None else table.listed_s
    for k in np.flatnonzero(np.abs(listed - expected) > STAMP_TOLERANCE_S)[:1]:
        raise UserError(
            f"{listing} line {lines[k].number}: stamp {listed[k]:.9f} is not that of frame {indices[k]}, "
            f"{expected[k]:.9f}"
        )
    stamps = listed if table is None else table.taken_s
    try:
        camera, shutter = yaml.camera, yaml.shutter
    except UserError as error:
        raise UserError(f"{root / 'sequence.yaml'}: streams.{name}: {error}") from None
    scale = yaml.depth_scale if name == "depth" and yaml.depth_scale is not None else 0.0
    clock = (yaml.rate_hz, yaml.offset_s, scale, yaml.frames, yaml.first_stamp_s)
    return ImageStream(name, camera, shutter, *clock, stamps, listed, paths, indices, yaml.registered, table)


def _table_of(root: Path, name: StreamName, indices: IntArray) -> FrameTable:
    """The frame table's lines of these frames. Raises UserError."""
    table = read_frame_table(root, name)
    if absent := sorted(set(indices.tolist()) - set(table.frame.tolist())):
        raise UserError(f"{root / FRAME_TABLES[name]}: has no frame {absent[0]}: render again to write it")
    return table.of(indices)


def _frame_number(listing: Path, line: Line, yaml: StreamYaml) -> int:
    """Frame number of a listed file, from its name."""
    where, stem = f"{listing} line {line.number}", Path(line.path).stem
    if not (stem.isascii() and stem.isdigit() and len(stem) <= 9 and int(stem) < yaml.frames):
        raise UserError(f"{where}: {line.path!r} is not one of the sequence's {yaml.frames} frames")
    return int(stem)
