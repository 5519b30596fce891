"""Check that a sequence folder is whole and agrees with itself: files, clocks, poses, and depth against depth.

What has been written twice is compared (rows' poses and groundtruth.txt against the spline, 16-bit depth against the
exact one), and neighbouring depth frames are compared through their rows' poses: that fails where images were rendered
with other poses, times or intrinsics than those the folder states.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.check.extras import extra_checks
from rsgen.check.reprojection import check_raycast, check_reprojection, check_scene
from rsgen.errors import UserError
from rsgen.files import is_temporary, read_text
from rsgen.geometry import se3
from rsgen.produce.records import fingerprint
from rsgen.sensors.reports import reported_poses, sequence_mocap
from rsgen.sequence.format import STAMP_TOLERANCE_S, STREAMS, associate, line_poses, pose_rows
from rsgen.sequence.images import COLOR_DEPTH, ImageStream, Rig, Sequence
from rsgen.sequence.reader import read_rig

# Rows' poses and groundtruth.txt come from the same spline: only the rounding of stamps (5e-10 s) and digits is left.
POSE_TOLERANCE_M = 1e-7
POSE_TOLERANCE_RAD = 1e-7


@dataclass(frozen=True)
class Check:
    """One thing that was checked: its name, whether it holds, and the figures or the first fault."""

    name: str
    ok: bool
    detail: str


@dataclass(frozen=True)
class Verification:
    """All checks of a sequence."""

    path: Path
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """True if every check holds."""
        return all(check.ok for check in self.checks)

    def text(self) -> str:
        """One line a check and a verdict."""
        lines = [f"{'ok' if check.ok else 'FAIL':<5}{check.name:<16}{check.detail}" for check in self.checks]
        failed = sum(not check.ok for check in self.checks)
        verdict = "all checks passed" if self.ok else f"{failed} of {len(self.checks)} checks failed"
        return "\n".join([*lines, f"{self.path}: {verdict}"])


def verify_sequence(path: Path, pairs: int = 20, raycast: int = 0) -> Verification:
    """Check the sequence at `path`, reprojecting depth between `pairs` pairs of neighbouring frames spread over it.

    `raycast` frames are cast again, every pixel, with another ray caster (needs embreex).

    Faults in the data are failed checks, never exceptions.
    """
    path = Path(path)
    try:
        stated = read_rig(path)
        sequence = stated.as_taken
    except UserError as error:
        return Verification(path, (Check("read", False, str(error)),))
    depths = [name for name, stream in sequence.streams.items() if stream.is_depth]
    checks: list[tuple[str, Callable[[], tuple[bool, str]]]] = [
        ("description", partial(_check_description, stated)),
        ("files", partial(_check_files, sequence)),
        ("clocks", partial(_check_clocks, sequence)),
        ("images", partial(_check_images, sequence)),
        *((f"rows {name}", partial(_check_rows, sequence, name)) for name in sequence.streams),
        ("ground truth", partial(_check_ground_truth, sequence)),
        ("scene", partial(check_scene, sequence)),
        *((_titled("reprojection", depths, name), partial(check_reprojection, sequence, name, pairs))
          for name in depths),
    ]  # fmt: skip
    checks += extra_checks(sequence)
    if raycast:
        # Of two cameras depth alone, as always; of a rig all whose exact depth is there.
        of_rig = [name for name, s in sequence.streams.items() if s.is_depth or COLOR_DEPTH in s.truth_images]
        cast = depths if isinstance(sequence, Sequence) else of_rig
        checks += [
            (_titled("ray casting", cast, name), partial(check_raycast, sequence, name, raycast)) for name in cast
        ]
    return Verification(path, tuple(_run(name, check) for name, check in checks))


def _titled(what: str, cameras: list[str], name: str) -> str:
    return what if len(cameras) == 1 else f"{what} {name}"


def _run(name: str, check: Callable[[], tuple[bool, str]]) -> Check:
    try:
        return Check(name, *check())
    except UserError as error:
        return Check(name, False, str(error))


def _check_description(sequence: Rig) -> tuple[bool, str]:
    """sequence.yaml is as it was written: its streams are those of its config, and the fingerprint is theirs."""
    meta, config = sequence.meta, sequence.meta.get("config")
    if not isinstance(config, dict):
        return False, "sequence.yaml holds no config"
    declared = _said(config.get("declared"))
    cameras = config if isinstance(sequence, Sequence) else _said(config.get("streams"))
    for name in sequence.streams:
        stated, asked = meta["streams"][name], cameras.get(name)
        if not isinstance(asked, dict):
            return False, f"config.{name} is missing in sequence.yaml"
        asked = asked | {"size": [asked.get("width"), asked.get("height")]} | _said(declared.get(name))
        for field in stated.keys() & asked.keys():
            if stated[field] != asked[field]:
                return False, f"streams.{name}.{field} is {stated[field]}, but config says {asked[field]}"
    if isinstance(sequence, Sequence):
        asked = {"T_color_depth": config.get("T_color_depth")} | _said(declared)
        if asked["T_color_depth"] != meta["T_color_depth"]:
            return False, "T_color_depth is not that of config"
    try:
        found = fingerprint({key: meta.get(key) for key in ("config", "inputs", "versions")})
    except (TypeError, ValueError):  # no numbers and words only, so not what was written
        found = ""
    if found != meta.get("fingerprint"):
        return False, "sequence.yaml was edited: its fingerprint is another one"
    return True, f"fingerprint {found[:16]}"


def _said(section: Any) -> dict[str, Any]:
    """The fields of a section of `declared` that say something."""
    return {key: value for key, value in section.items() if value is not None} if isinstance(section, dict) else {}


def _check_files(sequence: Rig) -> tuple[bool, str]:
    counts = []
    for name, stream in sequence.streams.items():
        _compare_names(sequence.root / stream.files.images, {path.name for path in stream.paths})
        part = "" if len(stream.paths) == stream.frames else f" of {stream.frames} (rendered in part)"
        counts.append(f"{len(stream.paths)} {name}{part}")
        if stream.is_depth:
            exact = {f"{path.stem}.exr" for path in stream.paths}
            _compare_names(sequence.root / stream.files.exact_depth, exact)
    pairs = f", {_read_pairs(sequence)} pairs" if isinstance(sequence, Sequence) else ""
    return True, ", ".join(counts) + pairs


def _compare_names(folder: Path, listed: set[str]) -> None:
    try:
        there = {path.name for path in folder.iterdir() if not is_temporary(path)}
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror})") from None
    if missing := sorted(listed - there):
        raise UserError(f"{folder / missing[0]}: is missing ({len(missing)} in all): render again to complete")
    if extra := sorted(there - listed):
        raise UserError(f"{folder / extra[0]}: is in no listing ({len(extra)} in all): render again to list it")


def _read_pairs(sequence: Sequence) -> int:
    """Number of pairs in associations.txt. Raises UserError if they are not those of the listings."""
    path = sequence.root / "associations.txt"
    color, depth = (sequence.streams[name] for name in STREAMS)
    expected = [
        (*_entry(sequence, color, i), *_entry(sequence, depth, j))
        for i, j in associate(color.listed, depth.listed, 0.5 / min(color.rate_hz, depth.rate_hz))
    ]
    found = [] if path.is_file() and not path.stat().st_size else read_text(path).splitlines()
    for number, (line, pair) in enumerate(zip(found, expected, strict=False), 1):
        if tuple(line.split()) != pair:
            raise UserError(f"{path} line {number}: expected '{' '.join(pair)}', found '{line[:80]}'")
    if len(found) != len(expected):
        raise UserError(f"{path}: holds {len(found)} pairs, {len(expected)} expected")
    return len(found)


def _entry(sequence: Sequence, stream: ImageStream, k: int) -> tuple[str, str]:
    return f"{stream.listed[k]:.9f}", stream.paths[k].relative_to(sequence.root).as_posix()


def _check_clocks(sequence: Rig) -> tuple[bool, str]:
    """True stamps against first stamp and rate; the reader has compared the listed ones with what they should be."""
    details, ok = [], True
    for name, stream in sequence.streams.items():
        shows = stream.indices if stream.table is None else stream.table.shows
        error = np.abs(stream.stamps - (stream.first_stamp_s + shows / stream.rate_hz)).max()
        ok &= bool(error <= STAMP_TOLERANCE_S and (np.diff(stream.indices) > 0).all())
        late = 1e3 * (stream.listed - stream.stamps)
        listed = f", listed {late.mean():+.1f} ms, {late.std():.1f} ms RMS" if late.any() else ""
        details.append(f"{name} {stream.rate_hz:g} Hz within {error * 1e9:.1f} ns{listed}")
    return ok, ", ".join(details)


def _check_images(sequence: Rig) -> tuple[bool, str]:
    worst, where = 0.0, ""
    with ThreadPoolExecutor() as pool:
        for name, stream in sequence.streams.items():
            of_frame = partial(_quantisation_error if stream.is_depth else _decodes, sequence, name)
            units = list(pool.map(of_frame, range(len(stream.paths))))
            if max(units, default=0.0) > worst:
                worst, where = max(units), f" ({stream.paths[int(np.argmax(units))]})"
    if any(_is_noisy(sequence, name) for name, stream in sequence.streams.items() if stream.is_depth):
        return True, "all decode (noise or registration is on: 16-bit depth not compared with the exact one)"
    detail = f"all decode, 16-bit depth within {worst:.3f} units of the exact one"
    return worst <= 0.5 + 1e-6, detail + (where if worst > 0.5 + 1e-6 else "")


def _is_noisy(sequence: Rig, name: str) -> bool:
    """Whether a depth camera reports other depths than the exact ones."""
    return _said(sequence.meta.get("noise")).get(name, "none") != "none" or sequence.streams[name].registered


def _decodes(sequence: Rig, name: str, k: int) -> float:
    sequence.picture(name, k)
    return 0.0


def _quantisation_error(sequence: Rig, name: str, k: int) -> float:
    """Largest difference in stored units between depth k and exact depth k; inf where one of them is missing."""
    units, exact = sequence.units(name, k), sequence.exact_depth(name, k)
    if _is_noisy(sequence, name):
        return 0.0
    expected = exact.astype(np.float64) * sequence.streams[name].depth_scale
    # A value that rounds to 0 or beyond 16 bits is stored as nothing.
    storable = (expected > 0.5) & (expected < 65535.5)
    if (units[~storable] > 0).any() or (units[storable] == 0).any():
        return math.inf
    return float(np.abs(units[storable] - expected[storable]).max(initial=0.0))


def _check_rows(sequence: Rig, name: str) -> tuple[bool, str]:
    stream = sequence.streams[name]
    found = sequence.rows(name)
    exposure_s = None if stream.table is None else stream.table.exposure_s
    expected = line_poses(sequence.spline, stream.camera, stream.shutter, stream.stamps, stream.T_cam_body, exposure_s)
    ok, detail, worst = _pose_errors(found.reshape(-1, 7), expected.reshape(-1, 7))
    frame, line = divmod(worst, stream.line_count)
    where = "" if ok else f", worst in frame {stream.indices[frame]}, line {line}"
    return ok, f"{found.shape[0]}x{found.shape[1]} poses, against the spline {detail}{where}"


def _pose_errors(found: FloatArray, expected: FloatArray) -> tuple[bool, str, int]:
    """Whether rows (n, 7) agree, the largest errors in words, and where the translation's is."""
    metres = np.linalg.norm(found[:, :3] - expected[:, :3], axis=-1)
    norm = np.linalg.norm(found[:, 3:], axis=-1)
    sign = np.sign(np.einsum("ni,ni->n", found[:, 3:], expected[:, 3:]))[:, None]
    radians = 2 * np.linalg.norm(found[:, 3:] * sign - expected[:, 3:], axis=-1)  # |2 sin(angle / 2)| for small angles
    good = (metres <= POSE_TOLERANCE_M) & (radians <= POSE_TOLERANCE_RAD) & (np.abs(norm - 1) <= 1e-8)
    worst = int(np.argmax(np.maximum(metres, radians)))
    return bool(good.all()), f"max {metres.max():.1e} m, {radians.max():.1e} rad", worst


def _check_ground_truth(sequence: Rig) -> tuple[bool, str]:
    T_image_body = sequence.T_image_depth if isinstance(sequence, Sequence) else np.eye(4)
    path = sequence.root / "groundtruth.txt"
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    try:
        rows = np.array([[float(field) for field in line.split()] for line in lines])
    except ValueError:
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[1] != 8 or not np.isfinite(rows).all():
        raise UserError(f"{path}: expected lines of 8 numbers 'stamp tx ty tz qx qy qz qw'")
    if (np.diff(rows[:, 0]) <= 0).any():
        raise UserError(f"{path}: stamps do not increase")
    if (mocap := sequence_mocap(sequence)) is not None:
        expected = reported_poses(sequence.spline, *mocap, T_image_body)
        if len(rows) != len(expected) or np.abs(rows[:, 0] - expected[:, 0]).max() > STAMP_TOLERANCE_S:
            return False, "its stamps are not those of the motion capture in config.mocap"
        ok, detail, _ = _pose_errors(rows[:, 1:], expected[:, 1:])
        return ok, f"{len(rows)} poses, against what config.mocap makes of the spline {detail}"
    stamps = np.concatenate([stream.stamps for stream in sequence.streams.values()])
    if lacking := int((~np.isin(stamps, rows[:, 0])).sum()):
        return False, f"{lacking} of {len(stamps)} frame stamps are not in it"
    T = sequence.spline.pose(rows[:, 0]) @ se3.inverse(T_image_body)
    ok, detail, _ = _pose_errors(rows[:, 1:], pose_rows(T))
    return ok, f"{len(rows)} poses, against the spline {detail}"
