"""What is published of cameras' shutters, with where that was found: a calibration may start from it.

No number stands here without a source; where no more than "rolling" was found, no time is stated.
docs/recordings.md has the same table.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rsgen.errors import UserError
from rstrack.calibration.parameters import COUNT, NAMES, Known, Parameters

# σ of the readout of a shutter that is published to be global, s.
_GLOBAL_SIGMA_S = 1e-4
# σ of readouts that makers give as a time of a line: how many are read beside those of the image is not stated, s.
_LINE_TIME_SIGMA_S = 1e-3
# Part of what the device's σ was that is left where the recording adds little.
_ADDS_LITTLE = 0.7


@dataclass(frozen=True)
class PublishedShutter:
    """What is published of one stream's shutter.

    readout_s: from the first line to one past the last, and its σ; None where none was found. kind: whose word that is.
    source: where it was found, a URL or a place in this project's documents.
    """

    shutter: Literal["rolling", "global", "unknown"]
    kind: str
    source: str
    readout_s: float | None = None
    sigma_s: float | None = None

    def text(self) -> str:
        """In a few words, with 2 σ."""
        if self.readout_s is None or self.sigma_s is None:
            return "rolling, time not found" if self.shutter == "rolling" else self.shutter
        if self.shutter == "global":
            return "global"
        return f"rolling, {1e3 * self.readout_s:.1f} ± {2e3 * self.sigma_s:.1f} ms"


@dataclass(frozen=True)
class Device:
    """A camera in one of its modes. name: that of --device."""

    name: str
    title: str
    depth: PublishedShutter
    color: PublishedShutter

    def known(self, start: Parameters) -> Known:
        """What is known of both readouts; all else, and what was not found, begins where `start` does."""
        sigmas = np.full(COUNT, np.inf)
        if self.depth.readout_s is not None and self.depth.sigma_s is not None:
            start = replace(start, depth_readout_s=self.depth.readout_s)
            sigmas[NAMES.index("depth.readout_s")] = self.depth.sigma_s
        if self.color.readout_s is not None and self.color.sigma_s is not None:
            start = replace(start, color_readout_s=self.color.readout_s)
            sigmas[NAMES.index("color.readout_s")] = self.color.sigma_s
        return Known(start, sigmas)


def device_named(name: str) -> Device:
    """The device of a name. Raises UserError, which lists all names."""
    for device in DEVICES:
        if device.name == name.lower():
            return device
    raise UserError(f"--device {name}: choose one of {', '.join(device.name for device in DEVICES)}")


def device_notes(device: Device, before: Known, used: Known, sigmas: Iterable[float]) -> tuple[str, ...]:
    """What became of what is known of the device, `before`, when a solution was drawn to `used`; σ (31,) after."""
    notes = [f"device: {device.title}: depth {device.depth.text()}; colour {device.color.text()}"]
    for i, (sigma, known, kept) in enumerate(zip(sigmas, before.sigmas, used.sigmas, strict=True)):
        name = NAMES[i].replace("_s", "").replace("color", "colour").replace(".", " ")
        if not np.isfinite(known):
            continue
        if not np.isfinite(kept):
            notes.append(f"{name}: this recording contradicts the device's, which was not used: is it another mode?")
        elif sigma > _ADDS_LITTLE * known:
            notes.append(f"{name}: determined by the device rather than by this recording")
    return tuple(notes)


def _global(kind: str, source: str) -> PublishedShutter:
    return PublishedShutter("global", kind, source, 0.0, _GLOBAL_SIGMA_S)


def _zed2(title: str, lines: int, line_s: float) -> Device:
    stream = PublishedShutter(
        "rolling", "maker's support, times of a line",
        "https://support.stereolabs.com/hc/en-us/articles/1500008922521-What-is-the-readout-time-of-the-ZED-2-camera-",
        lines * line_s, _LINE_TIME_SIGMA_S,
    )  # fmt: skip
    name = f"zed2-{title.replace(', ', '-').replace(' Hz', 'hz')}"
    return Device(name, f"Stereolabs ZED 2, {title}", stream, stream)


_REALSENSE, _SUPPORT = "https://github.com/realsenseai", "maker's support"
_KINECT_V1 = "notebook/calibration.md#a-kinects-readouts-fr1_rpy-070-080"
_OAK = "https://docs.luxonis.com/hardware/products/OAK-D%20S2.md"
_GEMINI_305 = "https://wiki.seeedstudio.com/orbbec_gemini305/"

DEVICES = (
    Device(
        "azure-kinect", "Azure Kinect",
        PublishedShutter(
            "unknown", "time of flight, says its maker",
            "https://learn.microsoft.com/sk-sk/azure/kinect-dk/hardware-specification",
        ),
        PublishedShutter(
            "rolling", "the maker's specification, in others' words",
            "https://ivanatilca.com/2019/08/17/azure-kinect-hardware-specifications-in-detail",
        ),
    ),
    Device(
        "gemini-305", "Orbbec Gemini 305", _global("a vendor's documentation", _GEMINI_305),
        _global("a vendor's documentation", _GEMINI_305),
    ),
    Device(
        "kinect-v1", "Kinect of 2010, 640×480, 30 Hz",
        PublishedShutter("rolling", "measured by this project on one of them", _KINECT_V1, 0.0339, 2e-3),
        PublishedShutter("rolling", "measured by this project on one of them", _KINECT_V1, 0.0263, 2e-3),
    ),
    Device(
        "oak-d-s2", "Luxonis OAK-D S2", _global("maker's documentation", _OAK),
        PublishedShutter("rolling", "maker's documentation", _OAK),
    ),
    Device(
        "realsense-d405", "RealSense D405", _global(_SUPPORT, f"{_REALSENSE}/librealsense/issues/14253"),
        _global(_SUPPORT, f"{_REALSENSE}/librealsense/issues/14253"),
    ),
    Device(
        "realsense-d415", "RealSense D415",
        PublishedShutter("rolling", "a user, of the maker's support", f"{_REALSENSE}/librealsense/issues/12716"),
        PublishedShutter("rolling", _SUPPORT, f"{_REALSENSE}/librealsense/issues/13794"),
    ),
    Device(
        "realsense-d435", "RealSense D435, D435i", _global(_SUPPORT, f"{_REALSENSE}/librealsense/issues/13285"),
        PublishedShutter("rolling", _SUPPORT, f"{_REALSENSE}/librealsense/issues/13285"),
    ),
    Device(
        "realsense-d455", "RealSense D455", _global(_SUPPORT, f"{_REALSENSE}/realsense-ros/issues/3451"),
        _global(_SUPPORT, f"{_REALSENSE}/realsense-ros/issues/3451"),
    ),
    _zed2("720p, 30 Hz", 720, 25.6e-6),
    _zed2("720p, 60 Hz", 720, 15.7e-6),
    _zed2("1080p, 30 Hz", 1080, 25.6e-6),
)  # fmt: skip
"""All cameras of --device."""
