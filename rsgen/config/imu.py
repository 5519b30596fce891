"""Settings of the inertial measurement unit."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.limits import Matrix4, RigidTransform

# Bounded so that products of two stay far from overflow.
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Density = Annotated[float, Field(ge=0, le=1e6)]
Range = Annotated[float, Field(gt=0, le=1e6)]
Vector3 = tuple[Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]

_ZERO: Vector3 = (0.0, 0.0, 0.0)
_IDENTITY3: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_IDENTITY4: Matrix4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class ImuConfig(BaseModel):
    """An inertial measurement unit fixed to the depth camera; the noise defaults are those of EuRoC's (ADIS16448)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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

    def T_depth_imu(self) -> FloatArray:
        """IMU to depth-camera coordinates (4, 4)."""
        return se3.inverse(se3.orthonormalise(self.T_imu_depth))
