"""Write a sequence folder frame by frame, so that a run killed at any moment is resumed to the same bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.config.config import Config
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, remove_stale_temporaries, write_error
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_exr, encode_npy, encode_npz, encode_png
from rsgen.produce.records import (
    ListedStream,
    color_truth,
    describe,
    refuse_foreign_folder,
    true_cameras,
    write_ground_truth,
    write_imu,
    write_lines,
    write_listings,
)
from rsgen.sensors.color import Setting
from rsgen.sensors.imu import sample_clock
from rsgen.sensors.reports import color_clock
from rsgen.sequence.camera_yaml import TRUE_CAMERAS, camera_yaml
from rsgen.sequence.format import (
    DEPTH_OBJECT_IDS,
    FOLDERS,
    FRAME_TABLES,
    OBJECT_CHANNELS,
    OBJECTS,
    ROWS,
    STREAMS,
    TRUTH_DEPTH,
    StreamName,
    color_truth_path,
    frame_name,
    ground_truth,
    line_poses,
    pose_lines,
)
from rsgen.sequence.truth_files import TARGET_CORNERS, poses_file, spline_file, target_corners_text

_SPLINE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class SequenceWriter:
    """An open sequence folder; make one with `open`.

    Render from `spline` and `stamps`, not from what was handed to `open`: when a run is resumed, `spline` is the one on
    disk, which may differ from a new fit in its last bits. settings: see `adapted`; empty without an automatic camera.
    """

    out: Path
    config: Config
    spline: Spline
    color: ListedStream
    depth: ListedStream
    settings: tuple[Setting, ...] = ()
    objects: tuple[Spline, ...] = ()

    @classmethod
    def open(
        cls,
        out: Path,
        config: Config,
        spline: Spline,
        stamps_color: npt.ArrayLike,
        stamps_depth: npt.ArrayLike,
        versions: Mapping[str, str],
        inputs: Mapping[str, str],
        objects: Sequence[Spline] = (),
    ) -> SequenceWriter:
        """Create `out`, or resume what an equal call began there.

        stamps_color (n,) and stamps_depth (m,) are the stamps in seconds of all frames of the sequence, as
        `stream_stamps` returns them. `inputs` are content hashes of the trajectory and scene files; `versions` those of
        every program that decides the bytes. objects: T_world_object(t) of the config's. sequence.yaml and splines are
        written here.

        Raises UserError if the folder holds another sequence or other files, or cannot be written, if a line of a frame
        is read outside the spline's time, or if the IMU's samples are absurdly many; then nothing in it has been
        changed.
        """
        out = Path(out)
        streams = {
            "color": ListedStream.of(config.color, config.injected.color, "color", stamps_color, config.seed),
            "depth": ListedStream.of(config.depth, config.injected.depth, "depth", stamps_depth, config.seed),
        }
        for stream in streams.values():
            line_poses(spline, stream.camera, stream.shutter, stream.stamps[[0, -1]])
        if config.imu is not None:
            sample_clock(config.imu, spline.t_begin, spline.t_end)
        stamps = {name: stream.stamps for name, stream in streams.items()}
        text = describe(config, spline, stamps, versions, inputs)
        refuse_foreign_folder(out, text)
        try:
            out.mkdir(parents=True, exist_ok=True)
            # First of all, so that a run that ends here leaves either nothing or what it can be resumed from.
            if not (out / "sequence.yaml").exists():
                atomic_write(out / "sequence.yaml", encode_yaml(text))
            folders = (*FOLDERS.values(), TRUTH_DEPTH, *(f"truth/{name}" for name in color_truth(config)))
            folders += (DEPTH_OBJECT_IDS, OBJECTS) if objects else ()
            for folder in folders:
                (out / folder).mkdir(parents=True, exist_ok=True)
            for folder in ("", "truth", *folders):
                remove_stale_temporaries(out / folder)
        except OSError as error:
            raise write_error(out, error) from None
        moving = zip(config.objects, objects, strict=True)
        things = tuple(_stored_spline(out / spline_file(thing.name), s) for thing, s in moving)
        spline = _stored_spline(out / "spline.npz", spline)
        return cls(out, config, spline, streams["color"], streams["depth"], objects=things)

    def stamps(self, stream: StreamName) -> FloatArray:
        """True stamps (n,) of all frames of a stream, s."""
        return self._stream(stream).stamps

    def shows(self, stream: StreamName, k: int) -> int:
        """The frame that image k shows: k, unless a driver delivered an earlier one again."""
        return int(self._stream(stream).table.shows[k])

    def next_color(self, k: int) -> int | None:
        """The frame that the colour image listed after image k shows; None after the last one."""
        later = np.flatnonzero(self.color.is_delivered[k + 1 :])
        return self.shows("color", k + 1 + int(later[0])) if len(later) else None

    def setting(self, k: int) -> Setting | None:
        """How the automatic camera takes colour frame k; None where nothing is automatic."""
        return self.settings[k] if self.settings else None

    def adapted(self, settings: Sequence[Setting]) -> SequenceWriter:
        """The same with the automatic camera's settings of all colour frames of its clock."""
        shown = [settings[k] for k in self.color.table.shows]
        table = replace(
            self.color.table,
            exposure_s=np.array([s.exposure_s for s in shown]),
            gain=np.array([s.gain for s in shown]),
            brightness=np.array([s.brightness for s in shown]),
            balance=np.array([s.balance for s in shown]),
        )
        return replace(self, color=replace(self.color, table=table), settings=tuple(settings))

    def missing(self, stream: StreamName) -> list[int]:
        """Indices of the frames that are delivered and not on disk yet."""
        delivered = np.flatnonzero(self._stream(stream).is_delivered).tolist()
        return [k for k in delivered if not self._is_written(stream, k)]

    def write_color(self, k: int, rgb: ByteArray, truth: Mapping[str, npt.NDArray[Any]] = MappingProxyType({})) -> None:
        """Write colour frame k, sRGB (h, w, 3) uint8, and its images of `color_truth`.

        These are uint8 (h, w, 3), or float32 (h, w) or (h, w, n) with n EXR channels. Raises UserError if the disk
        refuses one.
        """
        shape = self.color.camera.height, self.color.camera.width
        names = color_truth(self.config)
        if truth.keys() != names.keys():
            raise ValueError(f"truth of a colour frame is {sorted(names)}, not {sorted(truth)}")
        for name, channels in names.items():
            image = truth[name]
            planes = () if len(channels) == 1 else (len(channels) or 3,)
            _expect(image, (*shape, *planes), np.float32 if channels else np.uint8)
            atomic_write(
                self._color_truth_path(name, k), encode_exr(image, channels) if channels else encode_png(image)
            )
        _expect(rgb, (*shape, 3), np.uint8)
        atomic_write(self._path("color", k), encode_png(rgb))

    def write_depth(
        self, k: int, z: Float32Array, reported: Float32Array | None = None, ids: Float32Array | None = None
    ) -> None:
        """Write depth frame k, planar z (h, w) float32 in metres; 0, negative, inf and NaN mean nothing measured.

        truth/depth/ gets z exactly; depth/ gets what the camera reports (default: z; of the colour camera's size where
        depth is registered), rounded to 1/depth_scale m, 0 where that leaves 16 bits. ids (h, w): of the objects seen,
        where there are any. Raises UserError if the disk refuses it.
        """
        if (ids is None) != (not self.objects):
            raise ValueError("ids of a depth frame are of a sequence with objects, and only there")
        if ids is not None:
            _expect(ids, (self.depth.camera.height, self.depth.camera.width), np.float32)
            atomic_write(self._ids_path(k), encode_exr(ids, OBJECT_CHANNELS))
        _expect(z, (self.depth.camera.height, self.depth.camera.width), np.float32)
        camera = self.color.camera if self.config.depth.registered else self.depth.camera
        _expect(z if reported is None else reported, (camera.height, camera.width), np.float32)
        atomic_write(self._truth_path(k), encode_exr(_positive(z)))
        units = quantise(_positive(z if reported is None else reported), self.config.depth.depth_scale)
        atomic_write(self._path("depth", k), encode_png(units))

    def finish(self) -> None:
        """Write listings of the frames that are there, pairs, ground truth and rows' poses. May be called again.

        Raises UserError if the disk refuses them.
        """
        config, faults, out, spline = self.config, self.config.injected, self.out, self.spline
        T_color_depth = np.array(config.T_color_depth, float)
        T_image_depth = T_color_depth if config.depth.registered else None
        written = {s: [k for k in range(len(self.stamps(s))) if self._is_written(s, k)] for s in STREAMS}
        listed = {s: self._stream(s).table.listed_s for s in STREAMS}
        write_listings(out, config.name, listed, written, 0.5 / min(config.color.rate_hz, config.depth.rate_hz))
        stamps = {s: self.stamps(s) for s in STREAMS}
        write_ground_truth(out, config.name, spline, stamps, T_image_depth, config.mocap, config.seed)
        for thing, T_world_object in zip(config.objects, self.objects, strict=True):
            rows = ground_truth(T_world_object, *stamps.values())
            write_lines(out / poses_file(thing.name), pose_lines(f"T_world_object of {thing.name}", rows))
        for s in STREAMS:
            stream = self._stream(s)
            atomic_write(out / ROWS[s], encode_npy(stream.line_poses(spline, T_color_depth if s == "color" else None)))
            if stream.writes_table:
                table = stream.table.of(np.flatnonzero(stream.is_delivered))
                atomic_write(out / FRAME_TABLES[s], table.text().encode())
        delivered = self.depth.table.listed_s[self.depth.is_delivered]
        middle = float(delivered[len(delivered) // 2])
        if faults.declared is not None:
            firsts = float(self.color.stamps[0]), float(self.depth.stamps[0])
            clock = color_clock(faults.color, faults.depth, *firsts, middle)
            cameras = camera_yaml(true_cameras(config), clock, config.depth.registered)
            atomic_write(out / TRUE_CAMERAS, encode_yaml(cameras))
        if (target := config.target) is not None:
            text = target_corners_text(target.grid, np.array(target.T_world_target, float))
            atomic_write(out / TARGET_CORNERS, text.encode())
        if config.imu is not None:
            write_imu(out, spline, config.imu, faults.imu, config.seed, middle, T_image_depth)

    def _stream(self, stream: StreamName) -> ListedStream:
        return self.color if stream == "color" else self.depth

    def _path(self, stream: StreamName, k: int) -> Path:
        if not 0 <= k < len(self.stamps(stream)):
            raise IndexError(f"frame {k} of {len(self.stamps(stream))}")
        return self.out / FOLDERS[stream] / f"{frame_name(k)}.png"

    def _truth_path(self, k: int) -> Path:
        return self.out / TRUTH_DEPTH / f"{frame_name(k)}.exr"

    def _ids_path(self, k: int) -> Path:
        return self.out / DEPTH_OBJECT_IDS / f"{frame_name(k)}.exr"

    def _color_truth_path(self, name: str, k: int) -> Path:
        return self.out / color_truth_path(name, color_truth(self.config)[name], frame_name(k))

    def _is_written(self, stream: StreamName, k: int) -> bool:
        # Atomic writes leave whole files only, so being there is enough; an empty one was made by something else.
        if stream == "depth":
            truth = [self._truth_path(k), *([self._ids_path(k)] if self.objects else [])]
        else:
            truth = [self._color_truth_path(name, k) for name in color_truth(self.config)]
        paths = [self._path(stream, k), *truth]
        return all(path.is_file() and path.stat().st_size > 0 for path in paths)


def _positive(z: Float32Array) -> Float32Array:
    return np.where(np.isfinite(z) & (z > 0), z, np.float32(0))


def quantise(z: Float32Array, depth_scale: float) -> npt.NDArray[np.uint16]:
    """16-bit depth (h, w) of planar z (h, w) in metres, 0 where there is none or it does not fit."""
    units = np.rint(z.astype(np.float64) * depth_scale)
    return np.where((units > 0) & (units <= 65535), units, 0).astype(np.uint16)


def _stored_spline(path: Path, spline: Spline) -> Spline:
    if not path.exists():
        arrays = {"control_points": spline.control_points, "t0": np.array(spline.t0), "dt": np.array(spline.dt)}
        atomic_write(path, encode_npz(arrays))
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
