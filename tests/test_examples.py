"""The scripts of docs/examples run, and do what they say."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import sys
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
from rstrack.peers.peer import run_command

EXAMPLES = Path(__file__).parents[1] / "docs/examples"


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


NOTEBOOK = EXAMPLES / "scene_to_table.ipynb"


def test_the_notebook_is_kept_without_what_it_prints() -> None:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) > 5 and all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


def test_the_notebook_runs_from_a_scene_to_a_table() -> None:
    nbformat = pytest.importorskip("nbformat", reason="pip install '.[docs]' to run the notebook")
    nbclient = pytest.importorskip("nbclient", reason="pip install '.[docs]' to run the notebook")
    pytest.importorskip("ipykernel", reason="pip install '.[docs]' to run the notebook")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    shown = [out["data"] for cell in notebook.cells for out in cell.get("outputs", ()) if "data" in out]
    table = next(data["text/markdown"] for data in shown if "text/markdown" in data)
    ate = {name: float(value) for name, value in re.findall(r"`([\w-]+)` \| [^|]+ \| ([\d.]+) \|", table)}
    assert ate["rs-pg"] < 1.0 and ate["gs-pg"] > 3.0 * ate["rs-pg"]
    assert sum("image/png" in data for data in shown) == 2
