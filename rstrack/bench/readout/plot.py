"""The picture of the readout sweep: error against readout, a line for each method, a panel for each motion."""

from __future__ import annotations

from pathlib import Path

from rstrack.bench.methods.results import QUANTITIES
from rstrack.bench.readout.results import points_of
from rstrack.bench.readout.run import SweepResult
from rstrack.charts.chart import Chart, Line, method_colors, numbers
from rstrack.charts.to_file import write_charts

_NOTE = "Dashed: the shutter is taken for a global one, or for a lidar's sweep."


def sweep_charts(result: SweepResult) -> list[Chart]:
    """ATE over readout with its interval: motions, then exposures. Points that are lost are left out."""
    ate = QUANTITIES[0]
    points = points_of(result, ate)
    colors = method_colors(result.methods)
    charts = []
    for exposure in result.config.exposures_s:
        for entry in result.config.motions:
            lines = []
            for method in result.methods:
                found = [
                    p for p in points if (p.case.motion, p.case.exposure_s, p.method) == (entry.name, exposure, method)
                ]
                found.sort(key=lambda p: p.case.readout_s)
                spans = [numbers([getattr(p, name) for p in found], ate.scale) for name in ("mean", "low", "high")]
                x = numbers([p.case.readout_s for p in found], 1e3)
                is_dashed = method not in ("rs-pg", "rs-g")
                lines.append(Line(method, colors[method], x, spans[0], is_dashed, True, spans[1], spans[2]))
            title = (
                entry.name if len(result.config.exposures_s) == 1 else f"{entry.name}, exposure {1e3 * exposure:g} ms"
            )
            charts.append(Chart(f"{title}: ATE (RMSE)", ate.unit, "readout, ms", tuple(lines), is_log=True, note=_NOTE))
    return charts


def draw_sweep(result: SweepResult, path: Path) -> None:
    """Write the picture. Raises UserError."""
    write_charts(sweep_charts(result), path, "", columns=len(result.config.motions), one_legend=True)
