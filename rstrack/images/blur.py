"""How long a point's blur is, and how much it counts then."""

from __future__ import annotations

from typing import Any

import drjit as dr

from rsgen.device.lens import Lens


def blur_weight(length_px: Any, inv_sigma2: Any) -> Any:
    """Equation (13), w = exp(−‖x_t − x_{t−t_e}‖ / σ²), on the device.

    length_px: how far the point moves in the image while its line is exposed. inv_sigma2: 1/σ², σ in pixels; 0 counts
    all alike.
    """
    return dr.exp(-inv_sigma2 * length_px)


def blur_length(lens: Lens, pixel_speed: tuple[Any, Any]) -> Any:
    """‖x_t − x_{t−t_e}‖ in pixels of points that move by pixel_speed (px) per line delay (`project_rolling`)."""
    u, v = pixel_speed
    return dr.sqrt(u * u + v * v) * (lens.shutter.exposure_s / lens.shutter.line_delay(lens.camera))
