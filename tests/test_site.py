"""The documents as a site: all are in its navigation, its links hold, MkDocs builds it without a warning."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS, SITE = ROOT / "docs", ROOT / "docs/site"
CONFIG = yaml.safe_load((SITE / "mkdocs.yml").read_text())

spec = importlib.util.spec_from_file_location("hooks", SITE / "hooks.py")
assert spec is not None and spec.loader is not None
hooks = importlib.util.module_from_spec(spec)
spec.loader.exec_module(hooks)


def pages(nav: Any) -> list[str]:
    """Files of a navigation."""
    if isinstance(nav, str):
        return [nav]
    return [page for entry in (nav.values() if isinstance(nav, dict) else nav) for page in pages(entry)]


def test_every_document_is_in_the_navigation_once() -> None:
    found = [path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md") if path.parent != SITE]
    assert sorted(pages(CONFIG["nav"])) == sorted([*found, "index.md", "guide.md"])


def test_the_front_page_shows_what_the_readme_says_of_the_records() -> None:
    page, readme = hooks.front_page(), (ROOT / "README.md").read_text()
    rows = [line for line in readme.splitlines() if line.startswith("| `") or line.startswith("| method |")]
    assert len(rows) > 10 and all(row in page for row in rows)
    assert "On real recordings" in page and "{{" not in page and "](docs/" not in page


def test_every_module_is_in_the_reference_once() -> None:
    told = [
        name for package in hooks.PACKAGES for wing in hooks.wings(package) for name in hooks.modules(package, wing)
    ]
    public = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for package in hooks.PACKAGES
        for path in (ROOT / package).rglob("*.py")
    ]
    assert sorted(told) == sorted(name for name in public if name not in hooks.PACKAGES and "__main__" not in name)
    assert "::: rsgen.geometry.so3\n" in hooks.reference("rsgen", "geometry")
    assert "members: false" in hooks.reference("rsgen", "geometry").partition("aprilgrid")[0]
    assert re.findall(r"::: (.*)", hooks.face("rstrack"))[-1] == "rstrack.tracking.spline_tracker.Tracker"
    config = SimpleNamespace(nav=[{"Reference": []}], mdx_configs={"toc": {}})
    listed = pages(hooks.on_config(config).nav)
    assert len(listed) == len(set(listed)) > 40 and "reference/rsgen/geometry.md" in listed


@pytest.mark.parametrize(
    ("page", "text", "led"),
    [
        ("guide.md", "[a](docs/format.md#a-config)", "[a](format.md#a-config)"),
        ("guide.md", "![a](docs/compare.jpg)", "![a](compare.jpg)"),
        ("guide.md", "[b](docs/examples/README.md) [c](#more)", "[b](examples/README.md) [c](#more)"),
        ("format.md", "[a](../README.md#track-it)", "[a](guide.md#track-it)"),
        ("method.md", "[`p`](../pyproject.toml) [x](https://example.org/a)", "`p` [x](https://example.org/a)"),
        ("examples/README.md", "[a](../format.md) [b](own.ipynb)", "[a](../format.md) [b](own.ipynb)"),
    ],
)
def test_links_lead_to_the_same_place(page: str, text: str, led: str) -> None:
    shown = hooks.on_page_markdown(text, SimpleNamespace(file=SimpleNamespace(src_uri=page)), None, None)
    assert shown.partition("\n")[0] == led


class Page(HTMLParser):
    """Targets of a page's links and pictures, and its anchors."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.anchors.add(value or "")
            elif name in ("href", "src") and value and not re.match(r"[a-z]+:", value):
                self.targets.append(value)


def test_the_site_is_built_without_a_warning_and_its_links_hold(tmp_path: Path) -> None:
    for module in ("mkdocs", "material", "mkdocstrings_handlers"):
        pytest.importorskip(module, reason="pip install '.[docs]' to build the site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(SITE / "mkdocs.yml"), "-d", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    read = {path: Page(path.read_text()) for path in tmp_path.rglob("*.html") if path.name != "404.html"}
    assert len(read) > 50
    for path, page in read.items():
        for target in page.targets:
            name, _, anchor = target.partition("#")
            file = (path.parent / name).resolve() if name else path
            assert file.exists(), f"{path}: {target}"
            assert not anchor or file.suffix != ".html" or anchor in read[file].anchors, f"{path}: {target}"
