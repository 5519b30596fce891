"""Files of a pack's sequence, by the names of Carla-RS and Fastec-RS (Liu, Cui, Larsson, Pollefeys, CVPR 2020).

Names and contents follow the loaders of the authors' code (DeepUnrollNet): there are no documents of the formats.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import cv2
import numpy as np

from rsgen.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from rsgen.config.sections import GlobalTime
from rsgen.image_codecs import encode_png
from rsgen.pack.draw import Drawn, Layout

TIMES: tuple[GlobalTime, ...] = ("first", "middle")
_FLO_MAGIC = 202021.25
_MARK = {"carla-rs": "gt_vel.log", "fastec-rs": "meta.log"}
_ROLLING = {"carla-rs": "_rs.png", "fastec-rs": "_rolling.png"}
_GLOBAL = {
    "carla-rs": {"first": "_gs_f.png", "middle": "_gs_m.png"},
    "fastec-rs": {"first": "_global_first.png", "middle": "_global_middle.png"},
}
# Of the two, Carla-RS has one flow and one mask: its loader's default is the first line's.
_SUFFIX = {"first": "", "middle": "_m"}


@dataclass(frozen=True)
class Pair:
    """A rolling image with its global ones; by time ('first', 'middle' line): sharp images (h, w, 3) uint8.

    flow: (h, w, 2) px from the rolling image into the global one, 0 where that does not hold the point. flow_valid:
    (h, w) where it does and shows it. mask: (h, w) where what the global image shows is in the rolling one. depth:
    (h, w) planar z of the rolling image in m, 0 where there is none; None where it is not asked for.
    """

    rolling: ByteArray
    images: dict[str, ByteArray]
    flow: dict[str, Float32Array]
    flow_valid: dict[str, BoolArray]
    mask: dict[str, BoolArray]
    depth: Float32Array | None = None


def pair_files(layout: Layout, k: int, pair: Pair) -> dict[str, bytes]:
    """Files of frame k, by name."""
    stem = f"{k:04d}" if layout == "carla-rs" else f"{k:03d}"
    files = {f"{stem}{_ROLLING[layout]}": encode_png(pair.rolling)}
    if pair.depth is not None:
        files[f"{stem}{_ROLLING[layout].replace('.png', '.pdepth')}"] = pdepth_text(pair.depth)
    for time in TIMES:
        files[f"{stem}{_GLOBAL[layout][time]}"] = encode_png(pair.images[time])
        files[f"{stem}{_SUFFIX[time]}.flow"] = flo_bytes(pair.flow[time])
        files[f"{stem}_flow_mask{_SUFFIX[time]}.png"] = _mask_png(pair.flow_valid[time])
        files[f"{stem}_mask{_SUFFIX[time]}.png"] = _mask_png(pair.mask[time])
    return files


def flo_bytes(flow: Float32Array) -> bytes:
    """Middlebury's .flo: its magic number, width and height, then u v (px) row by row, little-endian."""
    height, width = flow.shape[:2]
    head = np.array([_FLO_MAGIC], "<f4").tobytes() + np.array([width, height], "<i4").tobytes()
    return head + np.ascontiguousarray(flow[..., :2], "<f4").tobytes()


def pdepth_text(z: Float32Array) -> bytes:
    """Rows of planar z (h, w) in metres to a tenth of a millimetre, as the authors wrote it; 0 for what is no depth."""
    stream = io.BytesIO()
    np.savetxt(stream, np.where(np.isfinite(z) & (z > 0), z, 0.0), "%.4f")
    return stream.getvalue()


def mark_file(layout: Layout, drawn: Drawn, twist: FloatArray, rate_hz: float) -> tuple[str, bytes]:
    """Name and text of the file by which loaders know a sequence. twist (6,): mean v, ω in the camera, m/s, rad/s."""
    if layout == "carla-rs":
        head = "# vx vy vz wx wy wz: mean over the sequence, camera frame (x right, y down, z forward), m/s and rad/s"
        return _MARK[layout], f"{head}\n{' '.join(f'{value:.9g}' for value in twist)}\n".encode()
    known = {
        "readout_s": drawn.readout_s, "exposure_s": drawn.exposure_s, "rate_hz": rate_hz, "speed": drawn.speed,
    }  # fmt: skip
    return _MARK[layout], "".join(f"{name} {value:.9g}\n" for name, value in known.items()).encode()


def _mask_png(array: BoolArray) -> bytes:
    """8-bit grey, 255 where true: what loaders take for a mask."""
    done, data = cv2.imencode(".png", np.where(array, np.uint8(255), np.uint8(0)))
    assert done
    return bytes(data)
