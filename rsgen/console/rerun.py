"""Recordings of rerun (.rrd), whose package is an optional extra."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsgen.errors import UserError, how_to_install
from rsgen.files import whole_file


def rerun(option: str) -> Any:
    """The module. Raises UserError, naming the option that needs it, if it is not installed."""
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise UserError(f"{option}: rerun is not installed: {how_to_install('rerun')}") from None


@contextmanager
def recording_file(file: Path, program: str, name: str, option: str) -> Iterator[tuple[Any, Any]]:
    """The module and a recording that is at `file`, whole, once the block ends well; else nothing is there.

    program, name: what the viewer shows. Raises UserError: rerun is not installed, the file is not named .rrd or is
    there already, its folder is not, or it cannot be written.
    """
    rr = rerun(option)
    if file.suffix != ".rrd":
        raise UserError(f"{option} {file}: a rerun recording is named .rrd")
    if file.exists():
        raise UserError(f"{option} {file}: is there already: choose another name or delete it")
    if not file.parent.is_dir():
        raise UserError(f"{option} {file}: no such folder as {file.parent}: make it or choose another name")
    recording = rr.RecordingStream(program, recording_id=name)
    with whole_file(file) as temporary:
        try:
            recording.save(temporary)
            yield rr, recording
            recording.flush()
        finally:
            recording.disconnect()
