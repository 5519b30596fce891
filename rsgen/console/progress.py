"""Progress on long work: a live bar with time left on a terminal, a line every tenth elsewhere; always on stderr."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any

Progress = Callable[[str, float, str], None]
"""Called with a stage, the fraction of it that is done in [0, 1], and a note."""

_TITLES = {"light": "baking light", "frames": "rendering"}


def no_progress(stage: str, fraction: float, note: str) -> None:
    """A `Progress` that shows nothing."""


class ProgressDisplay(AbstractContextManager["ProgressDisplay"]):
    """A `Progress` that shows each stage as a bar."""

    def __init__(self, quiet: bool = False) -> None:
        from rich import progress as rich
        from rich.console import Console

        self._console = Console(stderr=True, quiet=quiet)
        self._live = self._console.is_terminal
        self._bars = rich.Progress(
            rich.TextColumn("{task.description:<13}"), rich.BarColumn(), rich.TextColumn("{task.percentage:>3.0f} %"),
            rich.TimeElapsedColumn(), rich.TextColumn("left"), rich.TimeRemainingColumn(),
            rich.TextColumn("{task.fields[note]}"), console=self._console,
        )  # fmt: skip
        self._tasks: dict[str, Any] = {}
        self._started: dict[str, float] = {}
        self._tenths: dict[str, int] = {}

    def __enter__(self) -> ProgressDisplay:
        if self._live:
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._bars.stop()

    def __call__(self, stage: str, fraction: float, note: str) -> None:
        title = _TITLES.get(stage, stage)
        if self._live:
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(title, total=1.0, note=note)
            self._bars.update(self._tasks[stage], completed=fraction, note=note)
            return
        now = time.monotonic()
        start = self._started.setdefault(stage, now)
        tenth = int(10 * fraction + 1e-9)
        if tenth > self._tenths.get(stage, -1):
            self._tenths[stage] = tenth
            left = f", {(now - start) * (1 - fraction) / fraction:.0f} s left" if fraction > 0 else ""
            said = f" ({note})" if note else ""
            self._console.print(f"{title} {100 * fraction:3.0f} %, {now - start:.0f} s{left}{said}")
