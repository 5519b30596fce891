"""Settings of the inertial measurement unit."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from rsgen.array_types import FloatArray
from rsgen.config.faults import ImuFaults
from rsgen.config.presets import ImuPreset, with_imu_preset
from rsgen.config.sections import Section
from rsgen.geometry import se3
from rsgen.limits import Matrix4, RigidTransform, limits

# Bounded so that products of two stay far from overflow.
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Density = Annotated[float, Field(ge=0, le=1e6)]
Range = Annotated[float, Field(gt=0, le=1e6)]
Vector3 = tuple[Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]

_ZERO: Vector3 = (0.0, 0.0, 0.0)
_IDENTITY3: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_IDENTITY4: Matrix4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


# Fields that are left out of sequence.yaml where they are not set: what was rendered before there were any stays same.
_LATER = ("preset", "warmup_s", "gyroscope_warmup", "accelerometer_warmup")


class ImuConfig(Section):
    """An inertial measurement unit fixed to the depth camera; the noise defaults are those of EuRoC's (ADIS16448)."""

    preset: ImuPreset | None = Field(
        default=None,
        description="phone (LSM6DSO), d435i (BMI055) or euroc (ADIS16448): noise, biases, place; other fields override",
    )
    rate_hz: float = Field(default=200.0, gt=0, le=100_000, description="samples per second")
    T_imu_depth: RigidTransform = Field(default=_IDENTITY4, description="depth-camera to IMU coordinates, m")
    gravity: Vector3 = Field(default=(0.0, -9.80665, 0.0), description="gravity in the world, m/s^2 (default: y is up)")
    gyroscope_noise_density: Density = Field(default=1.6968e-4, description="white noise, rad/s/sqrt(Hz)")
    gyroscope_random_walk: Density = Field(default=1.9393e-5, description="bias diffusion, rad/s^2/sqrt(Hz)")
    accelerometer_noise_density: Density = Field(default=2.0e-3, description="white noise, m/s^2/sqrt(Hz)")
    accelerometer_random_walk: Density = Field(default=3.0e-3, description="bias diffusion, m/s^3/sqrt(Hz)")
    gyroscope_bias: Vector3 = Field(default=_ZERO, description="bias at the first sample, rad/s")
    accelerometer_bias: Vector3 = Field(default=_ZERO, description="bias at the first sample, m/s^2")
    gyroscope_matrix: Matrix3 = Field(
        default=_IDENTITY3, description="scale (diagonal) and misalignment: takes the true rate to the measured one"
    )
    accelerometer_matrix: Matrix3 = Field(
        default=_IDENTITY3, description="scale (diagonal) and misalignment: takes the true force to the measured one"
    )
    gyroscope_range: Range | None = Field(default=None, description="largest reading of an axis, rad/s; null: no limit")
    accelerometer_range: Range | None = Field(
        default=None, description="largest reading of an axis, m/s^2; null: no limit"
    )

    warmup_s: Annotated[float, limits(0.1, 1e5, "s")] = Field(
        default=90.0, description="time constant of the biases' drift while the unit warms up, s"
    )
    gyroscope_warmup: Density = Field(default=0.0, description="size of that drift, an axis, by the seed, RMS, rad/s")
    accelerometer_warmup: Density = Field(default=0.0, description="size of that drift, an axis, RMS, m/s^2")

    @model_validator(mode="before")
    @classmethod
    def _fills_in_the_preset(cls, data: Any) -> Any:
        return with_imu_preset(data)

    def has_truth(self, faults: ImuFaults | None) -> bool:
        """Whether truth/ has its samples' true times and biases: where they are more than white noise and a walk."""
        return bool(set(self.content()) & set(_LATER)) or (faults is not None and faults != ImuFaults())

    def content(self) -> dict[str, Any]:
        """What decides its bytes, as plain YAML types."""
        fields = type(self).model_fields
        unset = {name for name in _LATER if getattr(self, name) == fields[name].default}
        return self.model_dump(mode="json", exclude=unset)

    def T_depth_imu(self) -> FloatArray:
        """IMU to depth-camera coordinates (4, 4)."""
        return se3.inverse(se3.orthonormalise(self.T_imu_depth))
