"""Depth of a rectified pair of grey images, as a stereo camera computes it by semi-global matching; a pattern of dots.

Hirschmüller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008, in OpenCV's variant.
"""

from __future__ import annotations

import cv2
import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.config.rig import DotsConfig, StereoConfig

# OpenCV reports disparities in these parts of a pixel, and the penalties that its documentation recommends.
_PARTS, _P1, _P2 = 16, 8, 32
# Its matching cost draws disparities towards whole pixels: depth in steps. In images of twice the width these are half
# as wide, and so is the error of the disparity (docs/notebook/rigs.md).
_WIDER = 2
_TEXELS = 4  # of the pattern across a dot
_PATTERN = 0x646F7473  # "dots"


def stereo_depth(left: ByteArray, right: ByteArray, focal_baseline: float, config: StereoConfig) -> Float32Array:
    """Planar z (h, w) in m of the left image's pixels, 0 where no match is sure; images (h, w), rows alike.

    focal_baseline: focal length in px times the distance of the cameras in m. Left and right are checked against each
    other, so that what only one of them sees has no depth.
    """
    area, largest = config.block_px**2, _WIDER * config.disparities
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=largest, blockSize=config.block_px, P1=_P1 * area, P2=_P2 * area,
        disp12MaxDiff=1, uniquenessRatio=config.uniqueness_pct, speckleWindowSize=_WIDER * config.speckle_px,
        speckleRange=1 if config.speckle_px else 0, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    wide = [cv2.resize(image, None, fx=_WIDER, fy=1, interpolation=cv2.INTER_CUBIC) for image in (left, right)]
    # The leftmost pixels would have no disparity otherwise: a margin as wide as disparities are large.
    padded = [cv2.copyMakeBorder(image, 0, 0, largest, 0, cv2.BORDER_CONSTANT) for image in wide]
    disparity = matcher.compute(*padded)[:, largest::_WIDER].astype(np.float32) / (_PARTS * _WIDER)
    # What is matched to the margin has been matched to nothing.
    seen = (disparity > 0) & (np.arange(left.shape[1]) - disparity >= 0)
    return np.where(seen, np.float32(focal_baseline) / np.where(seen, disparity, 1), np.float32(0))


def dot_pattern(config: DotsConfig, half: FloatArray, seed: int) -> Float32Array:
    """The pattern (rows, columns) on the plane at 1 m, from -half to half (2,) in x and y, m; 1 in a dot's middle.

    One dot at a random place in each of `count` cells of a grid, so that none of the field is bare.
    """
    width = np.deg2rad(config.dot_deg)
    columns, rows = (max(8, int(np.ceil(2 * h * _TEXELS / width))) for h in half)
    across = max(1, round(np.sqrt(config.count * columns / rows)))
    down = max(1, round(config.count / across))
    place = np.random.default_rng([_PATTERN, seed]).random((down, across, 2))
    x = ((np.arange(across) + place[..., 0]) / across * columns).ravel()
    y = ((np.arange(down)[:, None] + place[..., 1]) / down * rows).ravel()
    sigma = _TEXELS / np.sqrt(8 * np.log(2))
    reach = np.arange(-2 * _TEXELS, 2 * _TEXELS + 1)
    column, row = np.floor(x)[:, None, None] + reach, np.floor(y)[:, None, None] + reach[:, None]
    squared = (column + 0.5 - x[:, None, None]) ** 2 + (row + 0.5 - y[:, None, None]) ** 2
    column, row = np.broadcast_arrays(column, row)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    pattern = np.zeros((rows, columns), np.float32)
    places = row[inside].astype(np.int64), column[inside].astype(np.int64)
    np.maximum.at(pattern, places, np.exp(-squared[inside] / (2 * sigma**2)).astype(np.float32))
    return pattern
