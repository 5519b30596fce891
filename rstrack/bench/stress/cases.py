"""The sequences of the blur stress test: one motion at several exposures and speeds, rendered by `rsgen render`.

Exposures differ in nothing but their blur: the colour camera's clock is shifted by half the exposure, so that every
line's mid-exposure, and with it its pose, its depth image and the sharp truth stay the same.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, read_yaml
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import pose_rows
from rstrack.options import Options

# Samples of the sped-up path per knot: the fit through them, in phase, gives the spline back.
_SAMPLES_PER_KNOT = 8

Render = Callable[[Sequence[str]], None]


@dataclass(frozen=True)
class StressOptions:
    """exposures_s: at speed 1. speeds: other speeds, at `speed_exposure_s`. sigmas_px: of equation (13).

    frames: only the first so many at speed 1, None: all (a faster sequence has so many fewer).
    """

    exposures_s: tuple[float, ...] = (0.0, 0.005, 0.010, 0.020, 0.030)
    speeds: tuple[float, ...] = (2.0, 4.0)
    speed_exposure_s: float = 0.020
    sigmas_px: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    frames: int | None = None
    tracker: Options = field(default_factory=Options)

    def __post_init__(self) -> None:
        given = (*self.exposures_s, self.speed_exposure_s)
        if not self.exposures_s or not all(0.0 <= t <= 1.0 for t in given):
            raise UserError(f"stress: exposures {given} must lie between 0 and 1 s, and be one at least")
        for name in ("speeds", "sigmas_px"):
            if not all(0.01 <= value <= 100.0 for value in getattr(self, name)):
                raise UserError(f"stress: {name} {getattr(self, name)} must lie between 0.01 and 100")
        if self.frames is not None and self.frames < 2:
            raise UserError(f"stress: frames {self.frames} must be 2 or more")

    @property
    def cases(self) -> tuple[Case, ...]:
        """All sequences; the first of each speed carries the sharp truth."""
        first = [Case(1.0, t) for t in sorted(set(self.exposures_s))]
        return (*first, *(Case(s, self.speed_exposure_s) for s in sorted({*self.speeds} - {1.0})))


@dataclass(frozen=True)
class Case:
    """One sequence of the test."""

    speed: float
    exposure_s: float

    @property
    def name(self) -> str:
        """Its folder."""
        return f"exposure_{1e3 * self.exposure_s:g}ms" + ("" if self.speed == 1.0 else f"_speed_{self.speed:g}x")


def render_cases(
    config: Path, out: Path, options: StressOptions, progress: Progress, render: Render
) -> dict[Case, Path]:
    """Folder of each case's sequence, rendered where it is not there yet. Raises UserError."""
    text = read_yaml(config)
    clock = _clock(config, text)
    folders: dict[Case, Path] = {}
    for n, case in enumerate(options.cases):
        progress("rendering", n / len(options.cases), case.name)
        folder = folders[case] = out / "sequences" / case.name
        source = config if case.speed == 1.0 else _sped_up(config, text, case.speed, folders[options.cases[0]], out)
        sharp = not any(case.speed == before.speed for before in list(folders)[:-1])
        overrides = {
            "color.exposure_s": case.exposure_s,
            "color.offset_s": round(clock + 0.5 * case.exposure_s, 9),
            "truth.global_shutter": "[middle]" if sharp else "[]",
        }
        few = [] if options.frames is None else ["--frames", f"0:{max(2, round(options.frames / case.speed))}"]
        words = [word for name, value in overrides.items() for word in (f"--{name}", str(value))]
        render(["render", str(source), "--quiet", "--out", str(folder), *few, *words])
    return folders


def _clock(config: Path, text: dict[str, Any]) -> float:
    """Seconds after the start at which line 0 of the depth camera, and of the colour camera too, is mid-exposure."""
    depth = text.get("depth") or {}
    try:
        return float(depth.get("offset_s", 0.0)) - 0.5 * float(depth.get("exposure_s", 0.0))
    except (AttributeError, TypeError, ValueError):
        raise UserError(f"{config}: depth.offset_s and depth.exposure_s must be numbers of seconds") from None


def _sped_up(config: Path, text: dict[str, Any], speed: float, slow: Path, out: Path) -> Path:
    """A config with the path of sequence `slow` at another speed: the same spline with its knots closer together."""
    spline = Spline.load(slow / "spline.npz")
    fast = Spline(spline.control_points, spline.t0 / speed, spline.dt / speed)
    steps = round((fast.t_end - fast.t_begin) / fast.dt) * _SAMPLES_PER_KNOT
    t = np.linspace(fast.t_begin, fast.t_end, steps + 1)
    rows = pose_rows(fast.pose(t))
    path = out / "sequences" / f"speed_{speed:g}x.txt"
    lines = [f"{a - t[0]:.12f} " + " ".join(f"{v:.12f}" for v in row) for a, row in zip(t, rows, strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, ("\n".join(["# stamp tx ty tz qx qy qz qw", *lines]) + "\n").encode())
    changed = {key: value for key, value in text.items() if key not in ("motion", "trajectory")}
    changed["trajectory"] = {"file": str(path.resolve()), "format": "tum", "knot_spacing_s": fast.dt}
    scene = dict(text.get("scene") or {})
    if "file" in scene:
        scene["file"] = str((Path(config).parent / scene["file"]).resolve())
    changed["scene"] = scene
    made = path.with_suffix(".yaml")
    atomic_write(made, encode_yaml(changed))
    return made


def run_rsgen(words: Sequence[str]) -> None:
    """Run `rsgen` with these arguments in a process of its own. Raises UserError if it fails."""
    # The tracker's process must not load the renderer.
    done = subprocess.run([sys.executable, "-m", "rsgen", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or f"exit status {done.returncode}").splitlines()
        raise UserError(f"stress: rsgen {words[0]} {words[1]} failed: {said[-1]}")
