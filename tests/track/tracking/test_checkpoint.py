"""Runs that are killed go on to the same bits; what is no checkpoint of theirs is refused in one line."""

from __future__ import annotations

import hashlib
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import hostile
import numpy as np
import pytest
import synthetic
from numpy.testing._private.utils import runstring

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import read_estimate
from rstrack.options import Options
from rstrack.tracking import succession
from rstrack.tracking.runs import checkpoint
from rstrack.tracking.runs.done import Done
from rstrack.tracking.runs.record import Noise
from rstrack.tracking.runs.run import track
from rstrack.tracking.spline_tracker import Tracker

FRAMES = 16
NOISE = Noise(1e-3, 0.01, 3)
OPTIONS = Options(method="rs-pg", keyframe_distance=0.03, bootstrap_frames=3, backend="llvm")


# The command, with a checkpoint after every frame, of which none takes less than a fifth of a second.
SLOW = """
import sys, time
from rstrack.cli.main import main
from rstrack.tracking.runs import checkpoint
from rstrack.tracking.spline_tracker import Tracker
checkpoint._EVERY_S, checkpoint._SHARE, feed = 0.0, 1e9, Tracker.feed
Tracker.feed = lambda *given: (time.sleep(0.2), feed(*given))[1]
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """With two frames that are lost in the middle, after which the track begins anew."""
    root = tmp_path_factory.mktemp("checkpoint") / "seq"
    stream = {"readout_s": 0.02}
    config = synthetic.make_config(width=80, height=60, color=stream, depth=stream)
    synthetic.make_sequence(root, config, FRAMES)
    for k in (9, 10):
        for name in ("rgb", "depth"):
            image = sorted((root / name).iterdir())[k]
            image.write_bytes(sorted((root / name).iterdir())[0].read_bytes() if name == "rgb" else b"")
    return open_dataset(root)


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """A checkpoint after every frame."""
    monkeypatch.setattr(checkpoint, "_EVERY_S", 0.0)
    monkeypatch.setattr(checkpoint, "_SHARE", np.inf)


def killed_after(count: int) -> Progress:
    """A progress that breaks off, as a crash does, after so many frames."""
    seen: list[str] = []

    def progress(name: str, *_: object) -> None:
        seen.append(name)
        if len(seen) > count:
            raise RuntimeError("crashed")

    return progress


def files(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in ("trajectory.txt", "spline.npz")}


@pytest.mark.parametrize("late", [100.0, 0.0])  # keyframes part by part, and at once
@pytest.mark.parametrize("memory_gb, reference", [(2.0, "keyframe"), (1e-6, "keyframe"), (2.0, "model")])
def test_a_run_that_crashes_again_and_again_comes_to_the_same_bits(
    dataset: Dataset, tmp_path: Path, often: None, memory_gb: float, reference: str, late: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(succession, "_PART_PX", 1)
    monkeypatch.setattr(succession, "_LATE", late)
    options = Options(**(vars(OPTIONS) | {"memory_gb": memory_gb, "reference": reference, "voxel_m": 0.03}))
    whole = track(dataset, options, tmp_path / "whole", noise=NOISE)
    for count in (2, 5, 2, 4):
        with pytest.raises(RuntimeError, match="crashed"):
            track(
                dataset,
                options,
                tmp_path / "cut",
                noise=NOISE,
                progress=killed_after(count),
                resume=True,
            )
    (tmp_path / "cut").rename(tmp_path / "elsewhere")
    cut = track(dataset, options, tmp_path / "elsewhere", noise=NOISE, resume=True)
    assert files(tmp_path / "whole") == files(tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere" / checkpoint.FOLDER).exists() and cut.unreadable == whole.unreadable != ()
    a, b = (read_estimate(tmp_path / name) for name in ("whole", "elsewhere"))
    assert len(a.info["timings"]["frame_ms"]) == len(b.info["timings"]["frame_ms"]) == FRAMES - 2
    for name in ("frames", "spline_valid", "lost", "keyframes"):
        assert a.info[name] == b.info[name], name


def test_a_killed_process_goes_on(dataset: Dataset, tmp_path: Path) -> None:
    command = ["track", str(dataset.root), "--method", "rs-g", "--quiet"]
    child = subprocess.Popen([sys.executable, "-c", SLOW, *command, "--out", str(tmp_path / "cut")])
    state, deadline = tmp_path / "cut" / checkpoint.FOLDER / "state.pickle", time.monotonic() + 60.0
    while not state.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    assert state.exists() and not (tmp_path / "cut" / "run.json").exists()
    assert main([*command, "--out", str(tmp_path / "cut"), "--resume"]) == 1
    assert main([*command, "--out", str(tmp_path / "whole")]) == 1  # two frames cannot be read
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


def test_only_the_same_run_goes_on(dataset: Dataset, tmp_path: Path, often: None) -> None:
    out = tmp_path / "run"
    with pytest.raises(RuntimeError):
        track(dataset, OPTIONS, out, progress=killed_after(6), resume=True)
    other = Options(**(vars(OPTIONS) | {"knot_spacing_s": 0.05}))
    with pytest.raises(UserError, match=r"knot_spacing_s 0\.025, not 0\.05: give the same"):
        track(dataset, other, out, resume=True)
    with pytest.raises(UserError, match=r"noise sigma_depth 0\.0, not 0\.001"):
        track(dataset, OPTIONS, out, noise=Noise(1e-3), resume=True)
    with pytest.raises(UserError, match=r"frames \[0, 16\], not \[0, 12\]"):
        track(dataset, OPTIONS, out, slice(0, 12), resume=True)
    state = out / checkpoint.FOLDER / "state.pickle"
    for damaged in (b"", state.read_bytes()[:-100], b"hello"):
        state.write_bytes(damaged)
        with pytest.raises(UserError, match="cannot be read") as caught:
            track(dataset, OPTIONS, out, resume=True)
        assert "\n" not in str(caught.value)
    # Anew, it does not matter what is there.
    assert track(dataset, OPTIONS, out, slice(0, 6)).end == "done" and not state.exists()
    with pytest.raises(UserError, match="has come to its end"):
        track(dataset, OPTIONS, out, slice(0, 6), resume=True)


def write_state(out: Path, data: bytes) -> None:
    """As `save` does, with a right checksum."""
    (out / checkpoint.FOLDER / "state.pickle").write_bytes(hashlib.sha256(data).digest() + data)


def test_what_is_damaged_or_wants_all_memory_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    def begun() -> checkpoint.Checkpoint:
        made = checkpoint.checkpoint_of(tmp_path, dataset, range(FRAMES), Tracker(dataset.rig, OPTIONS), {})
        assert made is not None
        return made

    begun().save(Done())
    path = tmp_path / checkpoint.FOLDER / "state.pickle"
    whole = path.read_bytes()
    assert begun().resume() == Done()
    for way, data in hostile.damaged(whole, 0):
        path.write_bytes(data)
        with pytest.raises(UserError, match=r"state\.pickle: cannot be read \(.*checksum differs"):
            begun().resume()
        assert way
    # Opcodes: a global, an integer of 8 bytes, a tuple of one, a call.
    name = lambda module, text: f"c{module}\n{text}\n".encode()  # noqa: E731
    number = lambda value: b"\x8a\x08" + int(value).to_bytes(8, "little")  # noqa: E731
    call = b"\x85R"
    for ops in (
        name("builtins", "set") + name("builtins", "range") + number(10**11) + call + call,
        name("builtins", "bytearray") + number(10**11) + call,
        name("numpy", "ndarray") + number(10**13) + b"\x85" + call,
        b"Nr\xff\xff\xff\x7f",  # a memo with 2^31 entries
        b"\x8e" + b"\xff" * 8,  # 2^64 bytes
        b"]" * 200_000 + b"a" * 199_999,
    ):
        write_state(tmp_path, b"\x80\x05" + ops + b".")
        with pytest.raises(UserError, match=r"state\.pickle: cannot be read") as caught:
            begun().resume()
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    hostile.sparse(path)
    with pytest.raises(UserError, match="more than"):
        begun().resume()


def test_nothing_is_run_by_reading(dataset: Dataset, tmp_path: Path, often: None) -> None:
    out = tmp_path / "run"
    (out / checkpoint.FOLDER).mkdir(parents=True)

    touched = tmp_path / "touched"
    code = f"open({str(touched)!r}, 'w')"

    class Evil:
        def __init__(self, function: object, *arguments: object) -> None:
            self.call = function, arguments

        def __reduce__(self) -> tuple[object, ...]:
            return self.call

    for evil in (Evil(os.system, f"touch {touched}"), Evil(eval, code), Evil(runstring, code, {}),
                 Evil(atomic_write, touched, b"")):  # fmt: skip
        write_state(out, pickle.dumps(evil))
        with pytest.raises(UserError, match="which no run has"):
            track(dataset, OPTIONS, out, resume=True)
    # What a module of ours imports is not ours: a class, and one by a dotted name.
    for module, name in (("rstrack.keyframes.archive", "TemporaryDirectory"), ("pathlib", "os._wrap_close")):
        texts = b"".join(b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, name))
        write_state(out, b"\x80\x04" + texts + b"\x93)R.")
        with pytest.raises(UserError, match="which no run has"):
            track(dataset, OPTIONS, out, resume=True)
    assert not touched.exists()


def test_a_full_disk_ends_checkpoints_and_not_the_run(
    dataset: Dataset, tmp_path: Path, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, _: bytes) -> None:
        raise UserError(f"{path}: cannot be written (No space left on device): free space")

    monkeypatch.setattr(checkpoint, "atomic_write", full)
    found = track(dataset, OPTIONS, tmp_path / "run")
    assert found.end == "done" and "cannot be resumed: " in found.text() and "No space left" in found.text()
    assert "No space left" in read_estimate(tmp_path / "run").info["checkpoint_error"]


def test_what_cannot_be_resumed_says_so(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match="--resume is for spline methods"):
        track(dataset, Options(method="baseline", backend="llvm"), tmp_path, resume=True)
    assert main(["track", str(dataset.root), "--out", str(tmp_path), "--resume", "--calibrate"]) == 2
    assert "rstrack calibrate --out camera.yaml" in capsys.readouterr().err
