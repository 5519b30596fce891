"""Sensors that sequence.yaml describes beside the two streams: IMU, motion capture, calibration target."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from rsgen.config.faults import ImuFaults, split_imu
from rsgen.config.sections import ImuConfig, MocapConfig, TargetConfig
from rsgen.errors import UserError, first_problem
from rsgen.sensors.imu import ImuSamples, simulate_imu
from rsgen.sequence.images import Rig

SectionT = TypeVar("SectionT", bound=BaseModel)


class SequenceImu(NamedTuple):
    """The IMU of a sequence, its samples over the whole spline, and what is wrong with them."""

    config: ImuConfig
    samples: ImuSamples
    faults: ImuFaults


def sequence_imu(sequence: Rig) -> SequenceImu | None:
    """The IMU of a sequence; None where it has none.

    Equal to what imu.csv was written from. Raises UserError if sequence.yaml's config.imu is not one.
    """
    found = _section(sequence, "imu", ImuConfig, lambda recorded: split_imu(recorded)[0])
    wrong = _section(sequence, "imu", ImuFaults, lambda recorded: split_imu(recorded)[1] or {})
    if found is None or wrong is None:
        return None
    (imu, seed), (faults, _), spline = found, wrong, sequence.spline
    return SequenceImu(imu, simulate_imu(spline, imu, spline.t_begin, spline.t_end, seed, faults), faults)


def sequence_mocap(sequence: Rig) -> tuple[MocapConfig, int] | None:
    """The motion capture of a sequence's groundtruth.txt and the sequence's seed; None where the poses are exact.

    Raises UserError if sequence.yaml's config.mocap is not one.
    """
    return _section(sequence, "mocap", MocapConfig)


def sequence_target(sequence: Rig) -> TargetConfig | None:
    """The calibration target in a sequence's scene; None where there is none.

    Raises UserError if sequence.yaml's config.target is not one.
    """
    found = _section(sequence, "target", TargetConfig)
    return None if found is None else found[0]


def _section(
    sequence: Rig, name: str, model: type[SectionT], part: Callable[[dict[str, Any]], Any] = dict
) -> tuple[SectionT, int] | None:
    """A section of the config in sequence.yaml, or a part of it, and the seed; None where there is no such section.

    Raises UserError.
    """
    where = sequence.root / "sequence.yaml"
    config: Any = sequence.meta.get("config")
    data = config.get(name) if isinstance(config, dict) else None
    if data is None:
        return None
    try:
        section = model.model_validate(part(data) if isinstance(data, dict) else data)
    except ValidationError as error:
        problem = first_problem(error, "config", name)
        raise UserError(f"{where}: {problem}: restore the file or render again") from None
    seed = sequence.meta.get("seed")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UserError(f"{where}: seed is not a whole number of 0 or more: restore the file or render again")
    return section, seed
