"""Other ways to the same picture show the same, and times are counted right; light is measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny
from rendering import CAMERA, constant_twist, emission_integrator, room_xml

from benchmarks.measures import MEASURES
from benchmarks.measures.render_worker import (
    MODES,
    Mode,
    ModeTimes,
    _measure,
    figures_of,
    render_averaged,
    render_figures,
    render_rows,
    row_renderer,
    time_modes,
)
from rsgen.config.config import load_config
from rsgen.errors import UserError
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import ColorRenderer
from rsgen.scene.loading import load_scene
from rstrack.bench.cells import load_benchmark
from rstrack.bench.record import CellRecord
from rstrack.bench.runner import run_cells
from rstrack.bench.task import Sources

MOTION = constant_twist((0.5, 0.2, 0.0, 0.4, 3.0, 2.0))
STAMP = 0.05


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


@pytest.fixture(scope="module")
def glowing(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return load_scene(room_xml(tmp_path_factory.mktemp("glowing")))


def picture(scene: Any, shutter: Shutter, spp: int = 64) -> np.ndarray:
    return ColorRenderer(scene, emission_integrator(), CAMERA, shutter, spp).render(MOTION, STAMP, 7)


def test_a_render_for_each_row_makes_the_rolling_shutters_picture(glowing: Any) -> None:
    shutter = Shutter(0.05)
    renderer = row_renderer(glowing, emission_integrator(), CAMERA, 64)
    rows = [0, 7, 8, 20, CAMERA.height - 1]
    got = render_rows(renderer, MOTION, STAMP, shutter.line_delay(CAMERA), rows)
    assert got.shape == (5, CAMERA.width, 3)
    rolling, still = picture(glowing, shutter)[rows], picture(glowing, Shutter())[rows]
    assert rms(got, rolling) < 0.01 < 0.05 < rms(got[2:], still[2:])
    assert rms(got[0], still[0]) < 0.01  # the first row is read at the stamp


def test_averaged_sharp_renders_make_the_blurred_picture(glowing: Any) -> None:
    renderer = ColorRenderer(glowing, emission_integrator(), CAMERA, Shutter(), 1)
    got = render_averaged(renderer, MOTION, STAMP, 0.04, 64)
    blurred, late = picture(glowing, Shutter(0, 0.04)), picture(glowing, Shutter(0, 0.004))
    assert rms(got, blurred) < 0.015 < 0.03 < rms(got, late)


def times(**seconds: list[list[float]]) -> dict[str, ModeTimes]:
    return {name.replace("_", "-"): ModeTimes(np.array(s), 0.04) for name, s in seconds.items()}


def test_ratios_are_of_the_same_round_or_else_of_the_same_frame() -> None:
    # The machine slows down tenfold between the frames: pairs do not see it.
    found = figures_of(times(still=[[1, 2], [10, 20]], rs_blur=[[1.5, 3], [15, 30]], path=[[20.25], [202.5]]))
    assert found["rs_blur_ratio"] == pytest.approx(1.5) and found["path_ratio"] == pytest.approx(13.5)
    assert found["path_to_rs_blur_ratio"] == pytest.approx(9.0)
    assert {name for name in found if "ratio" in name} == {"rs_blur_ratio", "path_ratio", "path_to_rs_blur_ratio"}


def test_times_are_medians_and_samples_are_counted() -> None:
    found = figures_of(times(still=[[0.1, 0.3]], path=[[0.5]]))
    assert found["still_s"] == pytest.approx(0.2) and found["still_msamples_s"] == pytest.approx(0.2)
    assert found["path_s"] == 0.5 and found["path_ratio"] == pytest.approx(2.5)


def test_modes_take_turns_and_a_broken_one_does_not_stop_the_others() -> None:
    calls: list[str] = []

    def mode(name: str, rounds: int = 1, breaks: bool = False) -> Mode:
        def seconds(k: int, _: float) -> float:
            calls.append(f"{name}{k}")
            if breaks and k == 1:
                raise UserError("gone")
            return 100.0 * k + len(calls)

        return Mode(name, 1, seconds, rounds)

    modes = [mode("a", 4), mode("long"), mode("b", 4), mode("bad", breaks=True)]
    seconds, failed = _measure(modes, np.arange(3.0), lambda *_: None)
    assert calls[:12] == [*["a0", "b0"] * 5, "long0", "bad0"]
    assert calls[12:] == [*["a1", "b1"] * 5, "long1", "bad1", *["a2", "b2"] * 5, "long2"]
    assert failed == {"bad": "gone"}
    assert seconds["a"] == [[115, 117, 119, 121], [227, 229, 231, 233]]  # not the first, which warms up
    assert seconds["long"] == [[123], [235]]


def test_all_modes_are_timed_on_a_tiny_config(tmp_path: Path) -> None:
    config = load_config(tiny.write_config(tmp_path))
    timed, failed = time_modes(config, 1, 4, MODES, lambda *_: None)
    assert list(timed) == list(MODES) and not failed
    assert timed["still"].seconds.shape == (1, 4) and timed["path"].seconds.shape == (1, 1)
    pixels = 1e-6 * tiny.WIDTH * tiny.HEIGHT
    assert timed["path"].msamples == pytest.approx(4 * pixels) and timed["averaged"].msamples == pytest.approx(
        64 * pixels
    )
    # Many launches cannot be quicker than one of the same size.
    found = figures_of(timed)
    assert found["rows_ratio"] > 1 and found["averaged_ratio"] > 1 and found["averaged_to_rs_blur_ratio"] > 0


def test_only_the_modes_asked_for_are_timed_and_none_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load_config(tiny.write_config(tmp_path))
    settings = {"frames": 1, "spp": 1, "modes": ["still"]}
    assert set(render_figures(config, settings, lambda *_: None)) == {"still_s", "still_msamples_s", "peak_mb"}
    monkeypatch.setattr("benchmarks.measures.render_worker._measure", lambda *_: ({}, {"still": "gone"}))
    with pytest.raises(UserError, match="still: gone"):
        render_figures(config, settings, lambda *_: None)


# --- the measures ----------------------------------------------------------------------------------------------------


def measured(
    folder: Path, measure: str, settings: str, method: str = "rsgen", set: str = "light.bounces: 0", frames: int = 6
) -> CellRecord:
    text = f"""
sequences: {{tiny: {{config: {tiny.write_config(folder, frames)}, set: {{{set}}}, frames: "0:2"}}}}
cells: [{{cases: [tiny], methods: [{method}], measure: {measure}, settings: {settings}}}]
"""
    (folder / "bench.yaml").write_text(text)

    def render(_: object) -> None:
        raise AssertionError("the sequence is not needed")

    sources = Sources(cache=folder / "cache", render=render)
    cells = run_cells(load_benchmark([folder / "bench.yaml"]), folder / "out", sources, measures=MEASURES)
    return cells.records[f"{measure}/tiny/{method}"]


@pytest.mark.nightly
def test_light_is_baked_anew_and_compared(tmp_path: Path) -> None:
    record = measured(tmp_path, "light", "{views: 2, spp: 256, width: 24}")
    assert record.error is None and not list(tmp_path.rglob(".rsgen-cache")) and not (tmp_path / "cache").exists()
    found = record.figures
    assert 10 < found["surely_least_db"] < found["psnr_least_db"] <= found["psnr_db"] < 60
    assert found["bake_s"] > 0 and 50 < found["bake_mb"] <= found["peak_mb"] and abs(found["bias_pct"]) < 50
    assert found["estimate_least_db"] <= found["estimate_db"] < 61
    assert (tmp_path / "out/cells/light/tiny/rsgen/light.png").stat().st_size > 1000


@pytest.mark.nightly
def test_frames_are_timed_by_a_process_of_its_own(tmp_path: Path) -> None:
    settings = "{modes: [still, rs-blur], frames: 1, spp: 2}"
    record = measured(tmp_path, "render", settings)
    assert record.error is None and record.figures["rs_blur_ratio"] > 0
    still = record.figures["still_s"]
    # It is finished; of another motion it is not.
    assert measured(tmp_path, "render", settings).figures["still_s"] == pytest.approx(still, rel=1e-5)
    assert measured(tmp_path, "render", settings, frames=7).key != record.key


@pytest.mark.parametrize(
    ("measure", "settings", "how", "part"),
    [
        ("render", "{modes: [fast]}", {}, "settings: modes"),
        ("light", "{views: 0}", {}, "settings: views"),
        ("light", "{width: 49}", {}, "choose 8 to 48"),
        ("light", "{}", {"method": "rs-g"}, "its method is rsgen"),
        ("light", "{}", {"set": "light.mode: path"}, "light.mode"),
        ("render", "{modes: [still]}", {"set": "color.sp: 1"}, "color.sp"),
    ],
)
def test_what_cannot_be_measured(
    measure: str, settings: str, how: dict[str, Any], part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if how.get("method"):
        monkeypatch.setattr(Sources, "folder", lambda *_: tmp_path)
    record = measured(tmp_path, measure, settings, **how)
    assert part in (record.error or "") and not record.skipped


def test_a_process_that_dies_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.measures.renderer.sys.executable", "/bin/false")
    record = measured(tmp_path, "render", "{modes: [still]}")
    assert record.error == "the renderer's process ended: no message"
