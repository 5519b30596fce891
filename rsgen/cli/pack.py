"""The command `rsgen pack`: training pairs for rolling-shutter correction."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Quiet
from rsgen.console.configs import config_file
from rsgen.console.scheduler import Scheduler, open_workers
from rsgen.pack.draw import PackOptions


def pack(
    configs: Annotated[list[Path], "YAML files, or names that 'rsgen configs' lists", "config", config_file],
    drawn: PackOptions,
    *,
    out: Annotated[Path, "folder; run the same command again to resume, or with a larger --count", "DIR"],
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    **fields: str,
) -> int:
    """Render pairs of rolling and global images to train on: short sequences along random stretches of the configs'
    motions, at random speed, view, readout and exposure, with flow, masks and gyroscope. Another --seed, another
    pack; rooms by other seeds ('rsgen scenes') make more scenes; --color.spp 8 --truth.spp 8 do where light is baked.
    """
    from rsgen.config.config import load_config
    from rsgen.console.progress import ProgressDisplay
    from rsgen.pack.make import make_pack

    chosen = [load_config(config, fields) for config in configs]
    with ProgressDisplay(quiet) as progress, open_workers(scheduler) as workers:
        made = make_pack(chosen, drawn, chosen[0].seed, out, workers, progress)
    print(f"{out}: {made.pairs} pairs in {made.sequences} sequences, {made.new} of them new")
    return 0
