"""Measures that only developers run, beside those of `rstrack.bench.task`."""

MEASURES: dict[str, str] = {
    "bootstrap": "benchmarks.measures.bootstrap:bootstrap_cell",
    "calibration": "benchmarks.measures.calibration:calibration_cell",
    "convergence": "benchmarks.measures.convergence:convergence_cell",
    "long": "benchmarks.measures.long:long_cell",
    "loops": "benchmarks.measures.loops:loops_cell",
}
