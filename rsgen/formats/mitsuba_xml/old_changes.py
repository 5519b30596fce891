"""What an upgrade of an old scene changed, and how that is said."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Changes:
    """What an upgrade dropped and replaced, with counts; what rsgen never uses; the files that it included, and which
    of the files that it names were found under another name.
    """

    version: str
    dropped: Counter[str] = field(default_factory=Counter)
    replaced: Counter[str] = field(default_factory=Counter)
    not_used: Counter[str] = field(default_factory=Counter)
    files: list[Path] = field(default_factory=list)
    renamed: dict[str, str] = field(default_factory=dict)

    def summary(self) -> str:
        """'upgraded from Mitsuba 0.6; dropped: ...; replaced: ...; not used: ...', counted."""
        lists = {"dropped": self.dropped, "replaced": self.replaced, "not used": self.not_used}
        said = [f"{word}: {_listed(counts)}" for word, counts in lists.items() if counts]
        return "; ".join([f"upgraded from Mitsuba {self.version}", *said])

    @property
    def lossy(self) -> bool:
        """Whether images show the difference."""
        return bool(self.dropped or self.replaced)


def _listed(counts: Counter[str]) -> str:
    return ", ".join(f"{count} x {what}" if count > 1 else what for what, count in counts.items())
