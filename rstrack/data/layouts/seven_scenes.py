"""Folders in the layout of 7-Scenes (Shotton et al., CVPR 2013), which other recorders write too.

    frame-000000.color.png    8-bit colour, or .jpg
    frame-000000.depth.png    16-bit grey, millimetres; 0 and 65535: nothing measured
    frame-000000.pose.txt     optional: T_world_camera, 4x4; what is not finite is no pose
    camera.yaml               optional: see `camera_file`; depth is in millimetres whatever that states

Times, cameras and shutters are not stated there. Frames are taken to be 1/30 s apart by their numbers, so that a number
left out is a gap. An image that is the one before again is left out, and a number at which both cameras have nothing
new takes no time: recorders that were faster than the camera wrote those (91 of the 1000 frames of one of 7-Scenes').
Without a camera file depth has the intrinsics that the data set's authors recommend, colour and the pose between them
are a Kinect's as those who use the data set have it, and shutters are global. What is assumed is in `Dataset.notes`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import listed_file, read_text
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.camera_file import RigFile, find_camera_file, read_rig
from rstrack.data.dataset import Dataset, recorded_dataset
from rstrack.data.image_files import ImageFiles, decode_color, decode_depth, first_size, repeated, repeats_note
from rstrack.data.rig import DEFAULT_SIGMA, Rig

_NAME = re.compile(r"frame-(\d{1,9})\.(color\.png|color\.jpg|color\.jpeg|depth\.png|pose\.txt)")
_RATE_HZ = 30.0
_SIZE, _DEPTH, _COLOR = (640, 480), (585.0, 585.0, 320.0, 240.0), (525.0, 525.0, 320.0, 240.0)
# 7-Scenes' colour is not registered to its depth, and was not calibrated. This is a Kinect's.
_T_COLOR_DEPTH = np.array([
    [0.99996518, 0.00267651, -0.00790410, -0.02555894],
    [-0.00274093, 0.99996303, -0.00815045, 0.00010110],
    [0.00788199, 0.00817183, 0.99993554, 0.00203183],
    [0.0, 0.0, 0.0, 1.0],
])  # fmt: skip
_UNITS_PER_M, _MISSING = 1000.0, 65535
# Largest deviation of Rᵀ R from the identity that is rounded away.
_SKEW = 1e-2


def matches(root: Path) -> bool:
    """Whether a folder has this layout, and no listings, which would say more."""
    if (root / "depth.txt").exists() or (root / "rgb.txt").exists():
        return False
    return any(_NAME.fullmatch(path.name) for path in root.glob("frame-*"))


def read(root: Path, camera_file: Path | None) -> Dataset:
    """Read names, poses and cameras; images are decoded when asked for.

    camera_file: default camera.yaml, else calibration.yaml in the folder. Poses are taken for the depth camera's, which
    tracked them. Raises UserError, one line.
    """
    color, depth, poses = (_numbered(root, kind) for kind in ("color", "depth", "pose"))
    for name, found in (("colour", color), ("depth", depth)):
        if not found:
            raise UserError(f"{root}: has no {name} image frame-NNNNNN.{name.replace('u', '')}.png: unpack it again")
    file, notes = _cameras(root, camera_file, tuple(color.values()), tuple(depth.values()))
    notes = (f"frames are taken to be 1/{_RATE_HZ:g} s apart: nothing in {root} stamps them", *notes)
    numbers = list(color), list(depth)
    color_again, depth_again = repeated(list(color.values())), repeated(list(depth.values()))
    idle = _idle(*(np.array(n)[again] for n, again in zip(numbers, (color_again, depth_again), strict=True)))
    color, depth = _without(color, color_again), _without(depth, depth_again)
    notes += repeats_note("depth", depth_again) + repeats_note("colour", color_again)
    images = ImageFiles(file.rig, _UNITS_PER_M, tuple(color.values()), tuple(depth.values()), _MISSING)
    truth, without = _truth({k: path for k, path in poses.items() if k in depth or k not in numbers[1]}, idle)
    if without:
        notes = (*notes, f"{without} of {len(poses)} pose files hold no finite pose: there is no truth at these frames")
    stamps = _stamps(list(depth), idle), _stamps(list(color), idle)
    return recorded_dataset(root, file, *stamps, images, truth, notes, _stamps(list(depth)))


# ---------------------------------------------------------------------------------------------------------------------


def _numbered(root: Path, kind: str) -> dict[int, Path]:
    """Files of a kind by frame number, in order. Raises UserError: a number twice, a file outside the folder."""
    real_root = root.resolve()
    found: dict[int, Path] = {}
    for path in sorted(root.glob("frame-*")):
        match = _NAME.fullmatch(path.name)
        if match is None or not match[2].startswith(kind):
            continue
        if int(match[1]) in found:
            raise UserError(f"{path}: frame {int(match[1])} has {found[int(match[1])].name} already: remove one")
        found[int(match[1])] = listed_file(root, real_root, path.name, str(root), "unpack the dataset again")
    return dict(sorted(found.items()))


def _stamps(numbers: Sequence[int], idle: Sequence[int] = ()) -> FloatArray:
    """Seconds (n,) at which frames were taken. idle: numbers that take no time, increasing."""
    k = np.array(numbers, np.int64)
    return np.asarray(k - np.searchsorted(idle, k, side="right"), np.float64) / _RATE_HZ


def _idle(color: IntArray, depth: IntArray) -> list[int]:
    """Numbers at which neither camera has anything new. color (n,), depth (m,): those at which one repeats.

    Images of the two arrive apart, so that one may repeat a number before the other.
    """
    found: list[int] = []
    left = set(color.tolist())
    for k in depth.tolist():
        partner = next((i for i in (k, k - 1, k + 1) if i in left), None)
        if partner is not None:
            left.remove(partner)
            found.append(max(k, partner))
    return sorted(found)


def _without(files: dict[int, Path], again: npt.NDArray[np.bool_]) -> dict[int, Path]:
    return {k: path for (k, path), is_repeat in zip(files.items(), again, strict=True) if not is_repeat}


def _cameras(
    root: Path, camera_file: Path | None, color: Sequence[Path], depth: Sequence[Path]
) -> tuple[RigFile, tuple[str, ...]]:
    sizes = first_size(color, decode_color), first_size(depth, decode_depth)
    file = find_camera_file(root, camera_file)
    if file is not None:
        return read_rig(file, *sizes), ()
    if sizes != (_SIZE, _SIZE):
        shown = " and ".join("x".join(map(str, size)) for size in sizes)
        raise UserError(f"{root}: images are {shown}, and nothing states the cameras: write {root / 'camera.yaml'}")
    note = (
        f"the cameras are taken for 7-Scenes', global shutters, depth with fx {_DEPTH[0]:g}, colour with fx "
        f"{_COLOR[0]:g} and not registered: write {root / 'camera.yaml'} if you know them"
    )
    depth_camera, color_camera = (Camera(*_SIZE, *intrinsics) for intrinsics in (_DEPTH, _COLOR))
    rig = Rig(depth_camera, Shutter(), color_camera, Shutter(), se3.orthonormalise(_T_COLOR_DEPTH), sigma=DEFAULT_SIGMA)
    return RigFile(rig, _UNITS_PER_M, color_offset_s=0.0), (note,)


def _truth(paths: dict[int, Path], idle: Sequence[int]) -> tuple[Trajectory | None, int]:
    """Poses where there are any, and the number of files without one. idle: see `_stamps`."""
    poses = {k: T for k, path in paths.items() if (T := _pose(path)) is not None}
    if not poses:
        return None, len(paths)
    T = se3.orthonormalise(np.stack(list(poses.values())))
    return Trajectory(_stamps(list(poses), idle), T), len(paths) - len(poses)


def _pose(path: Path) -> FloatArray | None:
    """(4, 4), None if it is not finite. Raises UserError."""
    try:
        T = np.array(read_text(path).split(), np.float64).reshape(4, 4)
    except ValueError:
        raise UserError(f"{path}: expected the 16 numbers of a 4x4 pose") from None
    if not np.isfinite(T).all():
        return None
    R = np.clip(T[:3, :3], -2, 2)  # absurd numbers stay wrong, without overflow on the way
    if np.abs(R.T @ R - np.eye(3)).max() > _SKEW or np.linalg.det(R) < 0 or np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise UserError(f"{path}: is not a rigid motion: expected camera-to-world, rotation and translation in metres")
    return T
