"""What is looked at: where light has to be right."""

from __future__ import annotations

from dataclasses import dataclass

from rsgen.array_types import FloatArray


@dataclass(frozen=True)
class Sight:
    """Lines of sight: eyes (n, 3), world, m, and unit directions (n, 3)."""

    eye: FloatArray
    direction: FloatArray
