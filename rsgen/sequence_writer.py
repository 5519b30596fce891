"""Write a sequence folder frame by frame, so that a run killed at any moment is resumed to the same bytes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.config import Config, StreamConfig
from rsgen.errors import UserError
from rsgen.files import (
    atomic_write,
    encode_exr,
    encode_npy,
    encode_npz,
    encode_png,
    encode_yaml,
    is_temporary,
    read_yaml,
    remove_stale_temporaries,
    write_error,
)
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.sequence_format import (
    FOLDERS,
    FORMAT,
    LISTINGS,
    ROWS,
    STREAMS,
    TRUTH_DEPTH,
    FloatArray,
    StreamName,
    associate,
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

        Raises UserError if the folder holds another sequence or other files, or cannot be written, or if a line of a
        frame is read outside the spline's time; then nothing in it has been changed.
        """
        out = Path(out)
        streams = {
            "color": _Stream(config.color.camera, config.color.shutter, round_stamps(stamps_color)),
            "depth": _Stream(config.depth.camera, config.depth.shutter, round_stamps(stamps_depth)),
        }
        for stream in streams.values():
            line_poses(spline, stream.camera, stream.shutter, stream.stamps[[0, -1]])
        text = _sequence_yaml(config, spline, streams, versions, inputs)
        _refuse_foreign_folder(out, text)
        try:
            out.mkdir(parents=True, exist_ok=True)
            # First of all, so that a run that ends here leaves either nothing or what it can be resumed from.
            if not (out / "sequence.yaml").exists():
                atomic_write(out / "sequence.yaml", encode_yaml(text))
            for folder in (*FOLDERS.values(), TRUTH_DEPTH):
                (out / folder).mkdir(parents=True, exist_ok=True)
            for folder in ("", *FOLDERS.values(), "truth", TRUTH_DEPTH):
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

    def write_color(self, k: int, rgb: npt.NDArray[np.uint8]) -> None:
        """Write colour frame k, sRGB (h, w, 3) uint8. Raises UserError if the disk refuses it."""
        _expect(rgb, (self.color.camera.height, self.color.camera.width, 3), np.uint8)
        atomic_write(self._path("color", k), encode_png(rgb))

    def write_depth(self, k: int, z: npt.NDArray[np.float32]) -> None:
        """Write depth frame k, planar z (h, w) float32 in metres; 0, negative, inf and NaN mean nothing measured.

        truth/depth/ gets it exactly, depth/ rounded to 1/depth_scale m, 0 where that leaves 16 bits.
        Raises UserError if the disk refuses it.
        """
        _expect(z, (self.depth.camera.height, self.depth.camera.width), np.float32)
        exact = np.where(np.isfinite(z) & (z > 0), z, np.float32(0))
        atomic_write(self._truth_path(k), encode_exr(exact))
        atomic_write(self._path("depth", k), encode_png(quantise(exact, self.config.depth.depth_scale)))

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

    def _stream(self, stream: StreamName) -> _Stream:
        return self.color if stream == "color" else self.depth

    def _path(self, stream: StreamName, k: int) -> Path:
        if not 0 <= k < len(self.stamps(stream)):
            raise IndexError(f"frame {k} of {len(self.stamps(stream))}")
        return self.out / FOLDERS[stream] / f"{frame_name(k)}.png"

    def _truth_path(self, k: int) -> Path:
        return self.out / TRUTH_DEPTH / f"{frame_name(k)}.exr"

    def _is_written(self, stream: StreamName, k: int) -> bool:
        # Atomic writes leave whole files only, so being there is enough; an empty one was made by something else.
        paths = [self._path(stream, k)] + ([self._truth_path(k)] if stream == "depth" else [])
        return all(path.is_file() and path.stat().st_size > 0 for path in paths)


def quantise(z: npt.NDArray[np.float32], depth_scale: float) -> npt.NDArray[np.uint16]:
    """16-bit depth (h, w) of planar z (h, w) in metres, 0 where there is none or it does not fit."""
    units = np.rint(z.astype(np.float64) * depth_scale)
    return np.where((units > 0) & (units <= 65535), units, 0).astype(np.uint16)


def fingerprint(content: Mapping[str, Any]) -> str:
    """SHA-256 of canonical JSON; a number's spelling (1 or 1.0) does not matter."""
    text = json.dumps(_canonical(content), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _canonical(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _canonical(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value) + 0.0
    return value


def _sequence_yaml(
    config: Config,
    spline: Spline,
    streams: Mapping[str, _Stream],
    versions: Mapping[str, str],
    inputs: Mapping[str, str],
) -> dict[str, Any]:
    identity = {"config": config.content(), "inputs": dict(inputs), "versions": dict(versions)}
    return {
        "format": FORMAT,
        "name": config.name,
        "streams": {
            "color": _stream_yaml(config.color, streams["color"].stamps),
            "depth": _stream_yaml(config.depth, streams["depth"].stamps) | {"depth_scale": config.depth.depth_scale},
        },
        "T_color_depth": [[float(value) for value in row] for row in config.T_color_depth],
        "spline": {"knot_spacing_s": spline.dt, "t0_s": spline.t0, "control_points": len(spline.control_points)},
        "noise": None,
        "seed": config.seed,
        **identity,
        "fingerprint": fingerprint(identity),
    }


def _stream_yaml(stream: StreamConfig, stamps: FloatArray) -> dict[str, Any]:
    return {
        "size": [stream.width, stream.height],
        "intrinsics": list(stream.intrinsics),
        "model": stream.model,
        "distortion": list(stream.distortion),
        "rate_hz": stream.rate_hz,
        "offset_s": stream.offset_s,
        "readout_s": stream.readout_s,
        "exposure_s": stream.exposure_s,
        "scan": stream.scan,
        "frames": len(stamps),
        "first_stamp_s": float(stamps[0]),
    }


def _refuse_foreign_folder(out: Path, new: Mapping[str, Any]) -> None:
    cure = "choose another --out or delete the folder"
    try:
        if not out.is_dir():
            if out.exists():
                raise UserError(f"{out}: is a file, not a folder: choose another --out")
            return
        names = sorted(path.name for path in out.iterdir() if not is_temporary(path))
    except OSError as error:
        raise UserError(f"{out}: cannot be read ({error.strerror}): choose another --out") from None
    if not names:
        return
    if "sequence.yaml" not in names:
        raise UserError(f"{out}: holds other files ({names[0]}, ...) and no sequence.yaml: {cure}")
    old = read_yaml(out / "sequence.yaml")
    if old.get("fingerprint") == new["fingerprint"] and old == new:
        return
    field, before, now = _first_difference(old, new) or ("fingerprint", old.get("fingerprint"), new["fingerprint"])
    raise UserError(f"{out}: holds another sequence, {field} is {_short(before)} there and {_short(now)} now: {cure}")


def _first_difference(old: Any, new: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Name and both values of the first differing entry, what the user can change (config, inputs) before the rest."""
    if isinstance(old, dict) and isinstance(new, dict):
        first = [key for key in ("config", "inputs", "versions") if key in new and not name]
        for key in [*first, *(key for key in [*new, *old] if key not in first)]:
            inner = str(key) if name in ("", "config") else f"{name}.{key}"  # config fields as overrides name them
            if (found := _first_difference(old.get(key), new.get(key), inner)) is not None:
                return found
        return None
    return None if old == new else (name, old, new)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


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
