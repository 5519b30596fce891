"""A tracker in the middle of a run, on disk: a run that was killed goes on from there, to the same bits.

What a rig's tracker is made of anew (kernels, lenses) is named, not written; what is on the device is written as it is;
images of keyframes that are put away go to files of their own, once (`rstrack.keyframes.archive`).
"""

from __future__ import annotations

import hashlib
import io
import pickle
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rsgen.device.arrays import Engine
from rsgen.errors import UserError
from rsgen.files import atomic_write, write_error
from rsgen.inputs import check_input
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import INFO
from rstrack.keyframes.archive import Archive
from rstrack.tracking.loop_tracker import LoopTracker
from rstrack.tracking.runs.done import Done
from rstrack.tracking.spline_tracker import Tracker

FOLDER = "checkpoint"
_STATE = "state.pickle"
_DIGEST = hashlib.sha256().digest_size  # of what follows it
# A run is written down so often at most (s), and takes this part of its time for it at most.
_EVERY_S, _SHARE = 30.0, 0.03
# What a checkpoint is made of, and nothing else is called when one is read: classes that these define, and these names.
_PACKAGES = (
    "rsgen.device.", "rsgen.geometry.", "rstrack.adjustment.", "rstrack.alignment.", "rstrack.images.",
    "rstrack.inertial.", "rstrack.keyframes.", "rstrack.tracking.", "rstrack.volume.", "rstrack.data.rig.",
    "rstrack.data.moving_masks.",
    "rstrack.options.", "collections.", "pathlib.",
)  # fmt: skip
_NAMES = {
    ("numpy", "ndarray"), ("numpy", "dtype"), ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"), ("numpy._core.numeric", "_frombuffer"),
    *(("builtins", name) for name in ("slice", "set", "frozenset", "complex")),
}  # fmt: skip
_LONGEST_RANGE = 1_000_000


def checkpoint_of(
    out: Path, dataset: Dataset, chosen: range, tracker: object, noise: Mapping[str, Any]
) -> Checkpoint | None:  # fmt: skip
    """That of a run into the folder `out`; None for trackers that cannot be written down.

    noise: what is added to the images, by name.
    """
    if not isinstance(tracker, Tracker | LoopTracker):
        return None
    rig, options = dataset.rig, tracker.options
    depth, color = (rig.depth_camera, rig.depth_shutter), (rig.color_camera, rig.color_shutter)
    key: dict[str, Any] = {item.name: getattr(options, item.name) for item in fields(options)}
    key |= {f"noise {name}": value for name, value in noise.items()}
    key |= {
        "dataset": dataset.name, "frames": [chosen.start, chosen.stop], "backend": _engine(tracker).backend,
        "cameras": f"{depth} {color} {rig.T_color_depth.tolist()} {dataset.depth_error}",
        "clocks": [float(dataset.stamps.sum()), float(dataset.color_stamps.sum())],
        "version": version("rolling-shutter-rgbd"),
    }  # fmt: skip
    return Checkpoint(out / FOLDER, tracker, key)


@dataclass
class Checkpoint:
    """The checkpoint of a run in its folder. key: the run's settings; only such a run goes on from it.

    problem: why none can be written any more.
    """

    root: Path
    tracker: Tracker | LoopTracker
    key: Mapping[str, Any]
    problem: str = ""
    _due: float = field(default_factory=lambda: time.monotonic() + _EVERY_S)

    @property
    def _archive(self) -> Archive:
        return self.tracker.uncorrected.track.keyframes.archive

    def begin(self) -> Done:
        """Take away what an earlier run has left; keyframes' files are here from now on."""
        shutil.rmtree(self.root, ignore_errors=True)
        self._archive.images.put_in(self.root)
        return Done()

    def save_when_due(self, done: Done) -> None:
        """Write down where a run is, if it was long ago."""
        if time.monotonic() < self._due or self.problem:
            return
        begun = time.monotonic()
        self.save(done)
        self._due = time.monotonic() + max(_EVERY_S, (time.monotonic() - begun) / _SHARE)

    def save(self, done: Done) -> None:
        """Write down where a run is, whole or not at all: a full disk is no reason to give the run up."""
        try:
            self._save(done)
        except UserError as error:
            self.problem = str(error)

    def _save(self, done: Done) -> None:
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(self.root, error) from None
        self._archive.images.write()
        stream = io.BytesIO()
        _Writer(stream, self.tracker).dump({"key": dict(self.key), "done": done, "tracker": self.tracker.state})
        data = stream.getvalue()
        atomic_write(self.root / _STATE, hashlib.sha256(data).digest() + data)

    def resume(self) -> Done:
        """Bring the tracker, a new one, to where the run was; to its beginning where nothing was written down.

        Raises UserError: damaged, of a run with other settings, or of one that has ended.
        """
        path = self.root / _STATE
        check_input(path)
        try:
            data = path.read_bytes()
        except OSError:
            if (self.root.parent / INFO).exists():
                raise UserError(
                    f"{self.root.parent}: this run has come to its end: track without --resume to do it again"
                ) from None
            return self.begin()
        try:
            if hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
                raise ValueError("its checksum differs")
            found = _Reader(io.BytesIO(data[_DIGEST:]), self.tracker).load()
            key, done, state = found["key"], Done(**vars(found["done"])), found["tracker"]
        except Exception as error:  # whatever bytes of somebody else's make of pickle
            raise UserError(f"{path}: cannot be read ({_one_line(error)}): track without --resume") from None
        for name in sorted({*key, *self.key}):
            if key.get(name) != self.key.get(name):
                raise UserError(
                    f"{path}: is of a run with {name} {key.get(name)}, not {self.key.get(name)}: give the same, or "
                    "track without --resume"
                )
        try:
            self.tracker.state = state
        except KeyError as error:
            raise UserError(f"{path}: is of another version, without {error}: track without --resume") from None
        self._archive.images.put_in(self.root)
        return done

    def remove(self) -> None:
        """The run has come to its end."""
        shutil.rmtree(self.root, ignore_errors=True)


class _Writer(pickle.Pickler):
    def __init__(self, stream: io.BytesIO, tracker: Tracker | LoopTracker) -> None:
        super().__init__(stream, protocol=5)
        self._names = {id(part): name for name, part in _shared(tracker).items()}
        self._arrays = _array_types(_engine(tracker))

    def persistent_id(self, obj: Any) -> str | None:
        return self._names.get(id(obj))

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) in self._arrays:
            return _Array, (self._arrays[type(obj)], obj.numpy())
        return NotImplemented


class _Reader(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, tracker: Tracker | LoopTracker) -> None:
        super().__init__(stream)
        self._parts, self._engine = _shared(tracker), _engine(tracker)

    def persistent_load(self, pid: str) -> Any:
        return self._parts[pid]

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == (__name__, "_Array"):
            return self._array
        if (module, name) == ("builtins", "range"):
            return _range
        if (module, name) in _NAMES:
            return super().find_class(module, name)
        # By the names that a module imports everything could be had.
        if f"{module}.".startswith(_PACKAGES) and "." not in name:
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__ == module:
                return found
        raise pickle.UnpicklingError(f"it holds a {module}.{name}, which no run has")

    def _array(self, kind: str, values: Any) -> Any:
        return self._engine.upload(values) if kind == "Float" else getattr(self._engine, kind)(values)


def _range(*given: int) -> range:
    """None that a set of its numbers could fill the memory with."""
    found = range(*given)
    if len(found) > _LONGEST_RANGE:
        raise pickle.UnpicklingError(f"a range of {len(found)} numbers")
    return found


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


class _Array:
    """Stands for a device array of a kind."""


def _engine(tracker: Tracker | LoopTracker) -> Engine:
    return tracker.uncorrected.track.device.e


def _shared(tracker: Tracker | LoopTracker) -> dict[str, Any]:
    return {"tracker": tracker} | tracker.uncorrected.track.shared


def _array_types(e: Engine) -> dict[Any, str]:
    return {getattr(e, kind): kind for kind in ("Float", "UInt", "Int", "Bool")}
