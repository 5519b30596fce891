"""The README and docs/: links and anchors resolve, commands and imports exist."""

from __future__ import annotations

import ast
import importlib
import io
import pkgutil
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path

import pytest

from benchmarks.plan import PLAN, draw
from rsgen.cli.main import main as rsgen
from rstrack.cli.main import main as rstrack

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").rglob("*.md")), ROOT / "benchmarks/README.md"]
PROGRAMS: dict[str, Callable[[list[str]], object]] = {"rsgen": rsgen, "rstrack": rstrack}

document = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
# Links of the site's front page lead to pages that are made with it: tests/test_site.py follows them.
linked = pytest.mark.parametrize("path", [p for p in DOCUMENTS if p.parent.name != "site"], ids=lambda path: path.name)


def blocks(path: Path, language: str) -> list[str]:
    """Code blocks of a language, '' for those that name none."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", path.read_text(), flags=re.M | re.S)
    return [text for name, text in found if name == language]


def prose(path: Path) -> str:
    """A document without its code blocks."""
    return re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.M | re.S)


def anchors(path: Path) -> set[str]:
    """Anchors of a document's headings, as GitHub makes them, and those that it names itself."""
    titles = re.findall(r"^#+ (.*)$", prose(path), flags=re.M)
    made = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
    return made | set(re.findall(r'<a id="([^"]+)">', prose(path)))


def links(path: Path) -> list[str]:
    """Targets of a document's links and pictures that lie within the project."""
    targets = re.findall(r"\]\(([^)\s]+)\)", prose(path))
    return [target for target in targets if not target.startswith("https://")]


def commands(path: Path) -> Iterator[list[str]]:
    """Words of each command of ours in a document, in blocks and in the text."""
    joined = [block.replace("\\\n", " ") for block in blocks(path, "")]
    lines = [line.partition("#")[0] for block in joined for line in block.splitlines()]
    for line in [*lines, *re.findall(r"`([^`]+)`", prose(path))]:
        words = shlex.split(line) if line.startswith((*PROGRAMS, "./run.sh")) else []
        if len(words) > 1:
            yield words


@cache
def help_of(program: str, *command: str) -> str:
    """What a command prints for --help, one of a group by both its words."""
    printed = io.StringIO()
    with redirect_stdout(printed), redirect_stderr(printed), suppress(SystemExit):
        PROGRAMS[program]([*command, "--help"])
    text = printed.getvalue()
    assert "invalid choice" not in text and "--help" in text, f"{program} has no command '{' '.join(command)}'"
    return text


def test_the_readme_is_short_and_begins_with_a_picture() -> None:
    lines = README.read_text().splitlines()
    assert len(lines) <= 200
    assert any(line.startswith("![") for line in lines[:20])


@linked
def test_links_lead_somewhere(path: Path) -> None:
    for target in links(path):
        name, _, anchor = target.partition("#")
        file = path.parent / name if name else path
        assert file.exists(), f"{path.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{path.name}: {target}"


def test_every_picture_is_shown() -> None:
    shown = {(path.parent / target).resolve() for path in DOCUMENTS for target in links(path)}
    pictures = {path for path in (ROOT / "docs").iterdir() if path.suffix in (".png", ".jpg", ".svg")}
    assert pictures and pictures <= shown


@document
def test_commands_exist_with_their_options(path: Path) -> None:
    for program, command, *words in commands(path):
        if program == "./run.sh":
            assert re.search(rf"^  {command}\)", (ROOT / "run.sh").read_text(), flags=re.M), command
            continue
        known = help_of(program, command)
        if "COMMAND" in known.partition("\n")[0]:
            known = help_of(program, command, words[0])
        for option in (word.partition("=")[0] for word in words if re.match(r"--\w", word)):
            assert re.search(rf"{re.escape(option)}\b", known), f"{path.name}: {program} {command} {option}"
        assert all((ROOT / word).exists() for word in words if word.startswith("configs/") and "K" not in word), words


@document
def test_python_examples_import_what_is_there(path: Path) -> None:
    for block in blocks(path, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in PROGRAMS:
                module = importlib.import_module(node.module or "")
                assert all(hasattr(module, alias.name) for alias in node.names), ast.unparse(node)


@document
def test_names_and_files_in_the_text_exist(path: Path) -> None:
    for word in re.findall(r"`([^`\s]+)`", prose(path)):
        if re.fullmatch(r"(rsgen|rstrack)(\.\w+)+", word):
            pkgutil.resolve_name(word)
        elif re.fullmatch(r"(rsgen|rstrack|scenes|tests|configs)/[\w/.]+", word):
            assert (ROOT / word).exists(), word


def test_the_plan_is_what_the_contracts_say_and_has_every_wing() -> None:
    assert PLAN.read_text() == draw(), "python -m benchmarks.plan draws it anew"
    for package in PROGRAMS:
        wings = [path.parent.name for path in (ROOT / package).glob("*/__init__.py")]
        assert len(wings) > 9 and all(f">{wing}</text>" in draw() for wing in wings)
