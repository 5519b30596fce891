"""Pixels of ROS image messages as files: encodings, byte order, padding, and the checks of what comes compressed."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.image_codecs import decoded, encode_png, png_fault
from rsgen.inputs import PNG_START, image_size
from rstrack.data.image_files import image_fault
from rstrack.formats.recording import FLOAT_DEPTH_SCALE

# Bytes of `compressed_depth_image_transport` before the PNG: format, and two floats of the quantisation of 32FC1.
_DEPTH_HEADER = struct.Struct("<iff")
_CHANNELS = {
    "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono8": 1, "8uc1": 1, "y8": 1,
    "yuyv": 2, "yuv422_yuy2": 2, "yuy2": 2, "uyvy": 2, "yuv422": 2,
}  # fmt: skip
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB, "8uc3": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "8uc4": cv2.COLOR_BGRA2RGB, "mono8": cv2.COLOR_GRAY2RGB, "8uc1": cv2.COLOR_GRAY2RGB, "y8": cv2.COLOR_GRAY2RGB,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2, "yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY, "yuv422": cv2.COLOR_YUV2RGB_UYVY,
}  # fmt: skip
_UNITS, _METRES = ("16uc1", "mono16", "z16"), ("32fc1",)


def is_float_depth(encoding: str) -> bool:
    """Whether depth of this encoding is in metres rather than in units."""
    return encoding.lower().split(";")[0].strip() in _METRES


def color_png(where: str, message: Any, camera: Camera) -> bytes:
    """A PNG of a sensor_msgs/Image of the camera's size. Raises UserError."""
    encoding = str(message.encoding).lower()
    if encoding not in _CHANNELS:
        raise UserError(
            f"{where}: colour with encoding {message.encoding!r:.40} is not supported: rgb8, bgr8, rgba8, bgra8, "
            "mono8, yuyv or uyvy; debayer others with image_proc"
        )
    rows = _rows(where, message, camera, _CHANNELS[encoding], 1)
    pixels: ByteArray = rows.reshape(camera.height, camera.width, _CHANNELS[encoding])
    code = _TO_RGB.get(encoding)
    return encode_png(pixels if code is None else np.asarray(cv2.cvtColor(pixels, code), np.uint8))


def depth_png(where: str, message: Any, camera: Camera) -> bytes:
    """A 16-bit PNG of a sensor_msgs/Image of the camera's size: units as they are, metres at FLOAT_DEPTH_SCALE.

    Raises UserError.
    """
    encoding = str(message.encoding).lower()
    order = ">" if message.is_bigendian else "<"
    if encoding in _UNITS:
        units = _rows(where, message, camera, 1, 2).view(f"{order}u2")
        return encode_png(np.ascontiguousarray(units.reshape(camera.height, camera.width), np.uint16))
    if encoding in _METRES:
        z = _rows(where, message, camera, 1, 4).view(f"{order}f4")
        return encode_png(units_of_metres(z.reshape(camera.height, camera.width)))
    raise UserError(f"{where}: depth with encoding {message.encoding!r:.40} is not supported: 16UC1, mono16 or 32FC1")


def units_of_metres(z: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
    """Units (h, w) at FLOAT_DEPTH_SCALE of z (h, w) in m; 0 for what is not finite, not positive or too far."""
    z = np.asarray(z, np.float64)
    ok = np.isfinite(z) & (z > 0) & (z < 65535.4 / FLOAT_DEPTH_SCALE)
    return np.rint(np.where(ok, z, 0.0) * FLOAT_DEPTH_SCALE).astype(np.uint16)


def compressed_color(where: str, data: bytes, camera: Camera) -> tuple[bytes, str]:
    """The PNG or JPEG of the camera's size as it is, and its ending. Raises UserError."""
    if fault := image_fault(data):
        raise UserError(f"{where}: is not a whole image ({fault})")
    check_size(where, header_size(where, data), camera)
    return data, "png" if data.startswith(PNG_START) else "jpg"


def compressed_depth(where: str, data: bytes, encoding: str, camera: Camera) -> bytes:
    """The 16-bit PNG in a compressed depth image, with or without the header of 12 bytes. Raises UserError.

    encoding: the message's `format`; what begins with 32FC1 was quantised as compressed_depth_image_transport does,
    inverse depth by two numbers in the header, and is written at FLOAT_DEPTH_SCALE.
    """
    if data.startswith(PNG_START):
        header, png = None, data
    else:
        if len(data) < _DEPTH_HEADER.size or not data[_DEPTH_HEADER.size :].startswith(PNG_START):
            raise UserError(f"{where}: compressed depth is no PNG (format {encoding!r:.60}): RVL is not supported")
        header, png = _DEPTH_HEADER.unpack_from(data), data[_DEPTH_HEADER.size :]
    if fault := png_fault(png):
        raise UserError(f"{where}: the PNG is not whole ({fault})")
    check_size(where, header_size(where, png), camera)
    # Bit depth and colour type of the first chunk, whose checksum has been compared.
    if (png[24], png[25]) != (16, 0):
        raise UserError(f"{where}: the PNG is not 16-bit grey")
    if not is_float_depth(encoding):
        return png
    if header is None:
        raise UserError(f"{where}: 32FC1 depth without the numbers of its quantisation")
    _, a, b = header
    units = decode(where, png).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return encode_png(units_of_metres(np.where(units > 0, a / (units - b), 0.0)))


def decode(where: str, data: bytes) -> npt.NDArray[Any]:
    """An image as OpenCV has it. Raises UserError."""
    if fault := image_fault(data):
        raise UserError(f"{where}: is not a whole image ({fault})")
    if (image := decoded(data)) is None:
        raise UserError(f"{where}: the image cannot be decoded")
    return image


def header_size(where: str, data: bytes) -> tuple[int, int]:
    """(width, height) as an image's header states it, without decoding it. Raises UserError."""
    if (size := image_size(data)) is None:
        raise UserError(f"{where}: the image cannot be decoded")
    return size


def check_size(where: str, size: tuple[int, int], camera: Camera) -> None:
    """Raises UserError where an image is not as large as its camera."""
    if size != (camera.width, camera.height):
        raise UserError(
            f"{where}: is {size[0]}x{size[1]}, but its camera {camera.width}x{camera.height}: name the topics or files "
            "that belong together"
        )


def _rows(where: str, message: Any, camera: Camera, channels: int, size: int) -> npt.NDArray[np.uint8]:
    """Bytes (h, w · channels · size) of an image without its padding. Raises UserError."""
    check_size(where, (int(message.width), int(message.height)), camera)
    data = np.asarray(message.data).view(np.uint8).reshape(-1)
    wanted, step = camera.width * channels * size, int(message.step)
    step = wanted if camera.height == 1 else step  # of one line it may be anything
    if step < wanted or len(data) < step * (camera.height - 1) + wanted:
        raise UserError(f"{where}: holds {len(data)} bytes in lines of {step}, too few for {message.encoding!r:.40}")
    padded = np.zeros(step * camera.height, np.uint8) if len(data) < step * camera.height else data
    if padded is not data:  # the last line without its padding
        padded[: len(data)] = data
    return np.ascontiguousarray(padded[: step * camera.height].reshape(camera.height, step)[:, :wanted])
