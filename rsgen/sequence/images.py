"""A sequence's images and poses, as a reader has them: of a rig of any cameras, or of colour and depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array, FloatArray, IntArray, UInt16Array
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import read_exr, read_npy, read_png
from rsgen.sequence.camera_yaml import read_true_cameras
from rsgen.sequence.format import IMAGE_KINDS, OBJECT_CHANNELS, StreamFiles, StreamKind, poses_of_rows
from rsgen.sequence.truth_files import LABELS, FrameTable, Label, SequenceObject, read_labels

COLOR_DEPTH = "color_depth"
"""Exact image of a colour camera: planar z, m."""


@dataclass(frozen=True)
class ImageStream:
    """One camera's images: n of them are on disk, of `frames` in the whole sequence.

    stamps (n,) s, true ones; listed (n,): those of the listing, which a driver may have made; paths n files; indices
    (n,) frame numbers in the whole sequence (the files' names). depth_scale: stored units per metre; 0 of colour.
    registered: the images were warped into the colour camera; camera and shutter are those of the sensor that they were
    warped from. table: what was true of each image, where listing, clock and shutter do not tell it. T_cam_body (4, 4):
    of the sequence's body, of two cameras depth. truth_images: names of its exact images, each with its EXR channels
    (none: 8-bit).
    """

    name: str
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
    registered: bool
    table: FrameTable | None
    kind: StreamKind
    files: StreamFiles
    T_cam_body: FloatArray
    truth_images: dict[str, tuple[str, ...]]

    @property
    def line_count(self) -> int:
        """Lines that are read out one after the other: image rows, or columns if it scans sideways."""
        return self.shutter.line_count(self.camera)

    @property
    def is_depth(self) -> bool:
        """Whether it measures depth."""
        return self.kind == "depth"


@dataclass(frozen=True)
class Rig:
    """A sequence on disk. `spline` is T_world_body(t); `meta` is sequence.yaml as it is; `objects` move by themselves.

    Frames are counted as listed: k-th line of the stream's listing. Every reading method raises UserError naming the
    file if it is missing, damaged or of another size than in sequence.yaml.
    """

    root: Path
    name: str
    streams: dict[str, ImageStream]
    spline: Spline
    meta: dict[str, Any]
    objects: tuple[SequenceObject, ...]

    @cached_property
    def _rows(self) -> dict[str, FloatArray]:
        return {}

    def picture(self, stream: str, k: int) -> ByteArray:
        """Image k of a colour camera, sRGB (h, w, 3), or of a grey one (h, w)."""
        s = self.streams[stream]
        shape = (s.camera.height, s.camera.width)
        return read_png(s.paths[k], (*shape, 3) if s.kind == "color" else shape, np.uint8)

    def image_camera(self, stream: str) -> Camera:
        """The camera of a stream's images: the colour camera where depth is registered, else its own."""
        return self.streams["color" if self.streams[stream].registered else stream].camera

    def units(self, stream: str, k: int) -> npt.NDArray[np.uint16]:
        """Depth image k of a stream as stored (h, w), 0 where nothing was measured."""
        camera = self.image_camera(stream)
        return read_png(self.streams[stream].paths[k], (camera.height, camera.width), np.uint16)

    def exact_depth(self, stream: str, k: int) -> Float32Array:
        """Exact planar z (h, w) in metres that a depth camera has before its errors; 0 where there is none."""
        s = self.streams[stream]
        path = self.root / s.files.exact_depth / s.paths[k].with_suffix(".exr").name
        z = read_exr(path, (s.camera.height, s.camera.width))
        if not (np.isfinite(z).all() and (z >= 0).all()):
            raise UserError(f"{path}: holds negative or non-finite depths: render it again")
        return z

    def exact_image(self, stream: str, name: str, k: int) -> npt.NDArray[Any]:
        """Exact image `name` of frame k: uint8, of shape as `picture`, or float32 (h, w) or (h, w, n) for n channels.

        Raises UserError if the stream has none of that name, or the file is missing or damaged.
        """
        s = self.streams[stream]
        if name not in s.truth_images:
            has = ", ".join(sorted(s.truth_images)) or "none"
            raise UserError(f"{self.root}: has no truth images '{name}' (has: {has}): render with truth.* set")
        shape = s.camera.height, s.camera.width
        path = self.root / s.files.truth_image(name, s.truth_images[name], s.paths[k].stem)
        if s.truth_images[name]:
            return read_exr(path, shape, s.truth_images[name])
        return read_png(path, (*shape, 3) if s.kind == "color" else shape, np.uint8)

    def object_ids(self, stream: str, k: int) -> npt.NDArray[np.uint8]:
        """Which of `objects` each pixel (h, w) of exact image k shows: 0 none, else its number."""
        s = self.streams[stream]
        if not self.objects:
            return np.zeros((s.camera.height, s.camera.width), np.uint8)
        path = self.root / s.files.object_ids / s.paths[k].with_suffix(".exr").name
        ids = read_exr(path, (s.camera.height, s.camera.width), OBJECT_CHANNELS)
        if not np.isin(ids, np.arange(len(self.objects) + 1)).all():
            raise UserError(f"{path}: names objects that there are not: render it again")
        return ids.astype(np.uint8)

    @cached_property
    def label_table(self) -> tuple[Label, ...]:
        """What labels stand for, in the order of their ids; empty where there are none."""
        return read_labels(self.root / LABELS) if (self.root / LABELS).is_file() else ()

    def labels(self, stream: str, k: int) -> UInt16Array:
        """Number of the thing that each pixel (h, w) of exact image k shows, 0 none; see `label_table`."""
        s = self.streams[stream]
        path = self.root / s.files.labels / s.paths[k].name
        if not self.label_table:
            raise UserError(f"{self.root}: has no labels: render with truth.labels set")
        labels: UInt16Array = read_png(path, (s.camera.height, s.camera.width), np.uint16)
        if labels.max(initial=0) > len(self.label_table):
            raise UserError(f"{path}: names things that there are not: render it again")
        return labels

    def rows(self, stream: str) -> FloatArray:
        """Poses (n, lines, 7) tx ty tz qx qy qz qw of each line's camera in the world at mid-exposure.

        Line i is image row i, or column i for the sideways scans, whatever the order of readout.
        """
        if stream not in self._rows:
            s = self.streams[stream]
            self._rows[stream] = read_npy(self.root / s.files.rows, (s.frames, s.line_count, 7))[s.indices]
        return self._rows[stream]

    def pixel_poses(self, stream: str, k: int, uv: npt.ArrayLike) -> FloatArray:
        """Exact poses T_world_cam (..., 4, 4) with which image k was taken at pixels uv (..., 2): their lines'."""
        line = np.rint(np.asarray(uv)[..., self.streams[stream].shutter.axis]).astype(np.int64)
        return poses_of_rows(self.rows(stream)[k])[line]

    @cached_property
    def as_taken(self) -> Rig:
        """The same with the cameras that took it: only those of a `Sequence` may be declared otherwise."""
        return self

    def seen_from(self, camera: str) -> Rig:
        """The same with a camera as the body: spline and poses are of it. Itself, if it is the body."""
        T_body_cam = se3.inverse(self.streams[camera].T_cam_body)
        if (T_body_cam == np.eye(4)).all():
            return self
        streams = {name: replace(s, T_cam_body=s.T_cam_body @ T_body_cam) for name, s in self.streams.items()}
        streams[camera] = replace(streams[camera], T_cam_body=np.eye(4))
        # T(t) X = T_0 X prod exp(B_k Ad(X^-1) Omega_k): a constant from the right moves control points alone.
        spline = Spline(self.spline.control_points @ T_body_cam, self.spline.t0, self.spline.dt)
        return replace(self, streams=streams, spline=spline)

    def pair(self, color: str | None = None, depth: str | None = None) -> Sequence:
        """A colour (or grey) and a depth camera as a sequence of these two, whose body is the depth camera.

        By default the first of either kind. Raises UserError if there is none of that name or kind.
        """
        c, d = self._named("colour", color, is_depth=False), self._named("depth", depth, is_depth=True)
        seen = self.seen_from(d)
        streams = {"color": replace(seen.streams[c], name="color"), "depth": replace(seen.streams[d], name="depth")}
        T_color_depth = streams["color"].T_cam_body
        meta = _meta_of_pair(self.meta, c, d, se3.inverse(self.streams[d].T_cam_body))
        return Sequence(self.root, self.name, streams, seen.spline, meta, self.objects, T_color_depth)

    def _named(self, what: str, name: str | None, is_depth: bool) -> str:
        kinds = ("depth",) if is_depth else IMAGE_KINDS
        of_kind = [s.name for kind in kinds for s in self.streams.values() if s.kind == kind]
        if not of_kind:
            raise UserError(f"{self.root}: has no {what} camera, only {', '.join(self.streams)}: this takes both kinds")
        if name is not None and name not in of_kind:
            raise UserError(f"{self.root}: has no {what} camera {name!r}: choose one of {', '.join(of_kind)}")
        return name or of_kind[0]


def _meta_of_pair(meta: dict[str, Any], color: str, depth: str, T_body_depth: FloatArray) -> dict[str, Any]:
    """A rig's sequence.yaml as far as it concerns two of its cameras, as if it were of format 1."""
    names = {"color": color, "depth": depth}
    config = dict(meta.get("config") or {})
    cameras = config.pop("streams", None) or {}
    config |= {name: cameras.get(own, {}) for name, own in names.items()}
    if isinstance(imu := config.get("imu"), dict):
        T_imu_body = np.asarray(imu.get("T_imu_depth", np.eye(4)), float)
        config["imu"] = imu | {"T_imu_depth": (T_imu_body @ T_body_depth).tolist()}
    noise = meta.get("noise") or {}
    models = {name: noise.get(own, "none") for name, own in names.items()}
    return meta | {"config": config, "noise": models if set(models.values()) != {"none"} else None}


@dataclass(frozen=True)
class Sequence(Rig):
    """One colour and one depth camera, "color" and "depth"; `spline` is T_world_depth(t). T_color_depth (4, 4).

    Cameras are as sequence.yaml declares them; where that is wrong on purpose, `as_taken` has the true ones.
    """

    T_color_depth: FloatArray

    @property
    def depth_image_camera(self) -> Camera:
        """The camera of the images in depth/: the colour camera where they are registered, else the depth sensor."""
        return self.image_camera("depth")

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
        T = true.T_color_depth
        color = replace(self.streams["color"], camera=true.color, shutter=true.color_shutter, T_cam_body=T)
        depth = replace(
            self.streams["depth"], camera=true.depth, shutter=true.depth_shutter, depth_scale=true.depth_scale
        )
        streams = {"color": color, "depth": depth}
        return replace(self, streams=streams, T_color_depth=T, meta=self.meta | {"declared": False})

    def color(self, k: int) -> ByteArray:
        """Colour image k, sRGB (h, w, 3); of a grey camera three times the same."""
        image = self.picture("color", k)
        return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)

    def depth_units(self, k: int) -> npt.NDArray[np.uint16]:
        """Depth image k as stored (h, w), 0 where nothing was measured."""
        return self.units("depth", k)

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in metres that the sensor reports, 0 where nothing was measured."""
        return np.asarray(self.depth_units(k) / np.float32(self.streams["depth"].depth_scale), np.float32)

    def truth_depth(self, k: int) -> Float32Array:
        """Exact planar z (h, w) in metres, noise-free, with the same rolling shutter; 0 where there is none."""
        return self.exact_depth("depth", k)

    @property
    def truth_images(self) -> dict[str, tuple[str, ...]]:
        """Names of the exact images beside every colour frame, each with its EXR channels (none: 8-bit sRGB)."""
        return self.streams["color"].truth_images

    def truth(self, name: str, k: int) -> npt.NDArray[Any]:
        """Exact image `name` of colour frame k: uint8 RGB (h, w, 3), or float32 (h, w) or (h, w, n) for n EXR channels.

        Raises UserError if the sequence has none of that name, or the file is missing or damaged.
        """
        return self.exact_image("color", name, k)
