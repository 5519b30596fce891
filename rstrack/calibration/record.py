"""calibration.json, read back: `CameraCalibration.as_dict`, which `rstrack report` shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rsgen.errors import UserError, first_problem
from rsgen.files import atomic_write, read_text
from rstrack.calibration.camera_file import camera_file_of
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
    """A calibration; `parameters` by name, in the order in which they are shown."""

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
