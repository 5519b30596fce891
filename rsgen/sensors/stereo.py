"""Depth of a rectified pair of grey images, as a stereo camera computes it: semi-global matching.

Hirschmüller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008, in OpenCV's variant.
"""

from __future__ import annotations

import cv2
import numpy as np

from rsgen.array_types import ByteArray, Float32Array
from rsgen.config.rig import StereoConfig

# OpenCV reports disparities in these parts of a pixel, and the penalties that its documentation recommends.
_PARTS, _P1, _P2 = 16, 8, 32


def stereo_depth(left: ByteArray, right: ByteArray, focal_baseline: float, config: StereoConfig) -> Float32Array:
    """Planar z (h, w) in m of the left image's pixels, 0 where no match is sure; images (h, w), rows alike.

    focal_baseline: focal length in px times the distance of the cameras in m. Left and right are checked against each
    other, so that what only one of them sees has no depth.
    """
    area = config.block_px**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=config.disparities, blockSize=config.block_px, P1=_P1 * area, P2=_P2 * area,
        disp12MaxDiff=1, uniquenessRatio=config.uniqueness_pct, speckleWindowSize=config.speckle_px,
        speckleRange=1 if config.speckle_px else 0, mode=cv2.STEREO_SGBM_MODE_SGBM,
    )  # fmt: skip
    # Beyond the right image's border nothing is found otherwise: as wide a margin as disparities are large.
    margin = config.disparities
    padded = [cv2.copyMakeBorder(image, 0, 0, margin, 0, cv2.BORDER_CONSTANT) for image in (left, right)]
    disparity = matcher.compute(*padded)[:, margin:].astype(np.float32) / _PARTS
    # What is matched to the margin has been matched to nothing.
    seen = (disparity > 0) & (np.arange(left.shape[1]) - disparity >= 0)
    return np.where(seen, np.float32(focal_baseline) / np.where(seen, disparity, 1), np.float32(0))
