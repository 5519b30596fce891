"""The page: what it is made of, and how that becomes one HTML file that loads nothing.

html = render(Page("lr_kt2", "tracked with rs-pg", cards, facts, (PageSection("errors", "Errors", blocks),)))
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from rsgen.console.tables import Table
from rsgen.files import atomic_write, make_folder
from rstrack.charts.chart import Chart, PathChart
from rstrack.charts.to_page import AnyChart, PlotlyFigure, figure_of
from rstrack.data.estimate import plain


@dataclass(frozen=True)
class Card:
    """One number that a reader wants: its value with a unit, what it is, and what to compare it with.

    verdict: whether all is well, or not.
    """

    value: str
    label: str
    note: str = ""
    verdict: Literal["", "good", "bad"] = ""


@dataclass(frozen=True)
class CardRow:
    """Cards side by side; title: what they have in common."""

    cards: tuple[Card, ...]
    title: str = ""


@dataclass(frozen=True)
class Plot:
    """A chart of at most so many points a line. Paths are drawn from above where the browser has no WebGL."""

    chart: AnyChart
    points: int = 1500
    block: Literal["plot"] = "plot"

    @property
    def is_3d(self) -> bool:
        """Whether it can be turned."""
        return isinstance(self.chart, PathChart)

    @property
    def heading(self) -> str:
        """Its title, with the unit of a chart that has one."""
        return self.chart.heading if isinstance(self.chart, Chart) else self.chart.title


@dataclass(frozen=True)
class PageImage:
    """uri: an image as a data URI. alt: what it shows, in words."""

    uri: str
    caption: str
    alt: str


@dataclass(frozen=True)
class ImageRow:
    """Pictures side by side."""

    items: tuple[PageImage, ...]
    block: Literal["pictures"] = "pictures"


@dataclass(frozen=True)
class Slider:
    """Two pictures of one size on top of each other; a slider uncovers the one below."""

    title: str
    before: PageImage
    after: PageImage
    note: str = ""
    block: Literal["slider"] = "slider"


@dataclass(frozen=True)
class Note:
    """A sentence or two. is_warning: something is wrong or missing."""

    text: str
    is_warning: bool = False
    block: Literal["note"] = "note"


@dataclass(frozen=True)
class TextFile:
    """A text file to copy, or to save under its name."""

    name: str
    text: str
    block: Literal["file"] = "file"

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        return "data:text/plain;base64," + base64.b64encode(self.text.encode()).decode("ascii")


@dataclass(frozen=True)
class Sortable:
    """A table whose rows are put in order by a click on a heading; what is no number comes last."""

    table: Table
    block: Literal["sortable"] = "sortable"


Block = Table | Sortable | Plot | ImageRow | Slider | Note | TextFile


@dataclass(frozen=True)
class Chooser:
    """Of several groups of blocks, by name, one is shown at a time."""

    label: str
    options: tuple[tuple[str, tuple[Block, ...]], ...]
    block: Literal["chooser"] = "chooser"


@dataclass(frozen=True)
class PageSection:
    """A part of the page; key: its anchor."""

    key: str
    title: str
    blocks: tuple[Block | Chooser, ...]


@dataclass(frozen=True)
class Page:
    """cards: the numbers at the top, by rows. facts: (what, value). All text is plain: the page escapes it."""

    title: str
    subtitle: str
    cards: tuple[CardRow, ...]
    sections: tuple[PageSection, ...]
    facts: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    made_with: str = ""


def plots(charts: Sequence[Chart | PathChart], points: int = 1500) -> tuple[Plot, ...]:
    """A block for each chart."""
    return tuple(Plot(chart, points) for chart in charts)


def number(value: float | None, scale: float = 1.0) -> str:
    """Four significant digits, a dash for None."""
    if value is None:
        return "–"
    scaled = value * scale
    return f"{scaled:.0f}" if abs(scaled) >= 1e4 else f"{scaled:.4g}"


def render(page: Page) -> str:
    """The page as HTML with everything in it: styles, scripts, figures with plotly.js (once), and pictures."""
    from jinja2 import Environment, StrictUndefined  # imports of a tenth of a second, which only a report needs
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]

    figures: list[PlotlyFigure] = []

    def add_figure(plot: Plot) -> tuple[int, int | None]:
        """Its number, and its height in px where that goes by its rows."""
        figures.append(figure_of(plot.chart, plot.points))
        return len(figures) - 1, figures[-1].pop("height", None)

    here = files("rstrack.report")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.globals["add_figure"] = add_figure
    template = environment.from_string((here / "page.html").read_text("utf-8"))
    return template.render(
        page=page,
        css=Markup((here / "page.css").read_text("utf-8")),
        script=Markup((here / "page.js").read_text("utf-8")),
        plotly=lambda: Markup(get_plotlyjs() if figures else ""),  # 4 MB
        figures=lambda: Markup(_json(figures)),
    )


def write_page(page: Page, out: Path) -> Path:
    """Write a page, its folder too if need be; returns its path. Raises UserError."""
    page = replace(page, made_with=f"rstrack {version('rolling-shutter-rgbd')}")
    make_folder(out.parent, out)
    atomic_write(out, render(page).encode())
    return out


def _json(data: Any) -> str:
    """JSON that no text in it can end the script element early."""
    return json.dumps(plain(data), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
