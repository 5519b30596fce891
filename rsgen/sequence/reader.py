"""Sequence folders: read one, strictly, and say what it holds.

sequence = read_sequence(Path("out/lr_kt2"))
z, rows = sequence.depth(0), sequence.rows("depth")[0]     # metres (h, w); T_world_depth of each line (h, 7)

A rig of any cameras (format 2) is read by `read_rig`; `Rig.pair` makes a sequence of a colour and a depth camera of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import listed_file, read_text
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.limits import rigid
from rsgen.sequence.camera_yaml import TRUE_CAMERAS
from rsgen.sequence.format import (
    FILES,
    STAMP_TOLERANCE_S,
    Line,
    RigStreamYaml,
    RigYaml,
    StreamFiles,
    StreamKind,
    StreamYaml,
    parse_listing,
    read_sequence_yaml,
    rig_files,
)
from rsgen.sequence.images import ImageStream, Rig, Sequence
from rsgen.sequence.truth_files import FrameTable, read_frame_table, read_objects

_LONGEST_S = 1e6  # as long as stamps may grow


def read_sequence(path: Path, color: str | None = None, depth: str | None = None) -> Sequence:
    """Read the description, listings and spline of a sequence folder; images are read when asked for.

    color, depth: the cameras of a rig that are taken, by default its first of either kind. Raises UserError, one line:
    the folder or one of its files is missing or damaged, of another format version, a listing is malformed (naming the
    line), its stamps do not increase, or one of its paths leaves the folder; a rig has no such camera.
    """
    found = read_rig(path)
    if isinstance(found, Sequence) and color in (None, "color") and depth in (None, "depth"):
        return found
    return found.pair(color, depth)


def read_rig(path: Path) -> Rig:
    """As `read_sequence`, with all cameras; of a folder of format 1 it is a `Sequence`. Raises UserError."""
    root = Path(path)
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; expected a sequence that 'rsgen render' wrote")
    if not (root / "sequence.yaml").exists():
        raise UserError(f"{root}: has no sequence.yaml, so it is not a sequence that 'rsgen render' wrote")
    description, meta = read_sequence_yaml(root / "sequence.yaml")
    if isinstance(description, RigYaml):
        streams = {name: _rig_stream(root, name, yaml) for name, yaml in description.streams.items()}
    else:
        T_color_depth = _pose(root, "T_color_depth", description.T_color_depth)
        both = description.streams
        streams = {
            "color": _read_stream(root, "color", both.color, FILES["color"], "color", T_color_depth, description.truth),
            "depth": _read_stream(root, "depth", both.depth, FILES["depth"], "depth", np.eye(4), {}),
        }
    spline = _read_spline(root / "spline.npz", streams)
    objects = read_objects(root, description.objects, *_span(streams)) if description.objects else ()
    if isinstance(description, RigYaml):
        return Rig(root, description.name, streams, spline, meta, objects)
    return Sequence(root, description.name, streams, spline, meta, objects, T_color_depth)


def _pose(root: Path, name: str, rows: Any) -> FloatArray:
    try:
        return rigid(rows)
    except ValueError as error:
        raise UserError(f"{root / 'sequence.yaml'}: {name}: {error}") from None


def _rig_stream(root: Path, name: str, yaml: RigStreamYaml) -> ImageStream:
    T_body_cam = _pose(root, f"streams.{name}.T_body_cam", yaml.T_body_cam)
    return _read_stream(root, name, yaml, rig_files(name), yaml.kind, se3.inverse(T_body_cam), yaml.truth)


def _span(streams: dict[str, ImageStream]) -> tuple[float, float]:
    """First and last stamp of all images, s."""
    return min(float(s.stamps[0]) for s in streams.values()), max(float(s.stamps[-1]) for s in streams.values())


def _read_spline(path: Path, streams: dict[str, ImageStream]) -> Spline:
    """The spline, which has to cover the frames and not much more: a huge knot spacing would take all memory."""
    spline = Spline.load(path)
    first, last = _span(streams)
    if not (spline.t_begin - STAMP_TOLERANCE_S <= first and last <= spline.t_end + STAMP_TOLERANCE_S):
        raise UserError(
            f"{path}: covers {spline.t_begin:g} to {spline.t_end:g} s, the frames {first:g} to {last:g} s: "
            "restore it or render again"
        )
    if not spline.t_end - spline.t_begin <= _LONGEST_S:
        raise UserError(f"{path}: lasts {spline.t_end - spline.t_begin:g} s, absurdly long: restore it or render again")
    return spline


def _read_stream(
    root: Path, name: str, yaml: StreamYaml, files: StreamFiles, kind: StreamKind, T_cam_body: FloatArray,
    truth: dict[str, tuple[str, ...]],
) -> ImageStream:  # fmt: skip
    if kind == "depth" and yaml.depth_scale is None:
        raise UserError(f"{root / 'sequence.yaml'}: streams.{name}.depth_scale is missing")
    listing = root / files.listing
    lines = parse_listing(listing, read_text(listing))
    if not lines:
        raise UserError(f"{listing}: lists no frame: run 'rsgen render' again to finish it")
    real_root = root.resolve()
    missing = "run the same 'rsgen render' again"
    paths = tuple(listed_file(root, real_root, line.path, f"{listing} line {line.number}", missing) for line in lines)
    indices = np.array([_frame_number(listing, line, yaml) for line in lines], np.int64)
    listed = np.array([line.stamp for line in lines])
    table = _table_of(root / files.frame_table, indices) if yaml.frame_table else None
    with np.errstate(over="ignore"):  # of an absurd rate, which fits no stamp
        expected = yaml.first_stamp_s + indices / yaml.rate_hz if table is None else table.listed_s
    for k in np.flatnonzero(np.abs(listed - expected) > STAMP_TOLERANCE_S)[:1]:
        raise UserError(
            f"{listing} line {lines[k].number}: stamp {listed[k]:.9f} is not that of frame {indices[k]}, "
            f"{expected[k]:.9f}"
        )
    stamps = listed if table is None else table.taken_s
    try:
        camera, shutter = yaml.camera, yaml.shutter
    except UserError as error:
        raise UserError(f"{root / 'sequence.yaml'}: streams.{name}: {error}") from None
    scale = yaml.depth_scale if kind == "depth" and yaml.depth_scale is not None else 0.0
    clock = (yaml.rate_hz, yaml.offset_s, scale, yaml.frames, yaml.first_stamp_s)
    return ImageStream(
        name, camera, shutter, *clock, stamps, listed, paths, indices, yaml.registered, table, kind, files, T_cam_body,
        truth,
    )  # fmt: skip


def _table_of(path: Path, indices: IntArray) -> FrameTable:
    """The frame table's lines of these frames. Raises UserError."""
    table = read_frame_table(path)
    if absent := sorted(set(indices.tolist()) - set(table.frame.tolist())):
        raise UserError(f"{path}: has no frame {absent[0]}: render again to write it")
    return table.of(indices)


def _frame_number(listing: Path, line: Line, yaml: StreamYaml) -> int:
    """Frame number of a listed file, from its name."""
    where, stem = f"{listing} line {line.number}", Path(line.path).stem
    if not (stem.isascii() and stem.isdigit() and len(stem) <= 9 and int(stem) < yaml.frames):
        raise UserError(f"{where}: {line.path!r} is not one of the sequence's {yaml.frames} frames")
    return int(stem)


def sequence_info(path: Path) -> str:
    """Text for `rsgen info`: what is in a sequence folder. Raises UserError."""
    sequence = read_rig(path)
    knots = sequence.spline
    rows = [("name", sequence.name)]
    for name, s in sequence.streams.items():
        frames = f"{len(s.paths)} frames" if len(s.paths) == s.frames else f"{len(s.paths)} of {s.frames} frames"
        scale = f", {s.depth_scale:g} units per metre" if s.depth_scale else ""
        kind = "" if name == s.kind else f"{s.kind}, "
        c = s.camera
        rows += [
            (name, f"{kind}{frames} at {s.rate_hz:g} Hz, {s.stamps[0]:.3f} to {s.stamps[-1]:.3f} s"),
            ("", f"{c.width}x{c.height} {c.model}, fx {c.fx:g} fy {c.fy:g} cx {c.cx:g} cy {c.cy:g}{scale}"),
            ("", _shutter_text(s)),
        ]
    first, last = _span(sequence.streams)
    times = np.linspace(first, last, min(max(2, round((last - first) * 1000)), 1_000_000))
    p_world = knots.pose(np.clip(times, knots.t_begin, knots.t_end))[:, :3, 3]
    length = np.linalg.norm(np.diff(p_world, axis=0), axis=1).sum()
    size = sum(file.stat().st_size for file in sequence.root.rglob("*") if file.is_file())
    if sequence.meta.get("declared"):
        rows.append(("declared", f"cameras are claims, not the truth, which {TRUE_CAMERAS} has"))
    if sequence.objects:
        rows.append(("objects", ", ".join(thing.name for thing in sequence.objects)))
    rows += [
        ("duration", f"{last - first:.3f} s"),
        ("trajectory", f"{length:.3f} m, {len(knots.control_points)} control points every {knots.dt * 1000:g} ms"),
        ("noise", str(sequence.meta.get("noise") or "none")),
        ("on disk", f"{size / 1e6:.1f} MB"),
    ]
    return "\n".join(f"{label:<11} {text}" for label, text in rows)


def _shutter_text(stream: ImageStream) -> str:
    shutter, delay = stream.shutter, stream.shutter.line_delay(stream.camera)
    rolling = f"readout {shutter.readout_s * 1000:g} ms {shutter.scan}, line delay {delay * 1e6:.3f} us"
    return f"{rolling if shutter.readout_s else 'global shutter'}, exposure {shutter.exposure_s * 1000:g} ms"
