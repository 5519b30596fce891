"""The leaderboard of `rstrack score`: a table a tier, every sequence, what the readout does, and who the methods are.

write_page(leaderboard(scores), Path("out/index.html"))
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rsgen.console.tables import NOTHING, Entry, Table, best_marked, significant
from rstrack.bench.figures import figure_of, heading
from rstrack.charts.chart import Chart, Curve, method_colors, numbers
from rstrack.charts.to_file import write_charts
from rstrack.report.page import Chooser, ImageRow, Note, Page, PageImage, PageSection, Sortable
from rstrack.score.scores import FIGURES, Scores
from rstrack.score.suite import MethodResults, SuiteEntry

_BY_READOUT = ("ate_mm", "drift_mm_s")
_ABOUT = (
    "Means over all sequences of the tier. A method has one only where it is scored on every one of them; what is "
    "missing, lost (fewer than half of the frames have a pose) or failed is counted in the last column and named "
    "below. Errors of a line need splines, and are over the sequences whose truth is one; NEES needs covariances. "
    "Green: the best. Click a heading to sort."
)
_OWN = (
    "To add a method: track the sequences with it, put its poses at METHOD/SEQUENCE.txt (TUM: stamp tx ty tz qx qy qz "
    "qw, the depth camera's poses at its frames' stamps; METHOD/method.yaml says 'camera: color' for the colour "
    "camera's), and run: rstrack score SUITE RESULTS --out OUT."
)


def leaderboard(scores: Scores) -> Page:
    """The page of some scores."""
    suite = scores.suite
    words = " ".join(word for word in (suite.name, suite.version) if word)
    sections = [
        PageSection(f"tier{k}", f"Tier {tier}" if tier != "all" else "Overall", (Note(_ABOUT), Sortable(table)))
        for k, tier in enumerate(suite.tiers)
        for table in [_tier_table(scores, tier)]
    ]
    names = _figures(scores) or FIGURES[:1]
    by_figure = Chooser("Figure", tuple((heading(n), (Sortable(_sequence_table(scores, n)),)) for n in names))
    sections.append(PageSection("sequences", "Sequence by sequence", (by_figure,)))
    if pictures := [picture for name in _groups(scores) if (picture := _by_readout(scores, name)) is not None]:
        note = Note("Sequences that differ in their cameras' readout alone. A line is broken where a track is lost.")
        sections.append(PageSection("readout", "By readout", (note, *(ImageRow((p,)) for p in pictures))))
    sections.append(PageSection("methods", "Methods", (_methods(scores), Note(_OWN))))
    if gaps := scores.gaps:
        sections.append(PageSection("gaps", "Not scored, and why", tuple(Note(line) for line in gaps)))
    return Page(
        title="Leaderboard",
        subtitle=f"{words}: sequences {len(suite.entries)}, methods {len(scores.methods)}",
        cards=(),
        sections=tuple(sections),
        warnings=() if not gaps else (f"Not scored: {len(gaps)}. The end of the page says what, and why.",),
    )


def summary(scores: Scores) -> str:
    """The tables of the tiers for the terminal."""
    return "\n\n".join(f"tier {tier}\n{_tier_table(scores, tier).text()}" for tier in scores.suite.tiers)


# ---------------------------------------------------------------------------------------------------------------------


def _figures(scores: Scores) -> tuple[str, ...]:
    """Those that anybody has."""
    return tuple(n for n in FIGURES if any(s.value(n) is not None for s in scores.by_name.values()))


def _tier_table(scores: Scores, tier: str) -> Table:
    """A row a method, in the order of their ATE."""
    names, methods = _figures(scores), _ranked(scores, tier)
    columns = [_marked(name, [scores.mean(tier, m.key, name) for m in methods]) for name in names]
    rows: list[tuple[Entry | str, ...]] = []
    for k, method in enumerate(methods):
        counts = {s: len(scores.within(tier, method.key, s)) for s in ("lost", "missing", "failed")}
        note = ", ".join(f"{n} {status}" for status, n in counts.items() if n)
        done = f"{len(scores.within(tier, method.key, 'scored'))} of {len(scores.suite.tier(tier))}"
        rows.append((method.name, *(column[k] for column in columns), Entry(done, note=note)))
    return Table(("method", *map(heading, names), "scored"), tuple(rows))


def _sequence_table(scores: Scores, name: str) -> Table:
    """A row a sequence, a column a method; a word where there is no figure."""
    rows: list[tuple[Entry | str, ...]] = []
    methods = _ranked(scores, scores.suite.tiers[0])
    for s in scores.sequences:
        found = [scores.of(s.entry.name, method.key) for method in methods]
        marked = _marked(name, [score.value(name) for score in found])
        shown = [
            Entry(score.status) if entry.text == NOTHING and score.status != "scored" else entry
            for score, entry in zip(found, marked, strict=True)
        ]
        rows.append((Entry(s.entry.name, note=_counted_as(s.entry)), significant(s.readout_ms), *shown))
    return Table(("sequence", "readout, ms", *(method.name for method in methods)), tuple(rows))


def _ranked(scores: Scores, tier: str) -> list[MethodResults]:
    """The methods by their mean ATE over a tier, those without last."""
    means = {method.key: scores.mean(tier, method.key, "ate_mm") for method in scores.methods}
    return sorted(scores.methods, key=lambda method: math.inf if (m := means[method.key]) is None else m)


def _counted_as(entry: SuiteEntry) -> str:
    return ", ".join(word for word in (entry.tier if entry.tier != "all" else "", entry.role, entry.group) if word)


def _marked(name: str, values: Sequence[float | None]) -> list[Entry]:
    """Entries of a figure, the best one marked where one is better than another."""
    figure, entries = figure_of(name), [Entry(significant(value)) for value in values]
    if not figure.is_judged:
        return entries
    return best_marked(entries, values, math.inf if figure.better == "more" else figure.nominal)


def _groups(scores: Scores) -> tuple[str, ...]:
    """Names of the ladders whose sequences all differ in their readout."""
    readouts: dict[str, list[float]] = {}
    for s in scores.sequences:
        if s.readout_ms is not None and s.entry.group:
            readouts.setdefault(_ladder(s.entry), []).append(s.readout_ms)
    return tuple(name for name, found in readouts.items() if len(set(found)) == len(found) > 1)


def _ladder(entry: SuiteEntry) -> str:
    """The group, which may have a ladder in each of several rooms: names then end in their value, ROOM_14ms."""
    return " ".join(word for word in (entry.group, entry.name.rpartition("_")[0]) if word)


def _by_readout(scores: Scores, group: str) -> PageImage | None:
    """Errors over the readout of a group's sequences; None where no method has any."""
    ladder = [s for s in scores.sequences if _ladder(s.entry) == group and s.readout_ms is not None]
    ladder.sort(key=lambda s: s.readout_ms or 0.0)
    keys, x = [method.key for method in scores.methods], numbers([s.readout_ms for s in ladder])
    colors = method_colors(keys)
    # There are fewer colours than methods may be.
    dashed = {key for k, key in enumerate(keys) if colors[key] in {colors[other] for other in keys[:k]}}
    charts = []
    for name in _BY_READOUT:
        curves = tuple(
            Curve(method.name, colors[method.key], x, y, method.key in dashed, has_points=True)
            for method in scores.methods
            for values in [[scores.of(s.entry.name, method.key).value(name) for s in ladder]]
            if any(value is not None for value in values)
            for y in [numbers(values)]
        )
        figure = figure_of(name)
        if curves:
            charts.append(Chart(figure.title, figure.unit, "readout, ms", curves, is_log=True))
    if not charts:
        return None
    return PageImage(_svg_uri(charts), group, f"{group}: errors over the readout of every method")


def _svg_uri(charts: Sequence[Chart]) -> str:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "charts.svg"
        write_charts(charts, file, one_legend=True)
        return "data:image/svg+xml;base64," + base64.b64encode(file.read_bytes()).decode("ascii")


def _methods(scores: Scores) -> Table:
    rows = tuple(
        (
            Entry(m.name, link=m.about.url),
            {"depth": "the depth camera's", "color": "the colour camera's"}[m.about.camera],
            {"se3": "rigid", "sim3": "rigid and scale"}[m.about.alignment],
            m.about.note,
        )
        for m in scores.methods
    )
    return Table(("method", "poses are", "alignment", "note"), rows, words=(0, 1, 2, 3))
