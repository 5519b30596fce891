"""Figures made from records: error against readout."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

from rstrack.bench.readout.results import errors, readout_chart
from rstrack.bench.record import Record
from rstrack.bench.tables.cells import methods_in_order
from rstrack.bench.tables.shown import Records, of_measure
from rstrack.charts.chart import Chart
from rstrack.charts.to_file import write_charts

_CASE = re.compile(r"readout-(.+)-(\d+(?:\.\d+)?)ms")


def readout_charts(full: Records) -> list[Chart]:
    """ATE over readout, one chart a motion, of cells track/readout-MOTION-Nms/METHOD."""
    motions: dict[str, dict[str, dict[float, Record]]] = defaultdict(lambda: defaultdict(dict))
    records = of_measure(full, "track")
    order = methods_in_order(records)
    for record in sorted(records, key=lambda record: order.index(record.method)):
        named = _CASE.fullmatch(record.case)
        if named and errors(record):
            motions[named[1]][record.method][1e-3 * float(named[2])] = record
    return [readout_chart(motion, methods) for motion, methods in motions.items()]


def draw_readout(full: Records, path: Path) -> bool:
    """Write the picture, the same bytes for the same records and versions; whether there is anything to draw."""
    charts = readout_charts(full)
    if charts:
        write_charts(charts, path, "", columns=len(charts), one_legend=True)
    return bool(charts)
