"""What a calibration found: as text, as JSON, and as a camera file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan
from rstrack.calibration.figures import (
    MeanMotion,
    ResidualScales,
    displacement_px,
    lens_map,
    rms,
    sigma_px,
    since_begin,
)
from rstrack.calibration.parameters import (
    COLOR_LENS,
    COUNT,
    DEPTH_ERROR,
    DEPTH_LENS,
    EXTRINSICS,
    LENS,
    NAMES,
    UNKNOWNS,
    USEFUL,
    Parameters,
    changed,
)
from rstrack.calibration.solve import Solution
from rstrack.data.dataset import Dataset
from rstrack.data.rig import UNSTATED_POSE, sigma_of_file

OPPOSITE: dict[str, Scan] = {
    "top-bottom": "bottom-top", "bottom-top": "top-bottom", "left-right": "right-left", "right-left": "left-right",
}  # fmt: skip


@dataclass(frozen=True)
class CameraCalibration:
    """start: the values before; asked (31,): which might change; parts: the windows of frames that were used.

    residuals: of a few windows, with the values before along the first track, and with those found. pace: by the first
    track. device_notes: what became of what is published of the device, if one was named. keeps_file_lens: another lens
    was asked for, but explains the images no better than the file's. clocks: of several recordings together, by their
    folders' names, offset (s) and drift of each one's colour; else empty. pattern_note: on depth's error.
    """

    dataset: Dataset
    start: Parameters
    solution: Solution
    asked: BoolArray
    parts: tuple[range, ...]
    motion: MeanMotion
    seconds: float
    residuals: tuple[ResidualScales, ResidualScales]
    pace: dict[str, list[float]]
    device_notes: tuple[str, ...] = ()
    keeps_file_lens: bool = False
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    pattern_note: str = ""

    @property
    def undetermined(self) -> BoolArray:
        """Which (31,) were asked for but are not determined by this recording: they have the values that they had."""
        return self.asked & ~self.solution.free

    @property
    def values(self) -> Parameters:
        """The values found."""
        return self.solution.values

    @property
    def sigmas(self) -> FloatArray:
        """Their standard errors (31,); NaN where undetermined, 0 where not asked for."""
        return np.where(self.undetermined, np.nan, self.solution.sigmas)

    def calibrated(self) -> Dataset:
        """The dataset with these cameras."""
        found, rig = self.upright(), self.dataset.rig
        scans = self.scans()
        depth, color = self.cameras()
        rig = replace(
            rig,
            depth_camera=depth,
            color_camera=color,
            depth_shutter=replace(rig.depth_shutter, readout_s=found.depth_readout_s, scan=scans[0]),
            color_shutter=replace(rig.color_shutter, readout_s=found.color_readout_s, scan=scans[1]),
            T_color_depth=found.T_color_depth,
            sigma=sigma_of_file(color, self.stated_sigmas()),
        )
        found_dataset = replace(
            self.dataset, rig=rig, depth_error=replace(found.error, pattern=self.dataset.depth_error.pattern)
        )
        return found_dataset.with_color_offset(found.color_offset_s, drift=found.color_drift)

    def text(self) -> str:
        """A table of the values with their σ, what could not be determined and why, and notes."""
        sigmas, absolute, before = self.absolute_sigmas, self._absolute(self.values), self._absolute(self.start)
        lines = [f"{'':<28}{'found':>10}   {'2 sigma':>9}   {'from':>10}"]
        for i in np.flatnonzero(self.asked):
            unknown, factor = UNKNOWNS[i], UNKNOWNS[i].factor
            line = f"{unknown.label:<28}{factor * absolute[i]:>10.3f}"
            if self.undetermined[i]:
                lines.append(f"{line}   undetermined: needs {unknown.needs}")
            else:
                found = f" ± {2.0 * factor * sigmas[i]:>9.3f}   {factor * before[i]:>10.3f} {unknown.unit}"
                lines.append(line + found)
        if self.undetermined.any():
            lines.append(self.motion.text())
        lines += [f"{name} lens: {text}" for name, text in self._lenses_px().items()]
        lines += self.notes()
        lines.append(
            f"from {len(self.parts)} windows of {len(self.parts[0])} frames in {self.seconds:.0f} s; residuals "
            f"{1e3 * self.solution.sigma_depth_m:.2f} mm and {self.solution.sigma_intensity:.4f} of intensity"
        )
        return "\n".join(lines)

    def _lenses_px(self) -> dict[str, str]:
        """How far the lenses that were asked for put points from where they were, and how well that is known."""
        found = {}
        for name, old, new, covariance in self._lenses():
            moved, sigma = rms(displacement_px(old, new)), rms(sigma_px(new, covariance))
            found[name] = f"moves points by {moved:.2f} ± {2.0 * sigma:.2f} px (2 sigma; RMS over the image)"
        return found

    def _lenses(self) -> Iterator[tuple[str, Camera, Camera, FloatArray]]:
        """Of those that were asked for the name, the lens before and after, and its covariance (8, 8)."""
        before, after = self._changed(self.start), self.cameras()
        for name, at, old, new in zip(("depth", "colour"), (DEPTH_LENS, COLOR_LENS), before, after, strict=True):
            if self.asked[at].any():
                yield name, old, new, self.solution.covariance[at, at]

    def as_dict(self) -> dict[str, Any]:
        """For JSON: values in SI units; sigma None where undetermined.

        shown: how a value is called on the screen, its unit there, and the factor from the SI unit to that.
        useful_sigma: a σ above it makes a value undetermined.
        """
        sigmas, solution, (before, after) = self.absolute_sigmas, self.solution, self.residuals
        absolute, start = self._absolute(self.values), self._absolute(self.start)
        shares, useful = solution.shares, USEFUL * self._units
        ends = [(part.start, part.stop - 1) for part in self.parts]
        return {
            "dataset": self.dataset.name,
            "parameters": {
                name: {
                    "value": float(absolute[i]), "start": float(start[i]),
                    "sigma": None if np.isnan(sigmas[i]) else float(sigmas[i]),
                    "state": "undetermined" if self.undetermined[i] else "found",
                    "told_by_stretch": np.round(shares[:, i], 4).tolist(),
                    "shown": {"label": unknown.label, "unit": unknown.unit, "factor": unknown.factor},
                    "useful_sigma": float(useful[i]), "needs": unknown.needs,
                }
                for i, (name, unknown) in enumerate(zip(NAMES, UNKNOWNS, strict=True)) if self.asked[i]
            },
            "T_color_depth": self.values.T_color_depth.tolist(),
            "stretches": [[part.start, part.stop] for part in self.parts],
            "stretch_times_s": np.round([since_begin(self.dataset, each) for each in ends], 4).tolist(),
            "residuals": {
                "depth_m": {"before": before.depth_m, "after": after.depth_m},
                "intensity": {"before": before.intensity, "after": after.intensity},
            },
            "pace": self.pace,
            "motion": {"m_s": self.motion.speed, "rad_s": self.motion.rotation, "rad_s2": self.motion.change},
            "sigma_depth_m": solution.sigma_depth_m, "sigma_intensity": solution.sigma_intensity,
            "finished": solution.finished, "converged": solution.is_settled, "seconds": self.seconds,
            "lenses_px": self._lenses_px(),
            "lens_maps": {name: lens_map(old, new, C) for name, old, new, C in self._lenses()},
            "notes": self.notes(), "device": list(self.device_notes),
        }  # fmt: skip

    def stated_sigmas(self) -> dict[str, float]:
        """σ of what was found, as a camera file has them: of each kind the largest, lenses' by the colour camera's.

        Extrinsics that were not found are known as well as before.
        """
        lens = [f"color.{name}" for name in LENS]
        kinds = {
            "focal": (lens[:2], 1.0), "aspect": (lens[:2], 1.0), "center_px": (lens[2:4], self.cameras()[1].fx),
            "k1": (lens[4:5], 1.0), "translation_m": (NAMES[EXTRINSICS][:3], 1.0),
            "rotation_deg": (NAMES[EXTRINSICS][3:], float(np.degrees(1.0))),
            "readout_s": (NAMES[:2], 1.0), "offset_s": (NAMES[2:3], 1.0),
            "depth_inverse_offset": (("depth.error.inverse_offset",), 1.0),
        }  # fmt: skip
        found = {}
        for kind, (names, factor) in kinds.items():
            at = [NAMES.index(name) for name in names]
            if self.asked[at].all() and not self.undetermined[at].any():
                found[kind] = float(f"{factor * self.sigmas[at].max():.3g}")
            elif kind in UNSTATED_POSE and (before := getattr(self.dataset.rig.sigma, kind)):
                found[kind] = before
        center, tangential = [[NAMES.index(name) for name in names] for names in (lens[2:4], lens[6:8])]
        if "center_px" in found and self.asked[tangential].all() and not self.undetermined[tangential].any():
            # p1 and p2 trade with the principal point, whose σ holds that already: the rest, where it is known.
            C = self.solution.covariance
            both = C[np.ix_(center, tangential)]
            rest = C[np.ix_(tangential, tangential)] - both.T @ np.linalg.solve(C[np.ix_(center, center)], both)
            found["p"] = float(f"{np.sqrt(np.diag(rest).max()):.3g}")
        if "focal" in found:
            # What depth images seemed to be off by, each as a whole, came with a lens that was wrong.
            found["depth_image"] = 0.0
        return found

    def cameras(self) -> tuple[Camera, Camera]:
        """Depth camera and colour camera, as found."""
        return self._changed(self.values)

    def _changed(self, p: Parameters) -> tuple[Camera, Camera]:
        rig = self.dataset.rig
        depth = p.color_lens if rig.is_registered else p.depth_lens
        return changed(rig.depth_camera, depth), changed(rig.color_camera, p.color_lens)

    def _absolute(self, p: Parameters) -> FloatArray:
        """The values (31,), SI and px: the extrinsics by position and rotation vector of T_color_depth."""
        T = p.T_color_depth
        clocks = p.depth_readout_s, p.color_readout_s, p.color_offset_s, p.color_drift
        lenses = [_lens(camera) for camera in self._changed(p)]
        return np.concatenate([clocks, T[:3, 3], se3.log(T)[3:], *lenses, p.depth_error])

    @property
    def absolute_sigmas(self) -> FloatArray:
        """Their standard errors (31,)."""
        return self.sigmas * self._units

    @property
    def _units(self) -> FloatArray:
        """What a unit of each of NAMES comes to (31,)."""
        units, rig = np.ones(COUNT), self.dataset.rig
        for camera, lens in ((rig.depth_camera, DEPTH_LENS), (rig.color_camera, COLOR_LENS)):
            units[lens][:4] = camera.fx, camera.fy, camera.fx, camera.fy
        return units

    def scans(self) -> tuple[Scan, Scan]:
        """Of depth and colour; the opposite of what was assumed where the readout turned out negative."""
        rig, p = self.dataset.rig, self.values
        pairs = (rig.depth_shutter, p.depth_readout_s), (rig.color_shutter, p.color_readout_s)
        depth, color = (OPPOSITE[s.scan] if readout < 0.0 else s.scan for s, readout in pairs)
        return depth, color

    def upright(self) -> Parameters:
        """The values for `_scans`: stamps belong to the line that is read first."""
        p, rig = self.values, self.dataset.rig
        last = [1.0 - 1.0 / s.line_count(c) for s, c in ((rig.depth_shutter, rig.depth_camera),
                                                       (rig.color_shutter, rig.color_camera))]  # fmt: skip
        late = min(0.0, p.color_readout_s) * last[1] - min(0.0, p.depth_readout_s) * last[0]
        return replace(
            p, depth_readout_s=abs(p.depth_readout_s), color_readout_s=abs(p.color_readout_s),
            color_offset_s=p.color_offset_s + late,
        )  # fmt: skip

    def notes(self) -> list[str]:
        """What a user should know of the clocks and the directions."""
        notes = [*self.device_notes, *([self.pattern_note] if self.pattern_note else [])]
        for name, scan, before, readout, sigma in zip(
            ("depth", "colour"), self.scans(), (self.dataset.rig.depth_shutter, self.dataset.rig.color_shutter),
            (self.values.depth_readout_s, self.values.color_readout_s), self.sigmas[:2], strict=True,
        ):  # fmt: skip
            if scan != before.scan:
                notes.append(f"{name} is read {scan}, not {before.scan}")
            elif sigma > 0.0 and abs(readout) < 2.0 * sigma:
                notes.append(f"{name} has a global shutter, as far as can be determined")
        readout, sigma = abs(self.values.depth_readout_s), self.sigmas[0]
        if self.dataset.rig.is_registered and sigma > 0.0 and readout > 2.0 * sigma:
            far = f"{readout / sigma:.0f} sigma"
            notes.append(f"registered depth has kept its rows' times: one time for all of them is {far} off")
        if self.keeps_file_lens:
            notes.append("the lens is the file's: another explains these images no better than chance does")
        notes += [f"colour's clock in {name}: {1e3 * offset:+.3f} ms" for name, (offset, _) in self.clocks.items()]
        if self.asked[2] or self.clocks:
            notes.append("a delay of both streams alike does not show in images: offsets are against depth's stamps")
        if self.asked[DEPTH_ERROR].any():
            notes.append("depth's scale cannot be determined from images: path, map and extrinsics grow with it")
        if not self.solution.finished:
            notes.append("interrupted before it had converged")
        elif not self.solution.is_settled:
            notes.append("NOT CONVERGED: the last step still moved values by more than their error: do not use them")
        return notes


def _lens(camera: Camera) -> FloatArray:
    """LENS (9,) of a camera."""
    bent = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5] if camera.model == "radtan" else (0.0,) * 5
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *bent])
