"""Figures made from records: error against readout."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

from rstrack.bench.record import Record
from rstrack.bench.tables.cells import methods_in_order
from rstrack.bench.tables.shown import Records, of_measure
from rstrack.charts.chart import Chart, Line, method_colors, numbers
from rstrack.charts.to_file import write_charts

_CASE = re.compile(r"readout-(.+)-(\d+(?:\.\d+)?)ms")
_NOTE = "Dashed: the shutter is taken for a global one, or for a lidar's sweep."


def readout_charts(full: Records) -> list[Chart]:
    """ATE over readout, one chart a motion, of cells track/readout-MOTION-Nms/METHOD; bands: least to largest seed."""
    motions: dict[str, dict[str, list[tuple[float, Record]]]] = defaultdict(lambda: defaultdict(list))
    records = of_measure(full, "track")
    for record in records:
        named = _CASE.fullmatch(record.case)
        if named and record.values("ate_mm"):
            motions[named[1]][record.method].append((float(named[2]), record))
    charts = []
    for motion, methods in motions.items():
        order = [m for m in methods_in_order(records) if m in methods]
        colors = method_colors(order)
        lines = []
        for method in order:
            points = sorted(methods[method], key=lambda point: point[0])
            values = [record.values("ate_mm") for _, record in points]
            spans = [numbers([f(v) for v in values]) for f in (lambda v: sum(v) / len(v), min, max)]
            x = numbers([at for at, _ in points])
            lines.append(Line(method, colors[method], x, spans[0], method not in ("rs-pg", "rs-g"), True, *spans[1:]))
        charts.append(Chart(f"{motion}: ATE (RMSE)", "mm", "readout, ms", tuple(lines), is_log=True, note=_NOTE))
    return charts


def draw_readout(full: Records, path: Path) -> bool:
    """Write the picture, the same bytes for the same records and versions; whether there is anything to draw."""
    charts = readout_charts(full)
    if charts:
        write_charts(charts, path, "", columns=len(charts), one_legend=True)
    return bool(charts)
