"""What a calibration of an IMU found: for the screen, as JSON, and as an imu.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.geometry import so3
from rsgen.geometry.so3 import hat
from rstrack.calibration.imu.model import COUNT, DRIFT, LEVER, OFFSET, ROTATION, SCALE
from rstrack.calibration.imu.solve import ImuSolution
from rstrack.data.imu.description import ImuDescription, ImuNoise, imu_yaml

# σ above which a value is of no use: rad, m, s, s/s, parts, rad.
USEFUL = np.array([*np.radians((0.3,) * 3), *(0.01,) * 3, 1e-3, 5e-5, *(0.01,) * 3, *np.radians((0.3,) * 2)])
_GROUPS = (("rotation", ROTATION), ("translation", LEVER), ("clock offset", OFFSET), ("clock drift", DRIFT),
           ("gyroscope scale", SCALE))  # fmt: skip


@dataclass(frozen=True)
class ImuCalibration:
    """A solution, and what it was found from. stated: what stood in the IMU's file; samples, seconds: what was used."""

    solution: ImuSolution
    stated: ImuDescription
    noise: ImuNoise
    samples: int
    seconds: float
    notes: tuple[str, ...] = ()

    @property
    def T_imu_depth(self) -> FloatArray:
        """(4, 4): p_imu from p_depth."""
        return self.solution.imu.T_imu_depth

    @property
    def sigmas(self) -> FloatArray:
        """σ (13,) in the order of `rstrack.calibration.imu.model.NAMES`."""
        return np.sqrt(np.diag(self.solution.covariance)[:COUNT])

    @property
    def translation_sigma(self) -> FloatArray:
        """σ (3,) of T_imu_depth's translation, m: of −R l."""
        imu = self.solution.imu
        J = np.hstack([hat(imu.R @ imu.lever), -imu.R])
        return np.sqrt(np.diag(J @ self.solution.covariance[:6, :6] @ J.T))

    @property
    def undetermined(self) -> BoolArray:
        """Which (13,) the recording does not determine."""
        return np.asarray(self.sigmas > USEFUL)

    @property
    def offset_s(self) -> float:
        """Seconds to be added to the stamps as they stand in the file, in the images' middle."""
        imu = self.solution.imu
        return self.stated.offset_s + imu.offset_s + imu.drift * self.stated.offset_s

    @property
    def drift(self) -> float:
        """By which that grows, s/s."""
        imu = self.solution.imu
        return self.stated.drift + imu.drift + self.stated.drift * imu.drift

    @property
    def gyro_matrix(self) -> FloatArray:
        """(3, 3): takes the true rate to the measured one."""
        before = np.eye(3) if self.stated.gyro_matrix is None else self.stated.gyro_matrix
        return before @ np.diag(1.0 + self.solution.imu.scale)

    def text(self) -> str:
        """For the screen, with twice the standard errors."""
        imu, s = self.solution.imu, self.sigmas
        turn, shift = np.degrees(so3.log(imu.R)), 1e3 * self.T_imu_depth[:3, 3]
        biases, bias_s = self._biases()
        rows = [
            ("", f"{self.samples} samples over {self.seconds:.1f} s"),
            ("rotation", f"{_three(turn, 2 * np.degrees(s[ROTATION]), 3)} degrees, T_imu_depth's as a vector"),
            ("translation", f"{_three(shift, 2e3 * self.translation_sigma, 2)} mm, T_imu_depth's"),
            ("offset", f"{1e3 * self.offset_s:+.4f} ± {2e3 * s[OFFSET]:.4f} ms to be added to the IMU's stamps"),
            ("drift", f"{1e6 * self.drift:+.1f} ± {2e6 * s[DRIFT]:.1f} ppm"),
            ("scale", f"{_three(100 * np.diag(self.gyro_matrix) - 100, 200 * s[SCALE], 3)} % of the gyroscope"),
        ]
        for name, part, unit_name, k in (
            ("gyroscope", slice(0, 3), "rad/s", 5),
            ("accelerometer", slice(3, 6), "m/s²", 4),
        ):
            for when, at in (("first", 0), ("last", -1)):
                rows.append(
                    ("bias", f"{_three(biases[at, part], 2 * bias_s[at, part], k)} {unit_name}, {name}, {when}")
                )
        rows += [("undetermined", ", ".join(self._undetermined_names()))] if self.undetermined.any() else []
        return "\n".join([*(f"{a:<13} {b}" for a, b in rows), *self.notes])

    def as_dict(self) -> dict[str, Any]:
        """Plain types, σ beside every value."""
        imu, s, sizes = self.solution.imu, self.sigmas, self.solution.sizes
        biases, bias_s = self._biases()
        return {
            "T_imu_depth": self.T_imu_depth.tolist(),
            "rotation_sigma_rad": s[ROTATION].tolist(),
            "translation_sigma_m": self.translation_sigma.tolist(),
            "offset_s": self.offset_s,
            "offset_sigma_s": float(s[OFFSET]),
            "drift_ppm": 1e6 * self.drift,
            "drift_sigma_ppm": 1e6 * float(s[DRIFT]),
            "gyroscope_matrix": self.gyro_matrix.tolist(),
            "gyroscope_scale_sigma": s[SCALE].tolist(),
            "gravity_in_track": imu.gravity.tolist(),
            "bias_times_s": imu.bias_times.tolist(),
            "gyroscope_bias": biases[:, :3].tolist(),
            "gyroscope_bias_sigma": bias_s[:, :3].tolist(),
            "accelerometer_bias": biases[:, 3:].tolist(),
            "accelerometer_bias_sigma": bias_s[:, 3:].tolist(),
            "undetermined": self._undetermined_names(),
            "errors": {"gyroscope_rad_s": float(sizes.gyro), "accelerometer_m_s2": float(sizes.accel),
                       "track_rotation_rad": sizes.poses[0], "track_position_m": sizes.poses[1]},
            "samples": self.samples,
            "seconds": self.seconds,
        }  # fmt: skip

    def imu_file(self) -> str:
        """Content of an imu.yaml, for `rstrack track --imu`."""
        lines = [
            "# Written by rstrack calibrate --free imu; σ in comments.",
            imu_yaml(self.T_imu_depth, self.noise).rstrip(),
            f"offset_s: {self.offset_s:.9f}  # ± {self.sigmas[OFFSET]:.2g}",
            f"drift_ppm: {1e6 * self.drift:.4f}  # ± {1e6 * self.sigmas[DRIFT]:.2g}",
        ]
        stated = self.stated
        for name, matrix in (("gyroscope_matrix", self.gyro_matrix), ("accelerometer_matrix", stated.accel_matrix)):
            if matrix is not None:
                rows = ", ".join(f"[{', '.join(f'{x:.7g}' for x in row)}]" for row in matrix)
                lines.append(f"{name}: [{rows}]")
        return "\n".join([*lines, f"gravity: {stated.gravity:.7g}", ""])

    def _biases(self) -> tuple[FloatArray, FloatArray]:
        imu = self.solution.imu
        return imu.biases, np.sqrt(np.diag(self.solution.covariance)[COUNT:]).reshape(imu.biases.shape)

    def _undetermined_names(self) -> list[str]:
        return [name for name, part in _GROUPS if np.any(self.undetermined[part])]


def _three(values: FloatArray, errors: FloatArray, digits: int) -> str:
    return ", ".join(f"{v:+.{digits}f} ± {e:.{digits}f}" for v, e in zip(values, errors, strict=True))
