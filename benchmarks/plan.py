"""Draws docs/plan.svg: the folders of both packages as the import contracts in pyproject.toml order them.

python -m benchmarks.plan              # writes it
"""

from __future__ import annotations

import ast
import tomllib
from html import escape
from pathlib import Path

from rsgen.files import atomic_write

ROOT = Path(__file__).parents[1]
PLAN = ROOT / "docs/plan.svg"
# Contract (by a word of its name), title of its column.
_COLUMNS = {"wings of the generator": "rsgen: the generator", "wings of the tracker": "rstrack: the tracker"}
_GROUND = "ground stands on itself"
# What the core does not import: formats of other programs, packs, views, peers, reports.
_GUESTS = (
    "formats", "pack", "suite", "pictures", "report", "score", "bench", "charts", "view", "peers", "cli",
)  # fmt: skip
_TITLE = "A folder may import those below it in its column, and the ground. The core never imports a guest (yellow)."
_WIDTH, _ROW, _GAP, _MARGIN = 560, 34, 6, 20
_COLORS = {"core": "#d5e8e4", "guest": "#f3ead2", "ground": "#dde3ee"}


def draw() -> str:
    """The picture as SVG."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = {contract["name"]: contract["layers"] for contract in contracts if "layers" in contract}
    found = {word: next(layers[name] for name in layers if word in name) for word in (*_COLUMNS, _GROUND)}
    columns = [_rows(found[word]) for word in _COLUMNS]
    ground = _rows(found[_GROUND])
    top = 70
    below = top + max(map(len, columns)) * (_ROW + _GAP) + 50
    height = below + len(ground) * (_ROW + _GAP) + _MARGIN
    width = 2 * _WIDTH + 3 * _MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        _text(_MARGIN, 24, _TITLE, size=14),
    ]
    for k, (title, rows) in enumerate(zip(_COLUMNS.values(), columns, strict=True)):
        x = _MARGIN + k * (_WIDTH + _MARGIN)
        parts.append(_text(x, 56, title, bold=True, size=15))
        parts += [_box(x, top + n * (_ROW + _GAP), _WIDTH, row, False) for n, row in enumerate(rows)]
    parts.append(_text(_MARGIN, below - 14, "rsgen: the ground that both stand on", bold=True, size=15))
    parts += [_box(_MARGIN, below + n * (_ROW + _GAP), width - 2 * _MARGIN, row, True) for n, row in enumerate(ground)]
    return "\n".join([*parts, "</svg>", ""])


def _rows(layers: list[str]) -> list[list[str]]:
    """Modules of each layer, those beside each other in one row; a folder is where its first part stands."""
    rows: list[list[str]] = []
    for layer in layers:
        names = dict.fromkeys(".".join(part.strip().split(".")[:2]) for part in layer.split("|"))
        new = [name for name in names if not any(name in row for row in rows)]
        if new:
            rows.append(new)
    return rows


def _box(x: int, y: int, width: int, modules: list[str], ground: bool) -> str:
    each = (width - _GAP * (len(modules) - 1)) // len(modules)
    parts = []
    for k, module in enumerate(modules):
        name = module.split(".")[1]
        kind = "ground" if ground else "guest" if name in _GUESTS else "core"
        left = x + k * (each + _GAP)
        parts.append(f'<rect x="{left}" y="{y}" width="{each}" height="{_ROW}" rx="5" fill="{_COLORS[kind]}"/>')
        parts.append(_text(left + 8, y + 21, name, bold=True))
        room = int((each - 24 - 8.2 * len(name)) / 6.8)
        parts.append(_text(left + 20 + int(8.2 * len(name)), y + 21, _shortened(_purpose(module), room)))
    return "\n".join(parts)


def _purpose(module: str) -> str:
    """What a module's docstring says first, up to a colon."""
    path = ROOT / module.replace(".", "/")
    text = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
    first = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0].replace("`", "")
    return first.partition(":")[0].partition(". ")[0].rstrip(".")


def _shortened(text: str, room: int) -> str:
    """A text cut at a word to so many characters."""
    return text if len(text) <= room else text[: max(room - 2, 0)].rpartition(" ")[0].rstrip(",:;.") + " …"


def _text(x: int, y: int, text: str, bold: bool = False, size: int = 13) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x}" y="{y}" font-size="{size}"{weight}>{escape(text)}</text>'


if __name__ == "__main__":
    atomic_write(PLAN, draw().encode())
