"""Checks of `rsgen verify` on what a sequence may carry beside its two streams: exact images and IMU samples."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from rsgen.array_types import UInt16Array
from rsgen.errors import UserError
from rsgen.files import is_temporary, read_text, read_yaml
from rsgen.geometry import se3
from rsgen.sensors.imu import IMU_TRUTH_CSV, IMU_TRUTH_YAML, imu_csv, imu_truth_csv
from rsgen.sensors.reports import sequence_imu, sequence_target
from rsgen.sequence.camera_yaml import TRUE_CAMERAS
from rsgen.sequence.format import STREAMS, ground_truth, pose_lines
from rsgen.sequence.images import ImageStream, Rig, Sequence
from rsgen.sequence.truth_files import TARGET_CORNERS, poses_file, target_corners_text

_BOX_M = 1e-4  # what depth in float32 and a line's rounding leave
_WORDS = {"color": "colour"}  # names as they are written in words


def check_truth_images(sequence: Rig) -> tuple[bool, str]:
    """Every frame has every exact image, all decode and are finite. Raises UserError naming the file."""
    names: dict[str, int] = {}
    for stream in sequence.streams.values():
        for name, channels in stream.truth_images.items():
            folder = sequence.root / stream.files.truth / name
            listed = {sequence.root / stream.files.truth_image(name, channels, path.stem) for path in stream.paths}
            there = {path for path in folder.iterdir() if not is_temporary(path)} if folder.is_dir() else set()
            if odd := sorted(listed ^ there):
                owner = _WORDS.get(stream.name, stream.name)
                what = "is missing" if odd[0] in listed else f"belongs to no {owner} frame"
                raise UserError(f"{odd[0]}: {what} ({len(odd)} in all): render again to complete")
            read = partial(sequence.exact_image, stream.name, name)
            with ThreadPoolExecutor() as pool:
                if not all(pool.map(lambda k, read=read: bool(np.isfinite(read(k)).all()), range(len(stream.paths)))):
                    raise UserError(f"{folder}: holds numbers that are not finite: render again")
            names[name] = names.get(name, 0) + len(stream.paths)
    return True, f"{', '.join(names)}: {max(names.values())} each, all decode"


def check_imu(sequence: Rig) -> tuple[bool, str]:
    """imu.csv is what the spline and the recorded settings give. Raises UserError."""
    found = sequence_imu(sequence)
    assert found is not None
    path = sequence.root / "imu.csv"
    try:
        rows, expected = (np.array([line.split(",") for line in text.splitlines()[1:]], float)
                          for text in (read_text(path), imu_csv(found[1])))  # fmt: skip
    except ValueError:
        raise UserError(f"{path}: expected lines of 7 numbers: render again to write it") from None
    if rows.shape != expected.shape:
        return False, f"{path}: {len(rows)} samples, {len(expected)} expected"
    worst = float(np.abs(rows - expected)[:, 1:].max())
    ok = np.array_equal(rows[:, 0], expected[:, 0]) and worst < 1e-9
    if found.config.has_truth(found.faults):
        truth = sequence.root / IMU_TRUTH_CSV
        if read_text(truth) != imu_truth_csv(found[1]):
            return False, f"{truth}: is not what the spline and the settings give: render again to write it"
        if not (sequence.root / IMU_TRUTH_YAML).is_file():
            return False, f"{sequence.root / IMU_TRUTH_YAML}: is missing: render again to write it"
    return ok, f"{len(rows)} samples, within {worst:.1e} of what the spline gives"


def check_true_cameras(sequence: Sequence, config: dict[str, Any]) -> tuple[bool, str]:
    """truth/cameras.yaml, whose cameras all checks go by, has those of the config. Raises UserError."""
    stated = read_yaml(sequence.root / TRUE_CAMERAS)
    for name in STREAMS:
        camera = stated[name] | stated[name].get("sensor", {})
        camera.pop("offset_s", None)  # of colour's clock against depth's, not of its first frame
        for field in camera.keys() & config[name].keys():
            if camera[field] != config[name][field]:
                return (
                    False,
                    f"{TRUE_CAMERAS}: {name}.{field} is {camera[field]}, but config says {config[name][field]}",
                )
    if not np.array_equal(sequence.T_color_depth, config["T_color_depth"]):
        return False, f"{TRUE_CAMERAS}: T_color_depth is not that of config"
    return True, f"{TRUE_CAMERAS} has them, sequence.yaml declares others"


def check_target(sequence: Rig) -> tuple[bool, str]:
    """truth/target_corners.txt has the corners of the config's target. Raises UserError."""
    target = sequence_target(sequence)
    assert target is not None
    expected = target_corners_text(target.grid, np.array(target.T_world_target, float))
    if read_text(sequence.root / TARGET_CORNERS) != expected:
        return False, f"{TARGET_CORNERS} is not that of config.target: render again to write it"
    return True, f"{target.grid.tag_count} tags, corners as config.target has them"


def check_labels(sequence: Rig) -> tuple[bool, str]:
    """Every frame has labels of the table, and points that depth sees lie in their things' boxes. Raises UserError."""
    seen = np.zeros(len(sequence.label_table) + 1, np.int64)
    for name, stream in sequence.streams.items():
        for k in range(len(stream.paths)):
            labels = sequence.labels(name, k)
            seen += np.bincount(labels.ravel(), minlength=len(seen))
            if stream.is_depth and not _within_boxes(sequence, stream, k, labels):
                return False, f"{sequence.root / stream.files.labels / stream.paths[k].name}: is not of that frame"
    classes = {label.class_name for label in sequence.label_table}
    return True, f"{len(seen) - 1} things of {len(classes)} classes, {int((seen[1:] > 0).sum())} of them seen"


def _within_boxes(sequence: Rig, stream: ImageStream, k: int, labels: UInt16Array) -> bool:
    """Whether something is labelled just where there is depth, and points at rest are in the boxes of their things."""
    z = sequence.exact_depth(stream.name, k)
    if ((labels > 0) != (z > 0)).any():
        return False
    still = (z > 0) & (labels <= len(sequence.label_table) - len(sequence.objects))
    uv = stream.camera.pixel_grid()[still]
    p_world = se3.transform(sequence.pixel_poses(stream.name, k, uv), stream.camera.backproject(uv, z[still]))
    low, high = np.array([label.box for label in sequence.label_table]).transpose(1, 0, 2)[:, labels[still] - 1]
    return bool(((p_world >= low - _BOX_M) & (p_world <= high + _BOX_M)).all())


def check_objects(sequence: Rig) -> tuple[bool, str]:
    """Poses of all objects are what their splines give, and every exact image has a mask that decodes.

    Raises UserError.
    """
    stamps = [stream.stamps for stream in sequence.streams.values()]
    for thing in sequence.objects:
        path = sequence.root / poses_file(thing.name)
        try:
            found = np.loadtxt(read_text(path).splitlines(), ndmin=2)
        except ValueError:
            raise UserError(f"{path}: expected lines of 8 numbers 'stamp tx ty tz qx qy qz qw'") from None
        expected = np.loadtxt(pose_lines("", ground_truth(thing.spline, *stamps)), ndmin=2)
        at = np.isin(found[:, 0], expected[:, 0]) if found.ndim == 2 and found.shape[1] == 8 else np.zeros(1, bool)
        if at.sum() != len(expected) or np.abs(found[at] - expected).max() > 1e-9:
            return False, f"{path}: is not what the object's spline gives: render again to write it"
    seen = []
    for name, stream in sequence.streams.items():
        ids = np.concatenate([sequence.object_ids(name, k).ravel() for k in range(len(stream.paths))])
        seen.append(f"{100 * float((ids > 0).mean()):.1f} % of {_WORDS.get(name, name)}'s pixels")
    return True, f"{', '.join(thing.name for thing in sequence.objects)}: {', '.join(seen)}"


def extra_checks(sequence: Rig) -> list[tuple[str, Callable[[], tuple[bool, str]]]]:
    """Those of the checks that concern this sequence, by name."""
    config = sequence.meta.get("config")
    checks: list[tuple[str, Callable[[], tuple[bool, str]]]] = []
    if isinstance(sequence, Sequence) and isinstance(config, dict) and config.get("declared") is not None:
        checks.append(("true cameras", partial(check_true_cameras, sequence, config)))
    if isinstance(config, dict) and config.get("target") is not None:
        checks.append(("target", partial(check_target, sequence)))
    if sequence.label_table:
        checks.append(("labels", partial(check_labels, sequence)))
    if sequence.objects:
        checks.append(("objects", partial(check_objects, sequence)))
    if any(stream.truth_images for stream in sequence.streams.values()):
        checks.append(("truth images", partial(check_truth_images, sequence)))
    if isinstance(config, dict) and config.get("imu") is not None:
        checks.append(("imu", partial(check_imu, sequence)))
    return checks
