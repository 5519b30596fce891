"""All images and true positions of a dataset that has been changed."""

from __future__ import annotations

import numpy as np

from rstrack.data.dataset import Dataset


def depths(dataset: Dataset) -> np.ndarray:
    """Depth images (n, h, w) of all frames, m."""
    return np.stack([dataset.frame(k, color=False).depth.pixels for k in range(len(dataset))])


def colors(dataset: Dataset) -> np.ndarray:
    """First colour images (n, h, w, 3) of all frames."""
    return np.stack([dataset.frame(k).colors[0].pixels for k in range(len(dataset))])


def true_positions(dataset: Dataset) -> np.ndarray:
    """Positions (n, 3) in the world of a dataset whose truth is a pose a frame, m."""
    assert dataset.truth is None and dataset.truth_poses is not None and dataset.sequence is None
    np.testing.assert_allclose(dataset.truth_poses.stamps, dataset.stamps)
    return dataset.truth_poses.positions
