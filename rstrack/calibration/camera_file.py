"""The camera.yaml of a calibration for `rstrack track --camera`: what was found, with 2 σ beside each value."""

from __future__ import annotations

from collections.abc import Sequence
from json import dumps
from typing import TYPE_CHECKING

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rstrack.calibration.parameters import (
    COLOR_LENS,
    COUNT,
    DEPTH,
    DEPTH_ERROR,
    DEPTH_LENS,
    DRIFT,
    EXTRINSICS,
    UNKNOWNS,
)

if TYPE_CHECKING:
    from rstrack.calibration.result import CameraCalibration


def camera_file_of(calibration: CameraCalibration) -> str:
    """Its content."""
    dataset, found, scans = calibration.dataset, calibration.upright(), calibration.scans()
    beside, timing, rig = _beside(calibration), dataset.timing, dataset.rig
    recordings = " ".join(calibration.clocks or (dataset.name,))
    lines = [f"# rstrack calibrate {recordings}, {len(calibration.parts)} stretches; ± is 2 sigma"]
    lines += [f"# {note}" for note in calibration.notes()]
    if timing is not None and timing.mode != "auto":
        lines.append(f"stamps: {timing.mode}")
    depth_camera, color_camera = calibration.cameras()
    color = _stream("color", color_camera, rig.color_shutter, found.color_readout_s, scans[1], beside[COLOR_LENS])
    color[-1] += beside[1]
    if calibration.clocks or (timing is not None and timing.is_jittered):
        # Of stamps that are arrival times: every recording has another.
        lines.append("clocks:")
        for name, (offset_s, drift) in (
            calibration.clocks or {dataset.name: (found.color_offset_s, found.color_drift)}
        ).items():
            more = f", drift_ppm: {1e6 * drift:.3f}" if drift else ""
            lines.append(f"  {dumps(name)}: {{offset_s: {offset_s - dataset.depth_offset_s:.7f}{more}}}")
        lines[-1] += beside[2]
    else:
        color.append(f"  offset_s: {found.color_offset_s - dataset.depth_offset_s:.7f}{beside[2]}")
        if found.color_drift:
            color.append(f"  drift_ppm: {1e6 * found.color_drift:.3f}{beside[DRIFT]}")
    depth = _stream("depth", depth_camera, rig.depth_shutter, found.depth_readout_s, scans[0], beside[DEPTH_LENS])
    depth[-1] += beside[0]
    depth.append(f"  depth_scale: {dataset.depth_scale:g}")
    error = calibration.values.depth_error
    if error.any():
        names = zip(DEPTH, error, beside[DEPTH_ERROR], strict=True)
        depth += ["  error:", *(f"    {name}: {value:.7g}{comment}" for name, value, comment in names)]
    axes = ", ".join(f"{UNKNOWNS[i].label.split(', ')[1]}{beside[i][3:]}" for i in range(COUNT)[EXTRINSICS])
    poses = ["T_color_depth:" + (f"  # {axes}" if calibration.asked[EXTRINSICS].any() else "")]
    poses += ["  - [" + ", ".join(f"{x:.12g}" for x in row) + "]" for row in found.T_color_depth]
    sigmas = ", ".join(f"{name}: {sigma:.3g}" for name, sigma in calibration.stated_sigmas().items())
    return "\n".join([*lines, *color, *depth, *poses, f"sigma: {{{sigmas}}}", ""])


def _beside(calibration: CameraCalibration) -> list[str]:
    """For each of the unknowns the comment beside its value."""
    sigmas, comments = calibration.absolute_sigmas, []
    for unknown, sigma, asked, undetermined in zip(
        UNKNOWNS, sigmas, calibration.asked, calibration.undetermined, strict=True
    ):
        comment = f"  # ± {2.0 * unknown.factor * sigma:.3g} {unknown.unit}" if asked else ""
        comments.append("  # undetermined, kept" if undetermined else comment)
    return comments


def _stream(
    name: str, camera: Camera, shutter: Shutter, readout_s: float, scan: Scan, beside: Sequence[str]
) -> list[str]:  # fmt: skip
    """beside: comments of LENS."""
    K = ", ".join(f"{x:.10g}" for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    bent = f"  distortion: [{', '.join(f'{x:.10g}' for x in camera.distortion)}]{_joined(beside[4:])}"
    return [
        f"{name}:",
        f"  width: {camera.width}",
        f"  height: {camera.height}",
        f"  intrinsics: [{K}]{_joined(beside[:4])}",
        *(() if camera.model == "pinhole" else (f"  model: {camera.model}", bent)),
        f"  exposure_s: {shutter.exposure_s:g}",
        f"  scan: {scan}",
        f"  readout_s: {readout_s:.7f}",
    ]


def _joined(comments: Sequence[str]) -> str:
    """The comments beside several values of a line as one."""
    stated = [comment.removeprefix("  # ") for comment in comments]
    return f"  # {'; '.join(stated)}" if all(stated) and stated else ""
