"""The commands about motions: `motion fit`, `motion suggest`, `motion stats`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from rsgen.config.sections import Up
from rsgen.console.command_line import Json, SkipMissing, print_figures
from rsgen.console.configs import config_file


def fit(
    file: Annotated[Path, "TUM, ICL-NUIM (.freiburg) or EuRoC trajectory"],
    *,
    dt: Annotated[float, "knot spacing, s", float] = 0.05,
    smoothing: Annotated[float, "weight of the acceleration penalty", float] = 0.0,
    format: Annotated[Literal["auto", "tum", "icl", "euroc"], "file format"] = "auto",
    plot: Annotated[Path | None, "write residuals, speeds and accelerations as a picture", "PNG"] = None,
    json: Json = False,
) -> int:
    """Fit a spline to a trajectory: residuals and motion statistics."""
    from rsgen.motion.statistics import plot_fit, summarise_fit

    summary = summarise_fit(file, dt, smoothing, format)
    if plot is not None:
        plot_fit(summary, plot)
    print_figures(summary, json)
    return 0


def stats(
    configs: Annotated[list[Path], "YAML files, or names that 'rsgen scenes' lists", "config", config_file],
) -> int:
    """Print length, mean speeds and accelerations of the configs' motions, a line a config, beside the paper's."""
    from rsgen.config.config import load_config
    from rsgen.motion.statistics import motion_statistics, stats_table
    from rsgen.produce.parts import load_motion

    rows = []
    for file in configs:
        config = load_config(file)
        made = load_motion(config)
        rows.append((config.name, motion_statistics(made.spline, made.first_stamp, made.last_stamp)))
    print(stats_table(rows))
    return 0


def suggest(
    scene: Annotated[Path, "Mitsuba scene .xml, or a mesh file; metres, y up, or see --scale, --up"],
    *,
    out: Annotated[Path | None, "config to write (default: print it)", "YAML"] = None,
    scale: Annotated[float, "metres per unit of the file: 0.01 for one in centimetres (default: 1)", float] = 1.0,
    up: Annotated[Up, "axis of the file that is up (default: y)"] = "y",
    seconds: Annotated[float | None, "length of the sequence, s (default: 20, or as --like)", float] = None,
    speed: Annotated[float | None, "mean speed, m/s (default: 0.35, or as --like)", float] = None,
    like: Annotated[
        Path | None,
        "a config, or its name: take over its length, speed, turning, cameras, noise, truth",
        "CONFIG",
        config_file,
    ] = None,
    clearance: Annotated[float, "least distance to the scene's surfaces, m", float] = 0.2,
    seed: Annotated[int, "another seed, another tour (default: 0)", "N", int] = 0,
    name: Annotated[str | None, "the sequence's name (default: the scene's)"] = None,
    skip_missing: SkipMissing = False,
) -> int:
    """Propose a tour through a scene that has none: a config whose camera walks through the scene's largest room, or
    round what it holds, looks at what is 1 to 3 m away, and keeps its distance. Edit it, or render it as it is. With
    --like table1 it is the counterpart of table1 in this scene; --seed gives as many ways through it as are wanted. Of
    several tours that with the best worst views is taken; with --out each second's score is printed.
    """
    from rsgen.config.config import load_config
    from rsgen.files import atomic_write
    from rsgen.produce.suggest import Wish, suggest_tour, wish_like

    model = None if like is None else load_config(like)
    wish = Wish(clearance_m=clearance, seed=seed)
    wish = wish if model is None else wish_like(model, wish)
    wish = wish if seconds is None else replace(wish, seconds=seconds)
    wish = wish if speed is None else replace(wish, speed_m_s=speed)
    suggested = suggest_tour(scene, name, wish, scale, up, model, skip_missing)
    text = suggested.yaml((out or Path("here.yaml")).parent)
    if out is None:
        print(text.decode(), end="")
        return 0
    atomic_write(out, text)
    print("\n".join([*suggested.seconds, *suggested.found, f"{out}: written (rsgen render {out})"]))
    return 0
