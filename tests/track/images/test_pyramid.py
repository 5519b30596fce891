"""Images as kernels take them: which pixels' intensities say something."""

from __future__ import annotations

import numpy as np
import pytest
from rstrack_util import ENGINE, small_camera

from rsgen.device.lens import Lens
from rsgen.geometry.shutter import Shutter
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import color_image


@pytest.mark.parametrize(
    ("spot", "is_clipped"),
    [
        ((255, 200, 150), False),
        ((150, 200, 255), False),
        ((255, 252, 150), True),
        ((255, 120, 251), True),
        ((90, 255, 250), True),
        ((255, 255, 255), True),
        ((249, 249, 249), False),
        ((4, 5, 0), True),
        ((0, 0, 6), False),
    ],
)
def test_a_colour_says_nothing_where_two_channels_are_saturated_or_all_are_black(
    spot: tuple[int, int, int], is_clipped: bool
) -> None:
    color = np.full((24, 32, 3), 120, np.uint8)
    color[12, 16] = spot
    exposure = Exposure(Lens(small_camera(width=32, height=24), Shutter()), 0.0, np.eye(4))
    finest = ENGINE.download(color_image(ENGINE, exposure, color).levels[0], (24, 32))
    unknown = np.argwhere(np.isnan(finest))
    if not is_clipped:
        assert unknown.size == 0
        return
    # With a margin of what smoothing draws the value into.
    assert unknown.min(axis=0).tolist() == [10, 14] and unknown.max(axis=0).tolist() == [14, 18] and len(unknown) == 25
