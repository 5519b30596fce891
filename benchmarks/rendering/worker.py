"""The process that renders for a measure: `python -m benchmarks.rendering.worker JOB`, started by `rendering.run`.

JOB, JSON, says what is to be measured, of which config, with which settings. Lines of JSON on standard output answer:
[stage, fraction, note] of progress, at last an object with `figures`, or with `error`. What libraries print goes to
standard error.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.rendering.modes import render_figures
from rsgen.check.light import compare_light, view_camera
from rsgen.config.config import Config, load_config
from rsgen.console.progress import Progress
from rsgen.device.backend import mitsuba
from rsgen.errors import UserError
from rsgen.produce.frame_source import load_scene, surfaces_hash
from rsgen.produce.ground_truth import lines_of_sight
from rstrack.bench.machine import peak_mb, reset_peak


def main(job: dict[str, Any]) -> None:
    """Measure and answer."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def tell(*progress: object) -> None:
        print(json.dumps(progress), file=answers)

    figures_of = {"light": light_figures, "render": render_figures}[job["what"]]
    answer: dict[str, Any]
    try:
        config = load_config(Path(job["config"]), job["fields"])
        answer = {"figures": figures_of(config, job["settings"], tell)}
    except UserError as error:
        answer = {"error": str(error)}
    print(json.dumps(answer), file=answers)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))


def light_figures(config: Config, settings: Mapping[str, Any], progress: Progress) -> dict[str, float]:
    """The figures of the measure `light`, with its settings, `seed` of what is rendered and `picture`, a file to write.

    bake_mb: most memory of this process until the light is there. Raises UserError.
    """
    if config.light.mode != "baked":
        raise UserError("light.mode is 'path': what is measured is baked light")
    view_camera(config, settings["width"])  # a wrong width would else be told after the bake
    mi = mitsuba(config.backend)
    from rsgen.light.cache import baked_field
    from rsgen.light.lamps import straight_through_bulbs
    from rsgen.light.quality import estimated_quality
    from rsgen.render.baked import BakedIntegrator

    scene = load_scene(config)
    reset_peak()
    begin = time.perf_counter()
    with TemporaryDirectory(prefix="rsgen-light-") as folder:
        field = baked_field(scene, surfaces_hash(config), config.light, Path(folder), progress)
    figures = {"bake_s": time.perf_counter() - begin, "bake_mb": peak_mb()}
    with straight_through_bulbs(scene):
        estimate = estimated_quality(scene, field, config.light.texel_m, *lines_of_sight(config))
    views = compare_light(
        config, settings["views"], settings["spp"], settings["width"], Path(settings["picture"]), progress,
        lit=(scene, BakedIntegrator(field), mi), seed=settings["seed"],
    )  # fmt: skip
    psnr = [view.psnr_db for view in views]
    return {
        "psnr_db": float(np.mean(psnr)),
        "psnr_least_db": min(psnr),
        "surely_least_db": min(view.surely_db for view in views),
        "bias_pct": float(np.mean([view.bias_pct for view in views])),
        **figures,
        "estimate_db": estimate.psnr_db,
        "estimate_least_db": estimate.at_least_db,
        "peak_mb": peak_mb(),
    }
