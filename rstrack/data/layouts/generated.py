"""Sequences of rsgen as a tracker gets them: exact, or as what a driver and a registration leave of them.

Where a sequence's listed stamps are a driver's, or its depth is registered, it is a recording like any other: cameras
as sequence.yaml states them, stamps that are arrival times (`rstrack.data.timing`), colour's offset not known.
Its truth is the pose of each depth frame when it was taken, under the stamp at which it is tracked. Cameras that are
declared wrong on purpose are given as they are declared; the truth is that of the cameras that took the images.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.camera_file import read_rig
from rstrack.data.dataset import Dataset, group_colors
from rstrack.data.registration import registered_shutter
from rstrack.data.rig import DEFAULT_SIGMA, EXACT_SIGMA, CalibrationSigma, Rig, sigma_of_file
from rstrack.data.timing import StampsMode, Timing, stream_timing


def matches(root: Path) -> bool:
    """Whether a folder is a sequence of rsgen."""
    return (root / "sequence.yaml").exists()


def read(root: Path, camera_file: Path | None, color: str | None = None, depth: str | None = None) -> Dataset:
    """A sequence, with the cameras that took it or with those of a camera file. Raises UserError.

    color, depth: of a rig, the two cameras by name; by default the first of either kind.
    """
    sequence = read_sequence(root, color, depth)
    if _is_exact(sequence):
        found = _exact(root, sequence)
    else:
        try:
            found = _recorded(root, sequence)
        except UserError as error:
            raise UserError(f"{root}: {error}") from None
    return found if camera_file is None else _seen_as(found, sequence, camera_file)


def _exact(root: Path, sequence: Sequence) -> Dataset:
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    noise = sequence.meta.get("noise")
    color_noise = noise.get("color") if isinstance(noise, dict) else None
    # What is rendered without a camera's noise has no corners that are darker: they need not be looked at.
    falloff = 0.0 if color_noise in (None, "none") else None
    rig = Rig(
        depth.camera, depth.shutter, color.camera, color.shutter, sequence.T_color_depth, falloff, sigma_of(sequence)
    )
    groups = group_colors(depth.stamps, color.stamps)
    return Dataset(
        sequence.name, root, rig, depth.stamps, color.stamps, groups, sequence, truth=sequence.spline,
        sequence=sequence, depth_scale=depth.depth_scale,
    )  # fmt: skip


def _is_exact(sequence: Sequence) -> bool:
    """Whether listed stamps are the true ones and depth is the sensor's own."""
    streams = sequence.streams.values()
    return not any(s.registered or (s.listed != s.stamps).any() for s in streams)


def sigma_of(sequence: Sequence) -> CalibrationSigma:
    """How far the cameras of sequence.yaml may be wrong: not at all, unless they are declared so on purpose.

    A depth camera with fixed errors of its own has them though its lens is stated: the σ are the default ones, since a
    user of such a camera knows no more.
    """
    sigma = sigma_of_file(sequence.streams["color"].camera) if sequence.meta.get("declared") else EXACT_SIGMA
    noise: Any = sequence.meta
    for name in ("config", "depth", "noise"):
        noise = noise.get(name) if isinstance(noise, dict) else None
    if isinstance(noise, dict) and any(noise.get(name) for name in ("scale_error", "distortion_px")):
        own = "depth_scale", "depth_inverse_offset", "depth_image"
        return replace(sigma, **{name: getattr(DEFAULT_SIGMA, name) for name in own})
    return sigma


def _recorded(root: Path, sequence: Sequence) -> Dataset:
    """A sequence with a driver's stamps or registered depth. Raises UserError where the rows of that have no order."""
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    shutter, late_s, T_color_depth = depth.shutter, 0.0, sequence.T_color_depth
    if depth.registered:
        shutter, late_s = registered_shutter(color.camera, depth.camera, depth.shutter, sequence.T_color_depth)
        T_color_depth = np.eye(4)
    rig = Rig(
        sequence.depth_image_camera, shutter, color.camera, color.shutter, T_color_depth, sigma=sigma_of(sequence)
    )
    has_driver = any((s.listed != s.stamps).any() for s in (color, depth))
    mode: StampsMode = "auto" if has_driver else "raw"
    timing = Timing(
        stream_timing("depth", depth.listed, mode, late_s),
        stream_timing("colour", color.listed, mode, 0.0),
        None if has_driver else 0.0,
    )
    T_world_depth = sequence.spline.pose(np.clip(depth.stamps + late_s, sequence.spline.t_begin, sequence.spline.t_end))
    poses = T_world_depth @ se3.inverse(sequence.as_taken.T_image_depth)
    stamps = timing.depth.used, timing.color.used
    return Dataset(
        sequence.name, root, rig, *stamps, group_colors(*stamps), sequence,
        truth_poses=Trajectory(timing.depth.used, poses), timing=timing, depth_scale=depth.depth_scale,
    )  # fmt: skip


def _seen_as(dataset: Dataset, sequence: Sequence, camera_file: Path) -> Dataset:
    """A generated sequence with other cameras than it was taken with. Raises UserError: not of its images' size."""
    sizes = [(c.width, c.height) for c in (dataset.rig.color_camera, dataset.rig.depth_camera)]
    file = read_rig(camera_file, *sizes).of(dataset.name)
    found = [(c.width, c.height) for c in (file.rig.color_camera, file.rig.depth_camera)]
    if found != sizes:
        shown = [" and ".join(f"{w}x{h}" for w, h in pair) for pair in (found, sizes)]
        raise UserError(f"{camera_file}: cameras (colour and depth) of {shown[0]} pixels, but images are {shown[1]}")
    seen = replace(
        dataset.seen_with(file.rig), notes=(*dataset.notes, *file.notes), scan_named=file.scan_named,
        depth_error=file.depth_error,
    )  # fmt: skip
    if file.scale_named:
        depth = replace(sequence.streams["depth"], depth_scale=file.depth_scale)
        scaled = replace(sequence, streams=sequence.streams | {"depth": depth})
        seen = replace(seen, images=scaled, depth_scale=file.depth_scale)
    if file.color_offset_s is None:
        return replace(seen, color_drift=file.color_drift)
    return seen.with_color_offset(file.color_offset_s, drift=file.color_drift)
