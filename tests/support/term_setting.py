"""One plane seen twice, by a reference and by an image of it: what tests of the two error terms linearise."""

from __future__ import annotations

from dataclasses import dataclass

from rstrack_util import (
    SCANS,
    T_COLOR_DEPTH,
    color_input,
    depth_input,
    exact_reference,
    exposure,
    hand_held,
    make_terms,
    plane_before,
    small_camera,
)

from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Linearised, Terms
from rstrack.images.pyramid import ColorImage, DepthImage
from rstrack.keyframes.keyframe import Reference

NORMALS = [(0.5, -0.2, 1.0), (-0.3, 0.6, 1.0), (0.1, 0.1, 1.0)]
REF_STAMP, STAMP = 0.43, 0.465
DEPTH, COLOR = small_camera("radtan"), small_camera("fisheye", 72, 54)
# Scan of the reference: None if it is rectified.
CASES = [*[(None, scan) for scan in SCANS], ("top-bottom", "top-bottom"), ("right-left", "left-right")]


@dataclass(frozen=True)
class Setting:
    """A plane, its reference and one image of it; `term` linearises around a spline with scale σ."""

    truth: Spline
    ref: Reference
    image: DepthImage | ColorImage
    terms: Terms

    def term(self, spline: Spline, sigma: float, level: int = 0) -> Linearised:
        """The image against the reference."""
        if isinstance(self.image, DepthImage):
            return self.terms.geometric(self.image, self.ref, spline, level, sigma)()
        return self.terms.photometric(self.image, self.ref, spline, level, sigma)()


def setting(
    kind: str, ref_scan: str | None, scan: str, normal: tuple[float, float, float] = NORMALS[0],
    terms: Terms | None = None, depth: Camera = DEPTH,
) -> Setting:  # fmt: skip
    """Points that are looked at lie far enough from all borders for the same ones to count wherever images move."""
    truth = hand_held(1)
    plane = plane_before(truth.pose(REF_STAMP), normal)
    geometric = kind == "geometric"
    # Only a reference that is not rectified may be distorted.
    ref_image = exposure(REF_STAMP, ref_scan, DEPTH if ref_scan else small_camera())  # type: ignore[arg-type]
    ref = exact_reference(plane.cast, truth, ref_image, 0 if geometric else 8)
    image: DepthImage | ColorImage
    if geometric:
        image = depth_input(plane.cast, truth, exposure(STAMP, scan, depth), 8)  # type: ignore[arg-type]
    else:
        image = color_input(plane.cast, truth, exposure(STAMP + 0.007, scan, COLOR, T_COLOR_DEPTH, 0.02))  # type: ignore[arg-type]
    return Setting(truth, ref, image, terms or make_terms(depth))
