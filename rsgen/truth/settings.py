"""Sensors that sequence.yaml describes beside the two streams: IMU, motion capture, calibration target."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from rsgen.config.imu import ImuConfig
from rsgen.config.mocap import MocapConfig
from rsgen.config.target import TargetConfig
from rsgen.errors import UserError, first_problem
from rsgen.sensors.imu import ImuSamples, simulate_imu
from rsgen.sequence.reader import Sequence

SectionT = TypeVar("SectionT", bound=BaseModel)


def sequence_imu(sequence: Sequence) -> tuple[ImuConfig, ImuSamples] | None:
    """The IMU of a sequence and its samples over the whole spline; None where the sequence has none.

    Equal to what imu.csv was written from. Raises UserError if sequence.yaml's config.imu is not one.
    """
    found = _section(sequence, "imu", ImuConfig)
    if found is None:
        return None
    imu, seed = found
    return imu, simulate_imu(sequence.spline, imu, sequence.spline.t_begin, sequence.spline.t_end, seed)


def sequence_mocap(sequence: Sequence) -> tuple[MocapConfig, int] | None:
    """The motion capture of a sequence's groundtruth.txt and the sequence's seed; None where the poses are exact.

    Raises UserError if sequence.yaml's config.mocap is not one.
    """
    return _section(sequence, "mocap", MocapConfig)


def sequence_target(sequence: Sequence) -> TargetConfig | None:
    """The calibration target in a sequence's scene; None where there is none.

    Raises UserError if sequence.yaml's config.target is not one.
    """
    found = _section(sequence, "target", TargetConfig)
    return None if found is None else found[0]


def _section(sequence: Sequence, name: str, model: type[SectionT]) -> tuple[SectionT, int] | None:
    """A section of the config in sequence.yaml, and the seed; None where there is no such section. Raises UserError."""
    where = sequence.root / "sequence.yaml"
    config: Any = sequence.meta.get("config")
    data = config.get(name) if isinstance(config, dict) else None
    if data is None:
        return None
    try:
        section = model.model_validate(data)
    except ValidationError as error:
        problem = first_problem(error, "config", name)
        raise UserError(f"{where}: {problem}: restore the file or render again") from None
    seed = sequence.meta.get("seed")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UserError(f"{where}: seed is not a whole number of 0 or more: restore the file or render again")
    return section, seed
