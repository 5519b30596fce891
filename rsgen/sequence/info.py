"""What is in a sequence folder, in words: `rsgen info`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsgen.geometry.shutter import Shutter
from rsgen.sequence.camera_yaml import TRUE_CAMERAS
from rsgen.sequence.reader import read_rig


def sequence_info(path: Path) -> str:
    """Text for `rsgen info`: what is in a sequence folder. Raises UserError."""
    sequence = read_rig(path)
    knots = sequence.spline
    rows = [("name", sequence.name)]
    for name, s in sequence.streams.items():
        delay = s.shutter.line_delay(s.camera)
        frames = f"{len(s.paths)} frames" if len(s.paths) == s.frames else f"{len(s.paths)} of {s.frames} frames"
        span = f", {s.stamps[0]:.3f} to {s.stamps[-1]:.3f} s" if len(s.paths) else ""
        scale = f", {s.depth_scale:g} units per metre" if s.depth_scale else ""
        kind = "" if name == s.kind else f"{s.kind}, "
        c = s.camera
        rows += [
            (name, f"{kind}{frames} at {s.rate_hz:g} Hz{span}"),
            ("", f"{c.width}x{c.height} {c.model}, fx {c.fx:g} fy {c.fy:g} cx {c.cx:g} cy {c.cy:g}{scale}"),
            ("", _shutter_text(s.shutter, delay)),
        ]
    last = max((s.stamps[-1] for s in sequence.streams.values() if len(s.stamps)), default=knots.t_begin)
    first = min((s.stamps[0] for s in sequence.streams.values() if len(s.stamps)), default=knots.t_begin)
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


def _shutter_text(shutter: Shutter, delay: float) -> str:
    if shutter.readout_s == 0:
        readout = "global shutter"
    else:
        readout = f"readout {shutter.readout_s * 1000:g} ms {shutter.scan}, line delay {delay * 1e6:.3f} us"
    return f"{readout}, exposure {shutter.exposure_s * 1000:g} ms"
