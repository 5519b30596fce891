"""What writer and reader of a sequence folder agree on: sequence.yaml, files' places, stamps, pairs, poses as TUM rows.

Format 1 has two cameras, colour and depth; format 2 a rig of any cameras with their poses in a body (docs/format.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, first_problem
from rsgen.files import read_yaml
from rsgen.geometry import se3, so3
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline

FORMAT, RIG_FORMAT = "rsgen-sequence/1", "rsgen-sequence/2"
_FORMAT_NAME = FORMAT.partition("/")[0] + "/"
StreamName = str
StreamKind = Literal["color", "mono", "infrared", "depth"]
IMAGE_KINDS = ("color", "mono", "infrared")  # which first, where one is to be chosen
STREAMS = ("color", "depth")  # of format 1
OBJECTS = "truth/objects"  # splines, poses and meshes of things that move by themselves
OBJECT_IDS = "object_ids"  # exact image: which of them each pixel of a colour frame shows, 0 for none
OBJECT_CHANNELS = ("id",)
LABELS_IMAGE = "labels"  # of a frame's truth as it is rendered: 16 bit, in a folder of its own
CLEAN_COLOR = "color"  # exact image: what a colour camera without noise would have reported
GROUND_TRUTH_HZ = 200.0
DEPTH_SCALE = 5000.0  # units per metre of depth images, unless stated otherwise: as TUM's and ICL-NUIM's
STAMP_TOLERANCE_S = 1e-6
_FRAMES_AT_ONCE = 16  # poses of so many frames' lines are evaluated together: flat memory, little overhead

MOST_CAMERAS = 16
# A camera's name is that of its folder and of its listing: these are of the format itself, or of exports beside it.
_RESERVED = ("truth", "associations", "groundtruth", "imu", "kalibr", "mav0", "scene", "sequence", "spline")

Finite = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Yaml(BaseModel):
    # Later versions may add entries; a reader of this one leaves them alone.
    model_config = ConfigDict(extra="ignore", frozen=True)


class StreamYaml(_Yaml):
    """One stream in sequence.yaml: camera (px), clock and shutter (s)."""

    size: tuple[Annotated[int, Field(ge=1, le=16384)], Annotated[int, Field(ge=1, le=16384)]]
    intrinsics: tuple[Finite, Finite, Finite, Finite]
    model: Model
    distortion: tuple[Finite, ...]
    rate_hz: Positive
    offset_s: Seconds
    readout_s: Seconds
    exposure_s: Seconds
    scan: Scan
    frames: int = Field(ge=1, le=10_000_000)
    first_stamp_s: Seconds
    depth_scale: Annotated[float, Field(ge=1e-3, le=1e9)] | None = None
    registered: bool = False  # depth/ holds images warped into the colour camera
    frame_table: bool = False  # stamps, exposure or gain of each image are in a table of their own

    @property
    def camera(self) -> Camera:
        """The camera. Raises UserError."""
        fx, fy, cx, cy = self.intrinsics
        return Camera(*self.size, fx, fy, cx, cy, self.model, self.distortion)

    @property
    def shutter(self) -> Shutter:
        """The shutter. Raises UserError."""
        return Shutter(self.readout_s, self.exposure_s, self.scan)


class _Streams(_Yaml):
    color: StreamYaml
    depth: StreamYaml


Vector4 = tuple[Finite, Finite, Finite, Finite]
Pose = tuple[Vector4, Vector4, Vector4, Vector4]
TruthImages = dict[Annotated[str, Field(pattern=r"^[a-z_]+$")], tuple[str, ...]]


def _not_reserved(name: str) -> str:
    if name in _RESERVED:
        raise ValueError(f"{name!r} is a name of the format's own files: choose another")
    return name


CameraName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,30}$"), AfterValidator(_not_reserved)]


class RigStreamYaml(StreamYaml):
    """One camera of a rig: what it is, its pose in the body, and its exact images."""

    kind: StreamKind
    T_body_cam: Pose
    truth: TruthImages = {}


class _Description(_Yaml):
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$")]  # part of file names
    noise: Any = None
    declared: bool = False  # cameras are what the sequence claims; truth/cameras.yaml has those that took the images
    objects: tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")], ...] = ()  # names; ids count from 1
    fingerprint: str  # the file's last entry: one that was cut off has none


class SequenceYaml(_Description):
    """The part of sequence.yaml that a reader relies on, format 1."""

    streams: _Streams
    T_color_depth: Pose
    truth: TruthImages = {}


class RigYaml(_Description):
    """The part of sequence.yaml that a reader relies on, format 2."""

    streams: Annotated[dict[CameraName, RigStreamYaml], Field(min_length=1, max_length=MOST_CAMERAS)]


class FrameClock(Protocol):
    """Anything with a stream's rate and offset, such as `rsgen.config.config.StreamConfig`."""

    @property
    def rate_hz(self) -> float: ...
    @property
    def offset_s(self) -> float: ...


@dataclass(frozen=True)
class Line:
    """One line of a listing: its number in the file, the stamp in seconds and the path as written."""

    number: int
    stamp: float
    path: str


def stream_stamps(first: float, last: float, stream: FrameClock) -> FloatArray:
    """Stamps (n,) of a stream over a recording from `first` to `last` seconds: first + offset + k / rate.

    They are rounded to the 9 decimals that listings hold, so that file and memory agree to the last bit. Raises
    UserError if no frame fits in or the numbers are absurd.
    """
    begin = first + stream.offset_s
    count = math.floor((last + STAMP_TOLERANCE_S - begin) * stream.rate_hz) + 1
    if count < 1:
        raise UserError(
            f"no frame fits between {first:g} s and {last:g} s with offset_s {stream.offset_s:g}: make offset_s smaller"
        )
    if count > 10_000_000:
        raise UserError(f"{count} frames at rate_hz {stream.rate_hz:g} are too many: lower rate_hz")
    return round_stamps(begin + np.arange(count) / stream.rate_hz)


def round_stamps(stamps: npt.ArrayLike) -> FloatArray:
    """Stamps as they read back from '%.9f'."""
    return np.array([float(f"{t:.9f}") for t in np.asarray(stamps, float).ravel()])


def frame_name(k: int) -> str:
    """File stem of frame k."""
    return f"{k:06d}"


def read_sequence_yaml(path: Path) -> tuple[SequenceYaml | RigYaml, dict[str, Any]]:
    """sequence.yaml, validated and as it is. Raises UserError naming the wrong field."""
    data = read_yaml(path)
    models: dict[Any, type[SequenceYaml | RigYaml]] = {FORMAT: SequenceYaml, RIG_FORMAT: RigYaml}
    found = data.get("format")
    if not isinstance(found, str) or found not in models:
        newer = isinstance(found, str) and found.startswith(_FORMAT_NAME)
        cure = "install a newer rsgen" if newer else f"is this a sequence of rsgen? It begins with 'format: {FORMAT}'"
        raise UserError(
            f"{path}: format is {found!r}, this version of rsgen reads {FORMAT!r} and {RIG_FORMAT!r}: {cure}"
        )
    try:
        return models[found].model_validate(data), data
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)} ({error.error_count()} wrong in all)") from None


def parse_listing(path: Path, text: str) -> list[Line]:
    """Lines 'stamp path' of a TUM listing, comments skipped. Raises UserError naming the line."""
    lines: list[Line] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split()
        where = f"{path} line {number}"
        if len(fields) != 2:
            raise UserError(f"{where}: expected 'stamp path', found {line[:60]!r}")
        try:
            stamp = float(fields[0])
        except ValueError:
            stamp = math.nan
        if not math.isfinite(stamp):
            raise UserError(f"{where}: {fields[0][:40]!r} is not a time in seconds")
        if lines and stamp <= lines[-1].stamp:
            raise UserError(f"{where}: stamp {stamp:.9f} does not come after {lines[-1].stamp:.9f}")
        lines.append(Line(number, stamp, fields[1]))
    return lines


def associate(stamps_a: npt.ArrayLike, stamps_b: npt.ArrayLike, limit_s: float) -> list[tuple[int, int]]:
    """Index pairs (into a, into b) nearest in time, each frame once, closest pairs first, at most `limit_s` apart.

    TUM's `associate.py` on neighbours only; ties (to a microsecond) go to the earlier frame, so that streams half a
    period apart pair up in order.
    """
    a, b = np.asarray(stamps_a, float), np.asarray(stamps_b, float)
    after = np.searchsorted(b, a)
    candidates = sorted(
        (round(abs(a[i] - b[j]), 6), i, j)
        for i in range(len(a))
        for j in (int(after[i]) - 1, int(after[i]))
        if 0 <= j < len(b) and abs(a[i] - b[j]) <= limit_s + STAMP_TOLERANCE_S
    )
    used_a: set[int] = set()
    used_b: set[int] = set()
    pairs = []
    for _, i, j in candidates:
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            pairs.append((i, j))
    return sorted(pairs)


def pose_rows(T: FloatArray) -> FloatArray:
    """Rows (n, 7) tx ty tz qx qy qz qw of poses (n, 4, 4): quaternions from qw ≥ 0 on without sign flips."""
    q = so3.to_quat(T[:, :3, :3])
    if len(q):
        flips = np.where(np.einsum("ni,ni->n", q[1:], q[:-1]) < 0, -1.0, 1.0)
        q = q * np.cumprod(np.concatenate([[-1.0 if q[0, 3] < 0 else 1.0], flips]))[:, None]
    return np.concatenate([T[:, :3, 3], q], axis=-1) + 0.0  # no negative zeros


def pose_lines(title: str, rows: FloatArray) -> list[str]:
    """Lines of a TUM file of poses: comments, then rows (n, 8), stamp tx ty tz qx qy qz qw."""
    lines = [f"{row[0]:.9f} " + " ".join(f"{value:.12f}" for value in row[1:]) for row in rows]
    return [f"# {title}", "# stamp tx ty tz qx qy qz qw", *lines]


def poses_of_rows(rows: FloatArray) -> FloatArray:
    """Poses (..., 4, 4) of rows (..., 7)."""
    return se3.from_quat_trans(rows[..., 3:], rows[..., :3])


def line_poses(
    spline: Spline, camera: Camera, shutter: Shutter, stamps: npt.ArrayLike, T_cam_body: FloatArray | None = None,
    exposure_s: FloatArray | None = None,
) -> FloatArray:  # fmt: skip
    """Rows (frames, lines, 7) of T_world_cam at each line's mid-exposure; T_cam_body is the identity for depth.

    exposure_s (frames,): of each frame, where it is not the shutter's. Entry i is image row i (column i for the
    sideways scans), whatever the order of readout. Raises UserError if a line is read outside the spline's time.
    """
    stamps = np.asarray(stamps, float)
    if exposure_s is not None:
        stamps = stamps - 0.5 * (exposure_s - shutter.exposure_s)
    places = np.arange(shutter.line_count(camera), dtype=float)
    lines = shutter.line_of_pixel(np.stack([places, places], axis=-1), camera)
    poses = []
    for k in range(0, len(stamps), _FRAMES_AT_ONCE):
        T = spline.pose(shutter.line_mid_time(stamps[k : k + _FRAMES_AT_ONCE, None], lines, camera))
        poses.append(T if T_cam_body is None else T @ se3.inverse(T_cam_body))
    T = np.concatenate(poses)
    return pose_rows(T.reshape(-1, 4, 4)).reshape(*T.shape[:2], 7)


def ground_truth(spline: Spline, *stamps: npt.ArrayLike, T_cam_body: FloatArray | None = None) -> FloatArray:
    """Rows (n, 8) of groundtruth.txt: T_world_depth on a 200 Hz grid over the spline and at every given stamp.

    T_cam_body: of the camera whose poses they are, where it is not the body.
    """
    grid = np.arange(math.ceil(spline.t_begin * GROUND_TRUTH_HZ), math.floor(spline.t_end * GROUND_TRUTH_HZ) + 1)
    times = np.unique(round_stamps(np.concatenate([grid / GROUND_TRUTH_HZ, *map(np.asarray, stamps)])))
    times = times[(times >= spline.t_begin) & (times <= spline.t_end)]
    T = spline.pose(times)
    return np.column_stack([times, pose_rows(T if T_cam_body is None else T @ se3.inverse(T_cam_body))])


@dataclass(frozen=True)
class StreamFiles:
    """Paths within the folder. truth: in which each kind of exact image has a folder; exact_depth: of depth cameras."""

    images: str
    listing: str
    rows: str
    frame_table: str
    truth: str
    exact_depth: str
    object_ids: str
    labels: str
    boxes: str

    def truth_image(self, name: str, channels: Sequence[str], stem: str) -> str:
        """File of an exact image; without EXR channels it is a PNG."""
        return f"{self.truth}/{name}/{stem}.{'exr' if channels else 'png'}"


FILES = {
    "color": StreamFiles(
        "rgb", "rgb.txt", "truth/rows_color.npy", "truth/frames_color.txt", "truth", "", "truth/object_ids",
        "truth/labels", "truth/boxes_color.csv",
    ),
    "depth": StreamFiles(
        "depth", "depth.txt", "truth/rows_depth.npy", "truth/frames_depth.txt", "truth", "truth/depth",
        "truth/depth_object_ids", "truth/depth_labels", "truth/boxes_depth.csv",
    ),
}  # fmt: skip
"""Of a sequence of format 1."""


def rig_files(name: str) -> StreamFiles:
    """Of a camera of a rig, format 2."""
    truth = f"truth/{name}"
    return StreamFiles(
        name,
        f"{name}.txt",
        f"{truth}/rows.npy",
        f"{truth}/frames.txt",
        truth,
        f"{truth}/depth",
        f"{truth}/object_ids",
        f"{truth}/labels",
        f"{truth}/boxes.csv",
    )
