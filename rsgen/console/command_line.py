"""What the commands `rsgen` and `rstrack` share: one-line errors, exit statuses, and how words and numbers are read.

Import it before NumPy: it limits OpenBLAS to one thread.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import json
import logging
import math
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

# The banded solves are small: threads only get in each other's way (measured, up to 1000x on a busy machine).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from rsgen.errors import UserError

Run = Callable[..., int]


@dataclasses.dataclass(frozen=True)
class Alone:
    """Among what is declared of an option: the value that it has where no word follows it."""

    value: Any


_METAVARS: dict[Any, str] = {int: "N", float: "X"}
_NO_MATTER = (None, "", (), False)  # defaults of which help says nothing


class _Help(argparse.HelpFormatter):
    """Wraps each line by itself: examples stay one below the other."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(super(_Help, self)._fill_text(line, width, indent) for line in text.splitlines())


class Parser(argparse.ArgumentParser):
    """Complains like everything else here: in one line."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        options.setdefault("allow_abbrev", False)
        super().__init__(*arguments, **options)

    def error(self, message: str) -> NoReturn:
        """Raise UserError with the message."""
        raise UserError(f"{message} (see '{self.prog} --help')")


class Commands:
    """A program with commands. description: shown as it is by --help."""

    def __init__(self, name: str, description: str, parser: Parser | None = None) -> None:
        raw = argparse.RawDescriptionHelpFormatter
        self.name = name
        self.parser = parser or Parser(name, description=description, formatter_class=raw)
        self._commands = self.parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)

    def group(self, name: str, description: str) -> Commands:
        """Commands of their own after the word `name`. description: one sentence, shown by --help of either."""
        help = description[0].lower() + description[1:].rstrip(".")
        parser = self._commands.add_parser(name, help=help, description=description)
        return Commands(f"{self.name} {name}", description, parser)

    def add(self, run: Run, *examples: str, note: str = "") -> argparse.ArgumentParser:
        """The command that `run` declares: its name, its docstring as help, an argument for every parameter.

        A parameter is `Annotated[type, help, *more]`, an option if it is keyword-only. more: a converter of words, a
        metavar, or another name of the option ("--voxel"). Of int (count) and float (number) those below convert; list
        takes the option repeatedly, tuple with several words. A parameter whose type is a dataclass of such fields gets
        an option for each that the command has not itself, but for fields whose metadata has command_line False, which
        are for Python alone; **fields gets what else is added to the parser, if given.
        The docstring's first sentence is what the program's own help says of it. examples: what may follow the
        command's name, one at least; note: a last line of help.
        """
        name = run.__name__.strip("_").replace("_", "-")
        text = " ".join(str(run.__doc__).split()).replace("%", "%%")
        shown = [f"example: {self.name} {name} {words}".rstrip() for words in examples]
        command = self._commands.add_parser(
            name, help=(text[0].lower() + text[1:]).partition(". ")[0].rstrip("."), description=text,
            epilog="\n".join([*shown, note]), formatter_class=_Help,
        )  # fmt: skip
        parameters, hints = inspect.signature(run).parameters, get_type_hints(run, include_extras=True)
        groups = {n: hints[n] for n in parameters if dataclasses.is_dataclass(hints[n])}
        for parameter in parameters.values():
            if parameter.name not in groups and parameter.kind is not parameter.VAR_KEYWORD:
                _add(command, parameter.name, hints[parameter.name], parameter.default, parameter.kind)
        own: dict[str, list[str]] = {}
        for group, declared in groups.items():
            fields = [field for field in dataclasses.fields(declared) if field.name not in parameters]
            own[group] = [field.name for field in fields]
            within = command.add_argument_group(f"the {group.replace('_', ' ')}")
            meant = get_type_hints(declared, include_extras=True)
            for field in fields:
                if field.metadata.get("command_line", True):
                    _add(within, field.name, meant[field.name], field.default)
                else:
                    _refuse(within, field.name, declared.__name__, field.default)

        def call(given: dict[str, Any]) -> int:
            made = {group: groups[group](**{n: given.pop(n) for n in names}) for group, names in own.items()}
            return run(**given, **made)

        command.set_defaults(call=call)
        return command


def _add(to: Any, name: str, hint: Any, default: Any, kind: Any = inspect.Parameter.KEYWORD_ONLY) -> None:
    """An argument of the parser or group `to`, as `Commands.add` says it."""
    type_, text, *more = get_args(hint)
    if get_origin(type_) in (Union, UnionType):  # ... | None
        type_ = get_args(type_)[0]
    many = get_origin(type_) if get_origin(type_) in (list, tuple) else None
    type_ = get_args(type_)[0] if many else type_
    required = default in (inspect.Parameter.empty, dataclasses.MISSING)
    told = required or default in _NO_MATTER or "(default" in text
    how: dict[str, Any] = {"help": (text if told else f"{text} (default: {default})").replace("%", "%%")}
    if not required:
        how["default"] = str(default) if isinstance(default, Path) else default  # of a word, argparse converts it
    names = [word for word in more if isinstance(word, str) and word.startswith("--")]
    metavar = next((word for word in more if isinstance(word, str) and word not in names), _METAVARS.get(type_))
    convert = next((word for word in more if callable(word)), {int: count, float: number}.get(type_, type_))
    if type_ is bool:
        how |= {"action": "store_true" if default is False else _YesNo}
    elif get_origin(type_) is Literal:
        how |= {"choices": get_args(type_), "metavar": metavar}
    else:
        how |= {"type": convert, "metavar": metavar}
    for alone in (word for word in more if isinstance(word, Alone)):
        how |= {"nargs": "?", "const": alone.value}
    if kind is not inspect.Parameter.KEYWORD_ONLY:
        nargs = {(True, True): "+", (True, False): "*", (False, False): "?"}.get((bool(many), required))
        to.add_argument(name, **how, **({"nargs": nargs} if nargs else {}))
        return
    if many:
        how |= {"action": "append"} if many is list else {"action": "extend", "nargs": "+"}
    flag = "--" + name.strip("_").replace("_", "-")
    to.add_argument(flag, *names, dest=name, required=required, **how)


def _refuse(to: Any, name: str, declared: str, default: Any) -> None:
    """A field of the dataclass `declared` that has no option: whoever gives one is told where it is."""

    class Refusal(argparse.Action):
        def __call__(self, _: object, __: object, ___: object, option: str | None = None) -> NoReturn:
            raise UserError(f"{option}: is for Python alone, {declared}({name}=...): leave it out here")

    flag = "--" + name.replace("_", "-")
    to.add_argument(flag, dest=name, default=default, action=Refusal, nargs="?", help=argparse.SUPPRESS)


class _YesNo(argparse.BooleanOptionalAction):
    """--this or --no-this; what it is without either, the help says in words."""

    def __init__(self, *arguments: Any, default: Any = None, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.default = default


def refuse_options(what: str, given: Mapping[str, object]) -> None:
    """Raises UserError for the first of these options that is given (no None, False or empty one): `what` has none."""
    for name, value in given.items():
        if value:
            raise UserError(f"{name}: is not for {what}")


def print_figures(found: Any, as_json: bool) -> None:
    """What was measured, as its text() or as its as_dict()."""
    print(json.dumps(found.as_dict(), indent=2) if as_json else found.text())


def run_program(
    name: str, parser: Callable[[], Parser], words: Sequence[str] | None, interrupted: str,
    moved: Mapping[str, str] | None = None,
) -> int:  # fmt: skip
    """Parse the words (default: the process's own), run the command, and return the exit status.

    0 done, 1 a check failed, 2 wrong input, 130 interrupted, of which `interrupted` says what it means.
    moved: for commands that were, what does it now, after the program's name.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    words = sys.argv[1:] if words is None else words
    try:
        if words and (now := (moved or {}).get(words[0])) is not None:
            raise UserError(f"{words[0]}: is now '{name} {now}'")
        options = parser().parse_args(joined(words))
        given = vars(options)
        status: int = given.pop("call")(given)
        sys.stdout.flush()
        return status
    except UserError as error:
        said = _one_line(str(error))
    except ModuleNotFoundError as error:  # a package's description counts as one: it is told with what was computed
        said = f"{error.name} is not installed for {sys.executable}: ./run.sh setup, or pip install ."
    except NameError as error:  # Dr.Jit's way to fail where a library of the system is missing
        if not isinstance(error.__context__, ImportError):
            raise
        mend = "install that library (Debian/Ubuntu: 'sudo apt-get install libatomic1')"
        said = f"Dr.Jit cannot be loaded ({error.__context__}): {mend}"
    except BrokenPipeError:
        # Whoever read our output has seen enough; the interpreter would complain when it flushes the rest.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a name that is too long, a full disk: what no reader or writer has put into words
        said = _one_line(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except KeyboardInterrupt:
        print(f"{name}: interrupted; {interrupted}", file=sys.stderr)
        return 130
    print(f"{name}: {said}", file=sys.stderr)
    return 2


def _one_line(text: str) -> str:
    """Printable, whatever names and values it quotes, and in one line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))


def joined(words: Sequence[str]) -> list[str]:
    """`--offset -1e-3` as `--offset=-1e-3`: argparse takes a negative number with an exponent for an option."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1].startswith("--") and "=" not in joined[-1] and _is_negative(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _is_negative(word: str) -> bool:
    try:
        return word.startswith("-") and float(word.partition(",")[0]) <= 0  # or a point: -1,2,3
    except ValueError:
        return False


def count(text: str) -> int:
    """A whole number of at least one."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got '{text}'")
    return number


def number(text: str) -> float:
    """A finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"expected a finite number, got '{text}'")
    return number


def parse_frames(text: str | None) -> slice:
    """Frames 'A:B' (B excluded, either may be left out) or a single 'A'; None: all. Raises UserError."""
    if text is None:
        return slice(None)
    begin, colon, end = text.partition(":")
    try:
        low = int(begin) if begin or not colon else 0
        high = (int(end) if end else None) if colon else low + 1
    except ValueError:
        low, high = -1, None
    if low < 0 or (high is not None and high <= low):
        raise UserError(f"--frames {text}: expected A:B with 0 <= A < B, for example 0:100")
    return slice(low, high)


Frames = Annotated[slice | None, "only frames A to B-1 (default: all)", "A:B", parse_frames]
Json = Annotated[bool, "print machine-readable figures"]
Quiet = Annotated[bool, "no progress"]
SkipMissing = Annotated[bool, "leave out meshes, textures and sky pictures that the scene names and that are not there"]
