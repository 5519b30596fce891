"""What the commands `rsgen` and `rstrack` share: one-line errors, exit statuses, and how words and numbers are read.

Import it before NumPy: it limits OpenBLAS to one thread.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

# The banded solves are small: threads only get in each other's way (measured, up to 1000x on a busy machine).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from rsgen.errors import UserError

Run = Callable[[argparse.Namespace], int]


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

    def __init__(self, name: str, description: str) -> None:
        self.name = name
        self.parser = Parser(name, description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
        self._commands = self.parser.add_subparsers(required=True, metavar="COMMAND")

    def add(self, name: str, run: Run, help: str, example: str) -> argparse.ArgumentParser:
        """A command that calls `run` and returns its exit status; example: what may follow its name."""
        command = self._commands.add_parser(
            name, help=help, description=f"{help[0].upper()}{help[1:]}.",
            epilog=f"example: {self.name} {name} {example}",
        )  # fmt: skip
        command.set_defaults(run=run)
        return command


def run_program(name: str, parser: Callable[[], Parser], words: Sequence[str] | None, interrupted: str) -> int:
    """Parse the words (default: the process's own), run the command, and return the exit status.

    0 done, 1 a check failed, 2 wrong input, 130 interrupted, of which `interrupted` says what it means.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        options = parser().parse_args(joined(sys.argv[1:] if words is None else words))
        status: int = options.run(options)
        sys.stdout.flush()
    except UserError as error:
        print(f"{name}: {_one_line(str(error))}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # Whoever read our output has seen enough; the interpreter would complain when it flushes the rest.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a name that is too long, a full disk: what no reader or writer has put into words
        where = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        print(f"{name}: {_one_line(where)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{name}: interrupted; {interrupted}", file=sys.stderr)
        return 130
    return status


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


def parse_frames(text: str | None) -> slice:
    """Frames 'A:B' (B excluded, either may be left out) or a single 'A'. Raises UserError."""
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
