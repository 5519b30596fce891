"""Every keyframe ever made, kept small, and the places that look like a new frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker

# Correlation of two views' thumbnails from which on they may show one place.
_ALIKE = 0.3


@dataclass(frozen=True)
class _Archived:
    """A keyframe on the host: what does not need the device, inverse depth (h, w) and weight (h, w)."""

    small: Reference
    inverse_depth: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float16]


@dataclass
class Archive:
    """Keyframes by their numbers. One of 640×480 takes 2.5 MB instead of 8 on the device."""

    maker: KeyframeMaker
    _kept: dict[int, _Archived] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, ref: Reference) -> None:
        """Keep a keyframe as it is now, in place of what was kept of it before."""
        camera = ref.lens.camera
        rho, weight = (self.maker.e.download(a, (camera.height, camera.width)) for a in (ref.inverse_depth, ref.weight))
        self._kept[ref.index] = _Archived(ref.emptied(), rho, weight.astype(np.float16))

    def get(self, index: int) -> Reference:
        """The keyframe of frame `index`, on the device again."""
        kept = self._kept[index]
        return self.maker.revived(kept.small, kept.inverse_depth, kept.weight.astype(np.float32))

    def alike(self, frame: DeviceFrame, without: set[int]) -> list[int]:
        """Keyframes whose view resembles a frame's, the best first; those in `without` are left out."""
        scores = {k: _resemblance(kept.small, frame) for k, kept in self._kept.items() if k not in without}
        return sorted((k for k, score in scores.items() if score > _ALIKE), key=lambda k: -scores[k])


def _resemblance(ref: Reference, frame: DeviceFrame) -> float:
    """Mean correlation (−1 to 1) of the thumbnails that both have."""
    pairs: list[tuple[Any, Any]] = [(ref.depth_thumbnail, frame.depth.thumbnail)]
    if ref.color_thumbnail is not None and frame.colors:
        pairs.append((ref.color_thumbnail, frame.colors[0].thumbnail))
    return float(np.mean([_correlation(a, b) for a, b in pairs]))


def _correlation(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> float:
    both = (a != 0) & (b != 0)
    if both.sum() < 0.25 * both.size:
        return 0.0
    x, y = a[both] - a[both].mean(), b[both] - b[both].mean()
    size = float(np.sqrt((x * x).sum() * (y * y).sum()))
    return float((x * y).sum()) / size if size > 0.0 else 0.0
