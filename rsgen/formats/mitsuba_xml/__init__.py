"""Scenes in XML that Mitsuba 3 does not take as they are: of older versions, or with mesh files that it misreads."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Changes:
    """What an upgrade dropped, replaced, and left out as rsgen never uses it, counted.

    files: those that it included; renamed: files found under another name than the scene's, by that.
    """

    version: str
    dropped: Counter[str] = field(default_factory=Counter)
    replaced: Counter[str] = field(default_factory=Counter)
    not_used: Counter[str] = field(default_factory=Counter)
    files: list[Path] = field(default_factory=list)
    renamed: dict[str, str] = field(default_factory=dict)

    def summary(self) -> str:
        """'upgraded from Mitsuba 0.6; dropped: ...; replaced: ...; not used: ...', counted."""
        lines = [f"upgraded from Mitsuba {self.version}"]
        for word, counts in (("dropped", self.dropped), ("replaced", self.replaced), ("not used", self.not_used)):
            if counts:
                items = [f"{count} x {what}" if count > 1 else what for what, count in counts.items()]
                lines.append(f"{word}: {', '.join(items)}")
        return "; ".join(lines)

    @property
    def lossy(self) -> bool:
        """Whether images show the difference."""
        return bool(self.dropped or self.replaced)
