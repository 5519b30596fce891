"""Write a sequence folder frame by frame, so that a run killed at any moment is resumed to the same bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array, FloatArray, UInt16Array
from rsgen.config.cameras import DepthConfig
from rsgen.config.config import Config
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, remove_stale_temporaries, write_error, write_lines
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_exr, encode_npy, encode_npz, encode_png, read_png
from rsgen.produce.records import (
    ListedStream,
    describe,
    refuse_foreign_folder,
    write_ground_truth,
    write_imu,
    write_listings,
)
from rsgen.sensors.color import Setting
from rsgen.sensors.imu import sample_clock
from rsgen.sensors.reports import color_clock
from rsgen.sequence.camera_yaml import TRUE_CAMERAS, Cameras, camera_yaml
from rsgen.sequence.format import (
    LABELS_IMAGE,
    OBJECT_CHANNELS,
    OBJECTS,
    frame_name,
    ground_truth,
    line_poses,
    pose_lines,
)
from rsgen.sequence.truth_files import TARGET_CORNERS, boxes_text, poses_file, spline_file, target_corners_text

_SPLINE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class SequenceWriter:
    """An open sequence folder; make one with `open`.

    Render from `spline` and `stamps`, not from what was handed to `open`: when a run is resumed, `spline` is the one on
    disk, which may differ from a new fit in its last bits. settings: of each automatic camera, see `adapted`.
    """

    out: Path
    config: Config
    spline: Spline
    streams: Mapping[str, ListedStream]
    settings: Mapping[str, tuple[Setting, ...]] = field(default_factory=dict)
    objects: tuple[Spline, ...] = ()

    @classmethod
    def open(
        cls,
        out: Path,
        config: Config,
        spline: Spline,
        stamps: Mapping[str, npt.ArrayLike],
        versions: Mapping[str, str],
        inputs: Mapping[str, str],
        objects: Sequence[Spline] = (),
    ) -> SequenceWriter:
        """Create `out`, or resume what an equal call began there.

        stamps: of each camera those (n,) in seconds of all frames of the sequence, as `stream_stamps` returns them.
        `inputs` are content hashes of the trajectory and scene files; `versions` those of every program that decides
        the bytes. objects: T_world_object(t) of the config's. sequence.yaml and splines are written here.

        Raises UserError if the folder holds another sequence or other files, or cannot be written, if a line of a frame
        is read outside the spline's time, or if the IMU's samples are absurdly many; then nothing in it has been
        changed.
        """
        out = Path(out)
        streams = {name: ListedStream.of(config, name, stamps[name]) for name in config.cameras}
        for stream in streams.values():
            line_poses(spline, stream.config.camera, stream.config.shutter, stream.stamps[[0, -1]])
        if config.imu is not None:
            sample_clock(config.imu, spline.t_begin, spline.t_end)
        text = describe(config, spline, {name: s.stamps for name, s in streams.items()}, versions, inputs)
        refuse_foreign_folder(out, text)
        try:
            out.mkdir(parents=True, exist_ok=True)
            # First of all, so that a run that ends here leaves either nothing or what it can be resumed from.
            if not (out / "sequence.yaml").exists():
                atomic_write(out / "sequence.yaml", encode_yaml(text))
            opened = cls(out, config, spline, streams, objects=tuple(objects))
            for folder in ("", "truth", *opened.make_folders()):
                remove_stale_temporaries(out / folder)
        except OSError as error:
            raise write_error(out, error) from None
        moving = zip(config.objects, objects, strict=True)
        things = tuple(_stored_spline(out / spline_file(thing.name), s) for thing, s in moving)
        return replace(opened, spline=_stored_spline(out / "spline.npz", spline), objects=things)

    def make_folders(self) -> list[str]:
        """Make those of images and splines; returns where they are within `out`. Raises OSError."""
        folders = [OBJECTS] if self.objects else []
        for stream in self.streams.values():
            files = stream.files
            folders += [files.images, files.truth, *(f"{files.truth}/{name}" for name in stream.truth)]
            if isinstance(stream.config, DepthConfig):
                folders += [files.exact_depth, *([files.object_ids] if self.objects else [])]
            folders += [files.labels] if self.config.truth.labels else []
        for folder in folders:
            (self.out / folder).mkdir(parents=True, exist_ok=True)
        return folders

    def stamps(self, stream: str) -> FloatArray:
        """True stamps (n,) of all frames of a stream, s."""
        return self.streams[stream].stamps

    def shows(self, stream: str, k: int) -> int:
        """The frame that image k shows: k, unless a driver delivered an earlier one again."""
        return int(self.streams[stream].table.shows[k])

    def next_shown(self, stream: str, k: int) -> int | None:
        """The frame that the image listed after image k shows; None after the last one."""
        later = np.flatnonzero(self.streams[stream].is_delivered[k + 1 :])
        return self.shows(stream, k + 1 + int(later[0])) if len(later) else None

    def setting(self, stream: str, k: int) -> Setting | None:
        """How an automatic camera takes frame k; None where nothing is automatic."""
        return self.settings[stream][k] if stream in self.settings else None

    def adapted(self, stream: str, settings: Sequence[Setting]) -> SequenceWriter:
        """The same with an automatic camera's settings of all frames of its clock."""
        listed = self.streams[stream]
        shown = [settings[k] for k in listed.table.shows]
        table = replace(
            listed.table,
            exposure_s=np.array([s.exposure_s for s in shown]),
            gain=np.array([s.gain for s in shown]),
            brightness=np.array([s.brightness for s in shown]),
            balance=np.array([s.balance for s in shown]),
        )
        streams = {**self.streams, stream: replace(listed, table=table)}
        return replace(self, streams=streams, settings={**self.settings, stream: tuple(settings)})

    def missing(self, stream: str) -> list[int]:
        """Indices of the frames that are delivered and not on disk yet."""
        delivered = np.flatnonzero(self.streams[stream].is_delivered).tolist()
        return [k for k in delivered if not self._is_written(stream, k)]

    def write_color(
        self, k: int, rgb: ByteArray, truth: Mapping[str, npt.NDArray[Any]] = MappingProxyType({}),
        stream: str = "color",
    ) -> None:  # fmt: skip
        """Write frame k of a colour or grey camera, sRGB (h, w, 3) uint8, its images of `image_truth`, and labels.

        These are uint16 (h, w), the others uint8 (h, w, 3), or float32 (h, w) or (h, w, n) with n EXR channels. Of a
        grey camera the first of the three channels is kept. Raises UserError if the disk refuses one.
        """
        listed = self.streams[stream]
        shape = listed.config.camera.height, listed.config.camera.width
        wanted = listed.truth.keys() | ({LABELS_IMAGE} if self.config.truth.labels else set())
        if truth.keys() != wanted:
            raise ValueError(f"truth of a colour frame is {sorted(wanted)}, not {sorted(truth)}")
        self._write_labels(stream, k, truth.get(LABELS_IMAGE))
        for name, channels in listed.truth.items():
            image = truth[name]
            planes = () if len(channels) == 1 else (len(channels) or 3,)
            _expect(image, (*shape, *planes), np.float32 if channels else np.uint8)
            data = encode_exr(image, channels) if channels else encode_png(_kept(image, listed.is_grey))
            atomic_write(self.out / listed.files.truth_image(name, channels, frame_name(k)), data)
        _expect(rgb, (*shape, 3), np.uint8)
        atomic_write(self._path(stream, k), encode_png(_kept(rgb, listed.is_grey)))

    def write_depth(
        self, k: int, z: Float32Array, reported: Float32Array | None = None, ids: Float32Array | None = None,
        stream: str = "depth", labels: UInt16Array | None = None,
    ) -> None:  # fmt: skip
        """Write depth frame k, planar z (h, w) float32 in metres; 0, negative, inf and NaN mean nothing measured.

        The exact image gets z; the depth image what the camera reports (default: z; of the colour camera's size where
        depth is registered), rounded to 1/depth_scale m, 0 where that leaves 16 bits. ids (h, w): of the objects seen,
        where there are any; labels (h, w): where they are asked for. Raises UserError if the disk refuses it.
        """
        self._write_labels(stream, k, labels)
        if (ids is None) != (not self.objects):
            raise ValueError("ids of a depth frame are of a sequence with objects, and only there")
        listed = self.streams[stream]
        own = listed.config.camera
        if ids is not None:
            _expect(ids, (own.height, own.width), np.float32)
            atomic_write(self._file(listed.files.object_ids, k, ".exr"), encode_exr(ids, OBJECT_CHANNELS))
        _expect(z, (own.height, own.width), np.float32)
        camera = listed.image_camera
        _expect(z if reported is None else reported, (camera.height, camera.width), np.float32)
        atomic_write(self._file(listed.files.exact_depth, k, ".exr"), encode_exr(_positive(z)))
        assert isinstance(listed.config, DepthConfig)
        units = quantise(_positive(z if reported is None else reported), listed.config.depth_scale)
        atomic_write(self._path(stream, k), encode_png(units))

    def finish(self) -> None:
        """Write listings of the frames that are there, pairs, ground truth and rows' poses. May be called again.

        Raises UserError if the disk refuses them.
        """
        config, faults, out, spline = self.config, self.config.injected, self.out, self.spline
        is_registered = not config.streams and config.depth.registered
        T_image_depth = np.array(config.T_color_depth, float) if is_registered else None
        written = {s: [k for k in range(len(self.stamps(s))) if self._is_written(s, k)] for s in self.streams}
        write_listings(out, config.name, self.streams, written)
        stamps = {s: self.stamps(s) for s in self.streams}
        write_ground_truth(out, config, spline, stamps, T_image_depth)
        for thing, T_world_object in zip(config.objects, self.objects, strict=True):
            rows = ground_truth(T_world_object, *stamps.values())
            write_lines(out / poses_file(thing.name), pose_lines(f"T_world_object of {thing.name}", rows))
        for stream in self.streams.values():
            atomic_write(out / stream.files.rows, encode_npy(stream.line_poses(spline)))
            if stream.writes_table:
                table = stream.table.of(np.flatnonzero(stream.is_delivered))
                atomic_write(out / stream.files.frame_table, table.text().encode())
        if config.truth.labels:
            for name, stream in self.streams.items():
                camera = stream.config.camera
                shape = camera.height, camera.width
                frames = ((k, read_png(self._file(stream.files.labels, k), shape, np.uint16)) for k in written[name])
                atomic_write(out / stream.files.boxes, boxes_text(frames).encode())
        last = list(self.streams.values())[-1]  # of two cameras depth
        delivered = last.table.listed_s[last.is_delivered]
        middle = float(delivered[len(delivered) // 2])
        if faults.declared is not None:
            firsts = float(stamps["color"][0]), float(stamps["depth"][0])
            clock = color_clock(faults.color, faults.depth, *firsts, middle)
            cameras = Cameras.of(config.color, config.depth, config.T_color_depth)
            atomic_write(out / TRUE_CAMERAS, encode_yaml(camera_yaml(cameras, clock, config.depth.registered)))
        if (target := config.target) is not None:
            text = target_corners_text(target.grid, np.array(target.T_world_target, float))
            atomic_write(out / TARGET_CORNERS, text.encode())
        if config.imu is not None:
            write_imu(out, spline, config.imu, faults.imu, config.seed, middle, T_image_depth)

    def _write_labels(self, stream: str, k: int, labels: UInt16Array | None) -> None:
        if (labels is None) == self.config.truth.labels:
            raise ValueError("labels of a frame are of a sequence with truth.labels, and only there")
        if labels is not None:
            camera = self.streams[stream].config.camera
            _expect(labels, (camera.height, camera.width), np.uint16)
            atomic_write(self._file(self.streams[stream].files.labels, k), encode_png(labels))

    def _path(self, stream: str, k: int) -> Path:
        if not 0 <= k < len(self.stamps(stream)):
            raise IndexError(f"frame {k} of {len(self.stamps(stream))}")
        return self._file(self.streams[stream].files.images, k)

    def _file(self, folder: str, k: int, suffix: str = ".png") -> Path:
        return self.out / folder / f"{frame_name(k)}{suffix}"

    def _is_written(self, stream: str, k: int) -> bool:
        # Atomic writes leave whole files only, so being there is enough; an empty one was made by something else.
        listed = self.streams[stream]
        files, paths = listed.files, [self._path(stream, k)]
        if isinstance(listed.config, DepthConfig):
            paths += [self._file(files.exact_depth, k, ".exr")]
            paths += [self._file(files.object_ids, k, ".exr")] if self.objects else []
        else:
            paths += [self.out / files.truth_image(name, c, frame_name(k)) for name, c in listed.truth.items()]
        paths += [self._file(files.labels, k)] if self.config.truth.labels else []
        return all(path.is_file() and path.stat().st_size > 0 for path in paths)


def _kept(image: npt.NDArray[Any], is_grey: bool) -> npt.NDArray[Any]:
    return np.ascontiguousarray(image[..., 0]) if is_grey else image


def _positive(z: Float32Array) -> Float32Array:
    return np.where(np.isfinite(z) & (z > 0), z, np.float32(0))


def quantise(z: Float32Array, depth_scale: float) -> npt.NDArray[np.uint16]:
    """16-bit depth (h, w) of planar z (h, w) in metres, 0 where there is none or it does not fit."""
    units = np.rint(z.astype(np.float64) * depth_scale)
    return np.where((units > 0) & (units <= 65535), units, 0).astype(np.uint16)


def _stored_spline(path: Path, spline: Spline) -> Spline:
    if not path.exists():
        atomic_write(path, encode_npz(spline.arrays()))
        return spline
    stored = Spline.load(path)
    same = stored.t0 == spline.t0 and stored.dt == spline.dt
    same = same and stored.control_points.shape == spline.control_points.shape
    if not (same and np.abs(stored.control_points - spline.control_points).max() <= _SPLINE_TOLERANCE):
        raise UserError(f"{path}: holds another trajectory: choose another --out or delete the folder")
    return stored


def _expect(image: np.ndarray, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    if image.shape != shape or image.dtype != dtype:
        raise ValueError(f"expected an image {shape} {np.dtype(dtype)}, not {image.shape} {image.dtype}")
