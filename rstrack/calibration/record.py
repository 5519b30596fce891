"""The files of a calibration: camera.yaml, for `rstrack track --camera`, and calibration.json, for `rstrack report`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rsgen.errors import UserError, first_problem
from rsgen.files import atomic_write, read_text
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
from rstrack.calibration.result import CameraCalibration

CALIBRATION = "calibration.json"

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class _Stored(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Shown(_Stored):
    """How a value is called on the screen, its unit there, and the factor from the SI unit to that."""

    label: str
    unit: str
    factor: _Finite


class Parameter(_Stored):
    """SI units. sigma: None where undetermined. told_by_stretch (s,): parts of what is known of it, 0..1."""

    value: _Finite
    start: _Finite
    sigma: _Positive | None
    state: Literal["found", "undetermined"]
    told_by_stretch: tuple[_Positive, ...]
    shown: Shown
    useful_sigma: _Positive
    needs: str

    @property
    def is_found(self) -> bool:
        """Whether the recording determines it."""
        return self.sigma is not None


class Change(_Stored):
    """Of a residual's scale."""

    before: _Positive
    after: _Positive


class StoredResiduals(_Stored):
    """Scales with the values and the track before and after: m, and intensity of 0 to 1."""

    depth_m: Change
    intensity: Change


class StoredPace(_Stored):
    """How fast the camera moved and turned (n,), at times (n,) in s since the first frame."""

    time_s: tuple[_Finite, ...]
    m_s: tuple[_Positive, ...]
    rad_s: tuple[_Positive, ...]


class LensMap(_Stored):
    """Points of an image (n, 2), how far a lens has moved them (n, 2), and σ of that (n, 1); px."""

    at_px: tuple[tuple[_Finite, _Finite], ...]
    moved_px: tuple[tuple[_Finite, _Finite], ...]
    sigma_px: tuple[tuple[_Positive], ...]

    @model_validator(mode="after")
    def _fits(self) -> LensMap:
        if not len(self.at_px) == len(self.moved_px) == len(self.sigma_px):
            raise ValueError("lens_maps: every point must have a displacement and a sigma")
        return self


class CalibrationRecord(_Stored):
    """`CameraCalibration.as_dict`, read back; `parameters` by name, in the order in which they are shown."""

    dataset: str
    parameters: dict[str, Parameter]
    stretches: tuple[tuple[int, int], ...]
    stretch_times_s: tuple[tuple[_Finite, _Finite], ...]
    residuals: StoredResiduals
    pace: StoredPace
    finished: bool
    converged: bool
    notes: tuple[str, ...]
    lenses_px: dict[str, str] = {}
    lens_maps: dict[str, LensMap] = {}
    seconds: _Positive
    camera_file: str

    @model_validator(mode="after")
    def _fits(self) -> CalibrationRecord:
        count = len(self.stretches)
        if len(self.stretch_times_s) != count or any(len(p.told_by_stretch) != count for p in self.parameters.values()):
            raise ValueError(f"there are {count} stretches, and as many times and parts of every parameter must be")
        if not len(self.pace.time_s) == len(self.pace.m_s) == len(self.pace.rad_s):
            raise ValueError("pace: there must be as many speeds as times")
        return self

    @property
    def undetermined(self) -> dict[str, Parameter]:
        """Those that the recording does not determine."""
        return {name: each for name, each in self.parameters.items() if not each.is_found}


def content_of(found: CameraCalibration) -> dict[str, Any]:
    """What calibration.json holds of a calibration that has just been made."""
    return found.as_dict() | {"camera_file": camera_file_of(found)}


def record_of(found: CameraCalibration) -> CalibrationRecord:
    """The record of a calibration that has just been made."""
    return CalibrationRecord.model_validate(content_of(found))


def write_record(found: CameraCalibration, path: Path) -> None:
    """Write calibration.json. Raises UserError."""
    atomic_write(path, (json.dumps(content_of(found), indent=2) + "\n").encode())


def read_record(path: Path) -> CalibrationRecord:
    """What `write_record` or `rstrack calibrate --json` wrote. Raises UserError naming the first wrong field."""
    try:
        return CalibrationRecord.model_validate_json(read_text(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack calibrate --json' again") from None


# -- camera.yaml ----------------------------------------------------------------------------------------------------


def camera_file_of(calibration: CameraCalibration) -> str:
    """Content of its camera.yaml: what was found, with 2 σ beside each value."""
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
            lines.append(f"  {json.dumps(name)}: {{offset_s: {offset_s - dataset.depth_offset_s:.7f}{more}}}")
        lines[-1] += beside[2]
    else:
        color.append(f"  offset_s: {found.color_offset_s - dataset.depth_offset_s:.7f}{beside[2]}")
        if found.color_drift:
            color.append(f"  drift_ppm: {1e6 * found.color_drift:.3f}{beside[DRIFT]}")
    depth = _stream("depth", depth_camera, rig.depth_shutter, found.depth_readout_s, scans[0], beside[DEPTH_LENS])
    depth[-1] += beside[0]
    depth.append(f"  depth_scale: {dataset.depth_scale:g}")
    error, pattern = calibration.values.depth_error, dataset.depth_error.pattern
    if error.any() or pattern is not None:
        names = zip(DEPTH, error, beside[DEPTH_ERROR], strict=True)
        depth += ["  error:", *(f"    {name}: {value:.7g}{comment}" for name, value, comment in names)]
    if pattern is not None:
        depth.append(f"    pattern: [{', '.join(f'{x:.6f}' for x in pattern)}]")
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
) -> list[str]:
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
