"""Whole files only: atomic writes, text and YAML that are read back strictly or not at all, and paths of listings."""

from __future__ import annotations

import errno
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from rsgen.errors import UserError
from rsgen.inputs import MOST_BYTES, check_input

_MOST_YAML_VALUES, _DEEPEST_YAML = 1_000_000, 200


def atomic_write(path: Path, data: bytes) -> None:
    """Write `data` to `path` so that the file is there whole or not at all, whenever the process is killed.

    Raises UserError (full disk, no permission, ...); the temporary file is removed and what was there before stays.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            with temporary.open("wb") as file:
                file.write(data)
            os.replace(temporary, path)  # noqa: PTH105 - one name for tests to break
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise write_error(path, error) from None


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """A text file of these lines, as `atomic_write` writes it. Raises UserError."""
    atomic_write(path, "".join(f"{line}\n" for line in lines).encode())


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A name beside `path`, of the same suffix, for libraries that write files themselves.

    Once the block ends well, what was written there is at `path`; else it is deleted. Raises UserError for an OSError.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise write_error(path, error) from None
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path`, whose own folder is made too, for what is to be there.

    Once the block ends well it is at `path`, in place of what was; else it is deleted. Raises UserError for an OSError.
    """
    temporary, old = (path.with_name(f".{path.name}.{os.getpid()}.{word}.tmp") for word in ("new", "old"))
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        yield temporary
        if path.exists():
            path.rename(old)
        os.replace(temporary, path)  # noqa: PTH105 - one name for tests to break
    except OSError as error:
        raise write_error(path, error) from None
    finally:
        if old.exists() and not path.exists():
            old.rename(path)
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def make_folder(folder: Path, named: Path | None = None) -> None:
    """Make a folder, and those above it, unless it is there. Raises UserError about what was named: by default it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(named or folder, error) from None


def write_error(path: Path, error: OSError) -> UserError:
    """The one line for a failed write."""
    cure = {
        errno.EACCES: "make the folder writable",
        errno.EPERM: "make the folder writable",
        errno.EROFS: "that disk is read-only",
    }.get(error.errno or 0, "free space")
    return UserError(
        f"{path}: cannot be written ({_reason(error)}): {cure} or choose another --out, "
        "then run the same command again to resume"
    )


def remove_stale_temporaries(folder: Path) -> None:
    """Delete the temporary files that killed writers left in `folder` (those of living processes stay)."""
    for path in folder.glob(".*.tmp"):
        writer = path.name.split(".")[-2]
        if writer.isdigit() and not _is_running(int(writer)):
            path.unlink(missing_ok=True)


def is_temporary(path: Path) -> bool:
    """True for the names that `atomic_write` uses while it writes."""
    return path.name.startswith(".") and path.name.endswith(".tmp")


def encode_yaml(data: Mapping[str, Any]) -> bytes:
    """Block-style YAML in the given order, lists of numbers on one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=120, allow_unicode=True).encode()


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: yaml.SafeDumper, data: list[Any]) -> yaml.Node:
    flat = all(isinstance(item, int | float) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


_Dumper.add_representer(list, _represent_list)


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The whole file, of `most` bytes at most. Raises UserError if it cannot be read, is empty, or no file."""
    check_input(path, most)
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({_reason(error)})") from None
    if not data:
        raise UserError(f"{path}: is empty")
    return data


def read_text(path: Path) -> str:
    """The whole file as UTF-8. Raises UserError."""
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not a text file") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML mapping. Raises UserError."""
    try:
        data = parse_yaml(read_text(path))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        raise UserError(f"{path}:{f' line {mark.line + 1}' if mark else ''} is not valid YAML") from None
    if not isinstance(data, dict):
        raise UserError(f"{path}: expected a mapping")
    return data


def parse_yaml(text: str) -> Any:
    """What `yaml.safe_load` returns. Raises its YAMLError, ValueError or RecursionError.

    Refused as well, as a YAMLError, are aliases that stand for more than a million values or for themselves: a few
    lines of them would keep whatever walks the data busy for ever.
    """
    try:
        # libyaml is seven times as quick; not every build of PyYAML has it.
        fast = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        return _parsed(text, fast) if _is_flat(text, fast) else _parsed(text, yaml.SafeLoader)
    except (yaml.YAMLError, ValueError):
        return _parsed(text, yaml.SafeLoader)  # which says better what is wrong, and where


def _parsed(text: str, kind: Any) -> Any:
    loader = kind(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _values(node, {}) > _MOST_YAML_VALUES:
            raise yaml.MarkedYAMLError(problem="aliases repeat too much of it", problem_mark=node.start_mark)
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _is_flat(text: str, kind: Any) -> bool:
    """Whether collections are nested so little that libyaml's composer does not overflow the stack."""
    loader, depth, deepest = kind(text), 0, 0
    try:
        while loader.check_event() and deepest <= _DEEPEST_YAML:
            event = loader.get_event()
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            deepest = max(deepest, depth)
    finally:
        loader.dispose()
    return deepest <= _DEEPEST_YAML


def _values(node: yaml.Node, known: dict[int, float]) -> float:
    """Number of values that a node stands for, aliases written out; infinite if it holds itself."""
    if id(node) not in known:
        known[id(node)] = math.inf  # until it is counted: who meets it on the way meets it within itself
        inner = [] if isinstance(node, yaml.ScalarNode) else node.value
        parts = [part for item in inner for part in (item if isinstance(item, tuple) else (item,))]
        known[id(node)] = 1 + sum(_values(part, known) for part in parts)
    return known[id(node)]


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except OSError as error:
        return not isinstance(error, ProcessLookupError)  # but another user's
    return True


def listed_file(root: Path, real_root: Path, path: str, where: str, missing: str) -> Path:
    """The file `path` that a listing names, which has to lie in `root` even once symbolic links are followed.

    real_root: root, resolved. where: the listing's line, missing: what to do if there is no such file, for messages.
    Raises UserError.
    """
    file = root / path
    try:
        real = file.resolve()
        exists = real.is_file()
    except (OSError, ValueError, RuntimeError):
        raise UserError(f"{where}: {path[:60]!r} is not a usable path") from None
    if Path(path).is_absolute() or ".." in Path(path).parts or not real.is_relative_to(real_root):
        raise UserError(f"{where}: path {path[:200]!r} leaves the folder")
    if not exists:
        raise UserError(f"{where}: {file} is missing: {missing}")
    return file
