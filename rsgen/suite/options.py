"""What of a suite is rendered, as the command line has it. Imports nothing: it is there before a command is chosen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated


@dataclass(frozen=True)
class RenderOptions:
    """What of a suite is rendered; each field's text is also the help of the option of its name."""

    tier: Annotated[str | None, "only sequences of this tier (default: all)", "TIER"] = None
    only: Annotated[
        tuple[str, ...] | None, "only sequences whose name, group or role is this; * and ? allowed", "GLOB"
    ] = None
    data: Annotated[Path | None, "folder with recorded trajectories that do not ship, such as ICL-NUIM's", "DIR"] = None
    hold_back_truth: Annotated[
        Path | None, "put all of test sequences that gives their motion away into this folder instead", "DIR"
    ] = None
    test_seed: Annotated[int | None, "seeds of test sequences are drawn from this number: keep it to yourself", "N"] = (
        None
    )
