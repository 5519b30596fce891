"""Measures beside those of `rstrack.bench.task`, by name: 'package.module:function', a function of a task."""

MEASURES: dict[str, str] = {
    "bootstrap": "benchmarks.measures.bootstrap:bootstrap_cell",
    "calibration": "benchmarks.measures.calibration:calibration_cell",
    "convergence": "benchmarks.measures.convergence:convergence_cell",
    "crossed": "benchmarks.measures.calibration:crossed_cell",
    "faults": "benchmarks.measures.faults:fault_cell",
    "lens": "benchmarks.measures.calibration:lens_cell",
    "light": "benchmarks.measures.renderer:light_cell",
    "long": "benchmarks.measures.runs:long_cell",
    "loops": "benchmarks.measures.loops:loops_cell",
    "refined": "benchmarks.measures.runs:refined_cell",
    "render": "benchmarks.measures.renderer:render_cell",
}
