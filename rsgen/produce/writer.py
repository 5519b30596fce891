"""Write a sequence folder frame by frame, so that a run killed at any moment is resumed to the same bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.config.config import Config
from rsgen.errors import UserError
from rsgen.files import (
    atomic_write,
    encode_exr,
    encode_npy,
    encode_npz,
    encode_png,
    encode_yaml,
    remove_stale_temporaries,
    write_error,
)
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.produce.identity import color_truth, describe, refuse_foreign_folder
from rsgen.sensors.imu import sample_clock, simulate_imu, write_imu_csv
from rsgen.sequence.format import (
    FOLDERS,
    LISTINGS,
    ROWS,
    STREAMS,
    TRUTH_DEPTH,
    StreamName,
    associate,
    color_truth_path,
    frame_name,
    ground_truth,
    line_poses,
    round_stamps,
)

_SPLINE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class _Stream:
    camera: Camera
    shutter: Shutter
    stamps: FloatArray


@dataclass(frozen=True)
class SequenceWriter:
    """An open sequence folder; make one with `open`.

    Render from `spline` and `stamps`, not from what was handed to `open`: when a run is resumed, `spline` is the one on
    disk, which may differ from a new fit in its last bits.
    """

    out: Path
    config: Config
    spline: Spline
    color: _Stream
    depth: _Stream

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
    ) -> SequenceWriter:
        """Create `out`, or resume what an equal call began there.

        stamps_color (n,) and stamps_depth (m,) are the stamps in seconds of all frames of the sequence, as
        `stream_stamps` returns them. `inputs` are content hashes of the trajectory and scene files; `versions` those of
        every program that decides the bytes. sequence.yaml and spline.npz are written here.

        Raises UserError if the folder holds another sequence or other files, or cannot be written, if a line of a frame
        is read outside the spline's time, or if the IMU's samples are absurdly many; then nothing in it has been
        changed.
        """
        out = Path(out)
        streams = {
            "color": _Stream(config.color.camera, config.color.shutter, round_stamps(stamps_color)),
            "depth": _Stream(config.depth.camera, config.depth.shutter, round_stamps(stamps_depth)),
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
            for folder in folders:
                (out / folder).mkdir(parents=True, exist_ok=True)
            for folder in ("", "truth", *folders):
                remove_stale_temporaries(out / folder)
        except OSError as error:
            raise write_error(out, error) from None
        return cls(out, config, _stored_spline(out / "spline.npz", spline), **streams)

    def stamps(self, stream: StreamName) -> FloatArray:
        """Stamps (n,) of all frames of a stream, s."""
        return self._stream(stream).stamps

    def missing(self, stream: StreamName) -> list[int]:
        """Indices of the frames that are not on disk yet."""
        return [k for k in range(len(self.stamps(stream))) if not self._is_written(stream, k)]

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

    def write_depth(self, k: int, z: Float32Array, reported: Float32Array | None = None) -> None:
        """Write depth frame k, planar z (h, w) float32 in metres; 0, negative, inf and NaN mean nothing measured.

        truth/depth/ gets z exactly; depth/ gets what the camera reports (default: z), rounded to 1/depth_scale m, 0
        where that leaves 16 bits. Raises UserError if the disk refuses it.
        """
        for image in (z,) if reported is None else (z, reported):
            _expect(image, (self.depth.camera.height, self.depth.camera.width), np.float32)
        atomic_write(self._truth_path(k), encode_exr(_positive(z)))
        units = quantise(_positive(z if reported is None else reported), self.config.depth.depth_scale)
        atomic_write(self._path("depth", k), encode_png(units))

    def finish(self) -> None:
        """Write listings of the frames that are there, pairs, ground truth and rows' poses. May be called again.

        Raises UserError if the disk refuses them.
        """
        written = {s: [k for k in range(len(self.stamps(s))) if self._is_written(s, k)] for s in STREAMS}
        entries = {
            s: [f"{self.stamps(s)[k]:.9f} {FOLDERS[s]}/{frame_name(k)}.png" for k in written[s]] for s in STREAMS
        }
        for s in STREAMS:
            header = [f"# {s} images of {self.config.name}", "# stamp path"]
            _write_lines(self.out / LISTINGS[s], header + entries[s])
        color, depth = (self.stamps(s)[written[s]] for s in STREAMS)
        limit = 0.5 / min(self.config.color.rate_hz, self.config.depth.rate_hz)
        pairs = [f"{entries['color'][i]} {entries['depth'][j]}" for i, j in associate(color, depth, limit)]
        _write_lines(self.out / "associations.txt", pairs)
        rows = ground_truth(self.spline, self.color.stamps, self.depth.stamps)
        lines = [f"{row[0]:.9f} " + " ".join(f"{value:.12f}" for value in row[1:]) for row in rows]
        header = [f"# ground truth of {self.config.name}: T_world_depth", "# stamp tx ty tz qx qy qz qw"]
        _write_lines(self.out / "groundtruth.txt", header + lines)
        for s in STREAMS:
            stream = self._stream(s)
            T_cam_body = np.array(self.config.T_color_depth, float) if s == "color" else None
            poses = line_poses(self.spline, stream.camera, stream.shutter, stream.stamps, T_cam_body)
            atomic_write(self.out / ROWS[s], encode_npy(poses))
        if self.config.imu is not None:
            spline = self.spline
            samples = simulate_imu(spline, self.config.imu, spline.t_begin, spline.t_end, self.config.seed)
            write_imu_csv(self.out / "imu.csv", samples)

    def _stream(self, stream: StreamName) -> _Stream:
        return self.color if stream == "color" else self.depth

    def _path(self, stream: StreamName, k: int) -> Path:
        if not 0 <= k < len(self.stamps(stream)):
            raise IndexError(f"frame {k} of {len(self.stamps(stream))}")
        return self.out / FOLDERS[stream] / f"{frame_name(k)}.png"

    def _truth_path(self, k: int) -> Path:
        return self.out / TRUTH_DEPTH / f"{frame_name(k)}.exr"

    def _color_truth_path(self, name: str, k: int) -> Path:
        return self.out / color_truth_path(name, color_truth(self.config)[name], frame_name(k))

    def _is_written(self, stream: StreamName, k: int) -> bool:
        # Atomic writes leave whole files only, so being there is enough; an empty one was made by something else.
        if stream == "depth":
            truth = [self._truth_path(k)]
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


def _write_lines(path: Path, lines: list[str]) -> None:
    atomic_write(path, "".join(f"{line}\n" for line in lines).encode())


def _expect(image: np.ndarray, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    if image.shape != shape or image.dtype != dtype:
        raise ValueError(f"expected an image {shape} {np.dtype(dtype)}, not {image.shape} {image.dtype}")
