"""A command line is declared by a function's parameters, and by the fields of the settings it takes."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from rsgen.console.command_line import Commands, Json, run_program

GIVEN: dict[str, Any] = {}


@dataclass(frozen=True)
class Settings:
    size_m: Annotated[float, "how large, m", "M", "--size"] = 0.5
    fuse: Annotated[bool | None, "together (default: yes)"] = None
    label: Annotated[Literal["a", "b"], "name"] = "a"


def do_it(
    place: Annotated[Path, "where"],
    thing: Settings,
    more: Annotated[list[Path], "what else"],
    *,
    out: Annotated[Path, "to write"],
    label: Annotated[list[str] | None, "may be repeated"] = None,
    names: Annotated[tuple[str, ...] | None, "several"] = None,
    frame: Annotated[int, "index", int] = 3,
    pairs: Annotated[int, "100 % of them"] = 2,
    from_: Annotated[str | None, "origin"] = None,
    json: Json = False,
    **fields: str,
) -> int:
    """Do it."""
    GIVEN.clear()
    GIVEN.update(locals())
    return 7


def run(words: str) -> int:
    commands = Commands("program", "test")
    command = commands.add(do_it, "here", "there", note="a note")
    command.add_argument("--a.b", default=argparse.SUPPRESS)
    return run_program("program", lambda: commands.parser, words.split(), "")


def test_defaults_are_those_of_the_declaration() -> None:
    assert run("do-it here x y --out o") == 7
    assert {
        "place": Path("here"), "thing": Settings(), "more": [Path("x"), Path("y")], "out": Path("o"), "label": None,
        "names": None, "frame": 3, "pairs": 2, "from_": None, "json": False, "fields": {},
    } == GIVEN  # fmt: skip


def test_every_kind_of_option() -> None:
    words = (
        "do-it here x --out o --label p --label q --names r s --frame -1 --from t --json --a.b 5 --size-m 2 --no-fuse"
    )
    assert run(words) == 7
    assert GIVEN["label"] == ["p", "q"] and GIVEN["names"] == ["r", "s"] and GIVEN["frame"] == -1
    assert GIVEN["from_"] == "t" and GIVEN["json"] and GIVEN["fields"] == {"a.b": "5"}
    assert GIVEN["thing"] == Settings(2.0, False)  # --label is the command's own
    assert run("do-it here x --out o --size 3 --fuse") == 7 and GIVEN["thing"] == Settings(3.0, True)


@pytest.mark.parametrize(
    "words", ["", "here x", "here --out o", "here x --out o --pairs 0", "here x --out o --size nan"]
)
def test_what_is_wrong_is_one_line(words: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(f"do-it {words}") == 2
    out, error = capfd.readouterr()
    assert out == "" and error.startswith("program: ") and error.count("\n") == 1


def test_help_says_name_meaning_and_default_once(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("do-it --help")
    text = " ".join(capfd.readouterr().out.split())
    for part in (
        "Do it.", "--size-m M, --size M how large, m (default: 0.5)", "--fuse, --no-fuse together (default: yes) ",
        "--pairs N 100 % of them (default: 2)", "the thing:",
        "example: program do-it here example: program do-it there a note",
    ):  # fmt: skip
        assert part in text, part
    assert text.count("--label") == 2  # in the usage, and with its help


def test_a_package_that_is_missing_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    """Regression: run from its folder, without being installed, `rstrack track` ended in a traceback."""

    def parser() -> Any:
        return version("a-package-that-nobody-has")

    assert run_program("program", parser, [], "") == 2
    out, error = capfd.readouterr()
    assert out == "" and error.startswith("program: a-package-that-nobody-has is not installed for ")
    assert error.count("\n") == 1


def test_a_library_that_dr_jit_lacks_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    """Regression: in a bare container Dr.Jit's own failure to fail hid what was missing."""

    def like_dr_jit() -> Any:
        try:
            raise ImportError("libatomic.so.1: cannot open shared object file: No such file or directory")
        except ImportError:
            return _drjit_ext.__file__  # type: ignore[name-defined]  # noqa: F821

    assert run_program("program", like_dr_jit, [], "") == 2
    out, error = capfd.readouterr()
    assert out == "" and error.startswith("program: Dr.Jit cannot be loaded (libatomic.so.1: ")
    assert "apt-get install libatomic1" in error and error.count("\n") == 1
    with pytest.raises(NameError):
        run_program("program", lambda: nothing_of_that_name, [], "")  # type: ignore[name-defined]  # noqa: F821
