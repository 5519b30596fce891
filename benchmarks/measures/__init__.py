"""Measures beside those of `rstrack.bench.task`, by name: 'package.module:function', a function of a task."""

MEASURES: dict[str, str] = {
    "faults": "benchmarks.measures.faults:fault_cell",
    "light": "benchmarks.measures.light:light_cell",
    "render": "benchmarks.measures.render:render_cell",
}
