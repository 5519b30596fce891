"""The process that renders for a measure: `python -m benchmarks.rendering.worker JOB`, started by `rendering.run`.

JOB, JSON, says what is to be measured, of which config, with which settings. Lines of JSON on standard output answer:
[stage, fraction, note] of progress, at last an object with `figures`, or with `error`. What libraries print goes to
standard error.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from benchmarks.rendering.light import light_figures
from benchmarks.rendering.modes import render_figures
from rsgen.config.config import load_config
from rsgen.errors import UserError


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
