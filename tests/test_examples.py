"""The scripts of docs/examples run, and do what they say."""

from __future__ import annotations

import html
import importlib.util
import json
import re
import shlex
import sys
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import realsense_camera
import synthetic

from rsgen.array_types import ByteArray, FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Frame, Image, Rig
from rstrack.options import Options
from rstrack.peers.peer import run_command
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.spline_tracker import Tracker

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs/examples"


def load(name: str) -> ModuleType:
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def errors(T: FloatArray, T_true: FloatArray) -> FloatArray:
    """Of motions since the first of the poses (n, 4, 4), in m."""
    error = se3.inverse(se3.inverse(T_true[0]) @ T_true) @ (se3.inverse(T[0]) @ T)
    return np.asarray(np.linalg.norm(error[:, :3, 3], axis=1))


def librealsense() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        pytest.skip(f"librealsense, which records and plays the camera's file, cannot be loaded: {error}")
    return pyrealsense2


@pytest.mark.parametrize("camera", ["librealsense", "a stand-in"])
def test_the_live_loop_follows_a_realsense(
    camera: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, images = tmp_path / "one.db3", realsense_camera.frames()
    if camera == "librealsense":
        librealsense()
        realsense_camera.record(file, images)
    else:
        monkeypatch.setitem(sys.modules, "pyrealsense2", realsense_camera.stand_in(images))
    tracker = load("live_realsense").main([str(file)])

    stamps, T = tracker.trajectory
    # librealsense's playback may begin with the second frame.
    given = stamps - realsense_camera.FIRST_S
    assert len(given) >= realsense_camera.COUNT - 1 and np.allclose(given, realsense_camera.stamps()[-len(given) :])
    T_true = realsense_camera.TRUTH.pose(given)
    assert np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3]) > 0.04
    assert errors(T, T_true).max() < 0.2e-3  # a unit of depth is 1 mm
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(given) and not any("lost" in line for line in lines)


def test_frames_of_a_camera_wait_while_the_tracker_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", realsense_camera.stand_in(realsense_camera.frames()))
    all_came = threading.Event()

    def camera() -> Iterator[int]:
        yield from range(70)
        all_came.set()

    frames = load("live_realsense").meanwhile(camera())
    taken = [next(frames)]
    assert all_came.wait(10)
    taken += frames
    # Two of three are skipped, then every second one, until few wait.
    steps = np.diff(taken)
    assert taken[0] == 0 and taken[-1] == 69 and sorted(steps)[::-1] == steps.tolist() and set(steps) == {3, 2, 1}


def test_the_sensor_in_a_mitsuba_script(tmp_path: Path) -> None:
    example = load("mitsuba_sensor")
    edges = {}
    for readout_s in (0.0, 0.03):
        image = example.render(readout_s)[..., 0]
        bright = image > 0.4
        # The stripe's edge that is nearest to the middle in the first row, followed down.
        at, found = 80.0, []
        for row in bright:
            ends = np.flatnonzero(row[1:] & ~row[:-1]) + 0.5
            at = float(ends[np.abs(ends - at).argmin()])
            found.append(at)
        edges[readout_s] = np.array(found)
    camera = example.CAMERA
    # A direction at tan φ in the first row's camera is seen at tan(φ − ω t) in that of a row at t.
    phi = np.arctan((edges[0.03][0] - camera.cx) / camera.fx)
    t = 0.03 * np.arange(camera.height) / camera.height
    seen = camera.cx + camera.fx * np.tan(phi - example.RATE * t)
    np.testing.assert_allclose(edges[0.03], seen, atol=1.5)
    assert np.ptp(edges[0.0]) == 0 and np.ptp(seen) > 12
    example.main([str(tmp_path / "rolling.png")])
    assert (tmp_path / "rolling.png").read_bytes().startswith(b"\x89PNG")


def checked(spline: Spline, camera: Camera, shutter: Shutter, stamp: float, T_cam_body: FloatArray) -> ByteArray:
    """As synthetic.render_color, but with corners: soft cells of 20 cm."""
    p, d = synthetic.pixel_rays(spline, camera, shutter, stamp, T_cam_body)
    waves = np.sin((p + d * synthetic.cast(p, d)[..., None]) * np.pi / 0.2 + np.array([0.3, 1.1, 2.0]))
    gray = 128 + 100 * np.tanh(3 * waves.prod(axis=-1))
    return np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=-1)


def test_a_tracker_of_ones_own_in_the_bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthetic, "render_color", checked)
    config = synthetic.make_config(160, 120, {"readout_s": 0.0}, {"readout_s": 0.0})
    root = synthetic.make_sequence(tmp_path / "seq", config, 8)
    script = shlex.join([sys.executable, str(EXAMPLES / "own_tracker.py")])
    estimate = run_command("flow", f"{script} {{sequence}} {{out}}", root, tmp_path / "flow")
    T, T_true = estimate.T_world_depth, synthetic.make_spline().pose(estimate.stamps)
    off, moved = errors(T, T_true), np.linalg.norm(T_true[:, :3, 3] - T_true[0, :3, 3], axis=1)
    assert len(T) == 8 and moved[-1] > 0.15 and off.max() < 0.2 * moved[-1]  # 12 % at 160 columns


# --- the live loop by a clock of its own ------------------------------------------------------------------------------


class Clock:
    """Time passes where it is told to: as `time.perf_counter`, and `sleep` as `time.sleep`."""

    now = 5.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now += seconds


def queue_of_one(count: int, period: int, busy: list[int]) -> list[int]:
    """What is taken, tick by tick: a frame a period, the waiting one replaced; the n-th taken needs busy[n] ticks."""
    waiting: list[int] = []
    taken: list[int] = []
    free_at = 0
    for tick in range(count * period + sum(busy)):
        if tick % period == 0 and tick < count * period:
            waiting = [tick // period]
        if tick >= free_at and waiting:
            free_at = tick + busy[len(taken)]
            taken.append(waiting.pop())
    return taken


def test_one_frame_waits_and_a_newer_one_takes_its_place() -> None:
    survivors, rng, dropped = load("live_loop").survivors, np.random.default_rng(2), 0
    for _ in range(200):
        count = int(rng.integers(1, 30))
        busy = rng.integers(1, 32 * int(rng.integers(1, 5)), count).tolist()
        clock, taken = Clock(), []
        for n, arrived in survivors(count, 1 / 32, clock, clock.sleep):
            assert arrived == 5.0 + 32 * n and clock() - arrived < max(busy)
            clock.now += busy[len(taken)]
            taken.append(n)
        assert taken == queue_of_one(count, 32, busy)
        dropped += count - len(taken)
    assert dropped > 500


def test_the_longer_the_queue_the_more_frames_are_skipped() -> None:
    survivors = load("live_loop").survivors

    def taken(first: float, each: float, queue: int) -> list[int]:
        """The first frame needs so many periods, all others `each`."""
        clock, found = Clock(), []
        for n, _ in survivors(40, 1 / 32, clock, clock.sleep, queue):
            clock.now += 32 * (each if found else first)
            found.append(n)
        return found

    assert taken(9.5, 0.5, 10) == [*range(40)]  # it catches up
    one_of_two = taken(9.5, 0.5, 5)
    assert one_of_two[:5] == [0, 2, 4, 6, 7] and one_of_two[4:] == [*range(7, 40)]
    assert np.diff(taken(16.5, 1.5, 5)).max() == 4 and taken(16.5, 1.5, 5)[-1] == 39
    assert taken(9.5, 0.5, 1)[:3] == [0, 9, 10]


CAMERA, SHUTTER = Camera(160, 120, 120.0, 120.0, 79.5, 59.5), Shutter(readout_s=0.028)


def test_what_survives_the_clock_gives_the_same_bits_without_it() -> None:
    truth, rig = synthetic.make_spline(0.3), Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, synthetic.T_COLOR_DEPTH)

    def camera(n: int) -> Frame:
        depth = synthetic.render_depth(truth, CAMERA, SHUTTER, n / 30)
        color = synthetic.render_color(truth, CAMERA, SHUTTER, n / 30, synthetic.T_COLOR_DEPTH)
        return Frame(Image(n / 30, depth), (Image(n / 30, color),))

    class Slow(Tracker):
        """Takes time of the clock: less than a frame's, and now and then two or three frames'."""

        def feed(self, frame: Frame) -> FrameReport:
            clock.now += (0.4, 0.9, 2.3, 0.5, 3.1, 0.2)[len(self.reports) % 6] / 30
            return super().feed(frame)

    clock, slow = Clock(), Slow(rig, Options(method="rs-pg"))
    fed, latencies = load("live_loop").live(slow, camera, 20, 30.0, clock, clock.sleep)
    assert len(slow.reports) == len(fed) < 16 and not any(report.lost for report in slow.reports)
    assert latencies.max() == pytest.approx(3.1 / 30) and latencies.min() < 1 / 30

    again, all_of_them = (Tracker(rig, Options(method="rs-pg")) for _ in range(2))
    for n in range(20):
        all_of_them.feed(camera(n))
        if n in fed:
            again.feed(camera(n))
    splines = [t.spline.control_points for t in (slow, again, all_of_them) if t.spline is not None]
    assert splines[0].tobytes() == splines[1].tobytes() != splines[2].tobytes()
    for live, offline in zip(slow.trajectory, again.trajectory, strict=True):
        assert live.tobytes() == offline.tobytes()


def test_the_live_loop_says_what_it_dropped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, clock = synthetic.make_sequence(tmp_path / "seq", frames=6), Clock()
    words = [str(root), "--method", "rs-g", "--seconds", "0.3", "--hz", "30", "--check"]
    load("live_loop").main(words, clock, clock.sleep)
    first, second, third = capsys.readouterr().out.splitlines()
    assert first == "6 frames in 0.2 s: 6 fed, 0 dropped, 0 lost, 0 cut short"
    assert second.startswith("latency, ms: median 0.0, 95 % 0.0") and third.endswith("the same bits")
    assert clock.now == pytest.approx(5.0 + 5 / 30)
    with pytest.raises(SystemExit):
        load("live_loop").main([str(root), "--queue", "0"])
    assert "--queue 0: one frame at least" in capsys.readouterr().err


NOTEBOOKS = [EXAMPLES / "scene_to_table.ipynb", EXAMPLES / "quickstart.ipynb"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_what_it_prints(path: Path) -> None:
    cells = json.loads(path.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5 and all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


def shown_by(path: Path) -> list[Any]:
    """What the cells of a notebook show when it is run."""
    nbformat = pytest.importorskip("nbformat", reason="pip install '.[docs]' to run the notebook")
    nbclient = pytest.importorskip("nbclient", reason="pip install '.[docs]' to run the notebook")
    pytest.importorskip("ipykernel", reason="pip install '.[docs]' to run the notebook")
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=1200, kernel_name="python3").execute()
    return [out["data"] for cell in notebook.cells for out in cell.get("outputs", ()) if "data" in out]


def test_the_notebook_runs_from_a_scene_to_a_table() -> None:
    shown = shown_by(NOTEBOOKS[0])
    table = next(data["text/markdown"] for data in shown if "text/markdown" in data)
    ate = {name: float(value) for name, value in re.findall(r"`([\w-]+)` \| [^|]+ \| ([\d.]+) \|", table)}
    assert ate["rs-pg"] < 1.0 and ate["gs-pg"] > 3.0 * ate["rs-pg"]
    assert sum("image/png" in data for data in shown) == 2


@pytest.mark.nightly  # minutes, the first time: the room and its light are made
def test_the_quickstart_ends_with_a_leaderboard() -> None:
    page = html.unescape(next(data["text/html"] for data in shown_by(NOTEBOOKS[1]) if "text/html" in data))
    assert page.index("rs-pg") < page.index("gs-pg") < page.index("standing-still")


def test_the_container_is_made_of_all_that_the_wheel_is() -> None:
    lines = (EXAMPLES / "Dockerfile").read_text().splitlines()
    copied = {word for line in lines if line.startswith("COPY ") for word in line.split()[1:-1]}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert copied == {*wheel["only-include"], *project["project"]["license-files"], "pyproject.toml", "README.md"}
    assert all((ROOT / word).exists() for word in copied)
