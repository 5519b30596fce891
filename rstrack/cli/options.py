"""Arguments that several `rstrack` commands share."""

from pathlib import Path
from typing import Annotated, Literal

from rsgen.console.command_line import number
from rstrack.metrics import consistency

SequenceFolder = Annotated[Path, "rsgen sequence (of a rig DIR:COLOR,DEPTH), TUM RGB-D, ICL-NUIM or 7-Scenes folder"]
CameraFile = Annotated[Path | None, "camera file to use in place of the cameras that the folder states", "FILE"]
ImuFile = Annotated[
    Path | None,
    "imu.yaml as Kalibr has it, of the IMU whose samples the folder has: densities, T_imu_depth or T_cam_imu, offset_s",
    "FILE",
]
DeviceName = Annotated[
    str | None,
    "camera whose published readouts to start from and be drawn to, for example zed2-720p-30hz; any other word lists "
    "them",
    "NAME",
]


def truth_offset(text: str) -> float | Literal["auto"]:
    """A number of seconds, or 'auto'."""
    return "auto" if text == "auto" else number(text)


NoiseDepth = Annotated[float, "add noise of standard deviation S z^2 to depth z in m; a Kinect has 1.2e-3", "S"]
NoiseIntensity = Annotated[
    float, "add noise of standard deviation S to intensities in [0, 1], for example 0.01", "S"
]  # fmt: skip
Seed = Annotated[int, "of the noise", int]
TruthOffset = Annotated[
    float | Literal["auto"] | None,
    "seconds after a stamp that the truth is looked up, or auto: those at which the drift is least, for a truth with a "
    "clock of its own (default: the same clock)",
    "auto|S",
    truth_offset,
]
TruthExtrinsics = Annotated[
    Literal["auto"] | None,
    "auto: errors also with the truth's poses moved by the one rigid transform on their right that fits best, for a "
    "truth of a body that is not quite the camera (default: it is)",
    "auto",
]
TruthNoise = Annotated[
    consistency.TruthNoise | None,
    "how far off the truth itself is: standard deviations of its motions over one second, mm and degrees along and "
    "about each axis, growing as the root of the time; NEES and intervals count them too (default: it is exact)",
    "MM,DEG",
    consistency.TruthNoise.parse,
]
RunFolder = Annotated[Path, "folder that 'rstrack track' wrote, or a TUM file"]
