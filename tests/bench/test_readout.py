"""The readout sweep: its cases, what is rendered and kept, noise by seeds, intervals, tables and the picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from rstrack.bench.methods.plan import Job, keyed
from rstrack.bench.readout.cases import Case, case_overrides, cases_of, render_cases, render_words
from rstrack.bench.readout.plot import draw_sweep, sweep_charts
from rstrack.bench.readout.run import SweepResult
from scipy import stats

from rsgen.config.config import load_config
from rsgen.errors import UserError
from rstrack.bench.methods.results import Cell
from rstrack.bench.readout import cases as cases_module
from rstrack.bench.readout.config import SweepConfig, is_sweep, load_sweep_config, narrow
from rstrack.bench.readout.results import Point, growth, log_interval, points_of, sweep_tables, write_sweep
from rstrack.cli.main import main
from rstrack.options import Options
from rstrack.tracking.runs.record import Noise

ROOT = Path(__file__).parents[2]
SWEEP = ROOT / "configs/readout_sweep.yaml"


def test_the_sweep_that_ships_is_the_one_asked_for() -> None:
    assert is_sweep(SWEEP) and not is_sweep(ROOT / "configs/evaluation.yaml")
    config = load_sweep_config(SWEEP)
    assert config.readouts_s == (0.0, 0.007, 0.014, 0.021, 0.028) and config.exposures_s == (0.0, 0.01)
    assert len(config.motions) == 3 and config.noise.seeds == 3 and len(cases_of(config)) == 30
    assert len({case.name for case in cases_of(config)}) == 30


@pytest.mark.parametrize("motion", ["demo", "table1"])
def test_rsgen_reads_what_it_is_told_of_a_case(motion: str) -> None:
    config = narrow(load_sweep_config(SWEEP), motions=[motion], width=160, frames=20)
    case = Case(motion, 0.014, 0.010, 160)
    words = render_words(config, case, Path("x"))
    assert words[words.index("--frames") + 1] == "0:20"
    fields = {name[2:]: value for name, value in pairwise(words) if name.startswith("--")}
    given = {name: value for name, value in fields.items() if "." in name}
    small, whole = load_config(config.motions[0].config, given), load_config(config.motions[0].config)
    for stream in ("color", "depth"):
        a, b = getattr(small, stream), getattr(whole, stream)
        assert (a.width, a.height, a.readout_s, a.exposure_s) == (160, 120, 0.014, 0.010)
        assert a.noise.model == "none" and a.offset_s - 0.005 == pytest.approx(b.offset_s, abs=1e-12)
        # The same view: the images' corners are seen in the same directions.
        ends = [np.array([[-0.5, -0.5], [c.width - 0.5, c.height - 0.5]]) for c in (a.camera, b.camera)]
        rays = [c.unproject(end) for c, end in zip((a.camera, b.camera), ends, strict=True)]
        np.testing.assert_allclose(*rays, atol=1e-6)


def test_a_config_without_a_size_cannot_be_scaled() -> None:
    with pytest.raises(UserError, match=r"mine\.yaml: color: width"):
        case_overrides(Path("mine.yaml"), {"color": {}}, Case("mine", 0.0, 0.0, 160))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"readouts_s": [0.0, 0.0]}, "readouts_s: '0.0' is there twice"),
        ({"methods": ["rs-x"]}, "no method 'rs-x'"),
        ({"overrides": {"color.readout_s": 0.1}}, "color.readout_s"),
        ({"motions": []}, "motions"),
        ({"speed": 2}, "speed"),
        ({"readouts_s": [-1.0]}, "readouts_s"),
    ],
)
def test_a_wrong_sweep_is_refused_in_one_line(
    change: dict[str, object], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(SWEEP.read_text()) | change))
    assert main(["bench", str(path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert told in said and len(said.splitlines()) == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--quick"], "--quick: is not for a readout sweep"), (["--frames", "5:20"], "begins with frame 0"),
        (["--sequence", "nowhere"], "no such motion"), (["--method", "rs-x"], "no method 'rs-x'"),
        (["--seeds", "0"], "--seeds"),
    ],
)  # fmt: skip
def test_options_that_a_sweep_has_not_are_refused(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", str(SWEEP), *words]) == 2
    said = capsys.readouterr().err
    assert told in said and len(said.splitlines()) == 1


def test_options_of_a_sweep_are_for_sweeps(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", str(ROOT / "configs/evaluation.yaml"), "--width", "320"]) == 2
    assert "is no sweep" in capsys.readouterr().err


def test_only_what_is_missing_or_changed_is_rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = narrow(load_sweep_config(SWEEP), motions=["demo"], readouts_s=(0.0, 0.028), exposures_s=(0.0,), frames=20)
    called: list[Sequence[str]] = []
    said: list[str] = []
    monkeypatch.setattr(cases_module, "_is_whole", lambda folder, frames: folder.is_dir())

    def render(words: Sequence[str]) -> None:
        called.append(words)
        Path(words[words.index("--out") + 1]).mkdir(parents=True, exist_ok=True)

    def run(sweep: SweepConfig) -> int:
        before = len(called)
        render_cases(sweep, tmp_path, render, lambda *what: None, said.append, "local:2")
        return len(called) - before

    assert run(config) == 2 and called[0][-2:] == ["--scheduler", "local:2"] and "2 sequences of 20 frames" in said[0]
    assert run(config) == 0 and len(said) == 1
    assert run(narrow(config, frames=30)) == 2
    assert run(narrow(config, frames=30, readouts_s=(0.028, 0.014))) == 1
    next(iter((tmp_path / "sequences").glob("*28ms*.json"))).unlink()
    assert run(narrow(config, frames=30)) == 1


def test_noise_is_part_of_a_cells_key_and_none_leaves_it_as_it_was() -> None:
    job = Job("a", "rs-pg", Path("a"), 0, 9, Options(), None, Path("o"), "")
    keys = [keyed(replace(job, noise=noise), "d").key for noise in (None, Noise(1e-3, 0.0, 0), Noise(1e-3, 0.0, 1))]
    assert len(set(keys)) == 3 and keyed(job, "d").key == keys[0]


def test_intervals_are_students_in_logarithms() -> None:
    values = [1.1, 0.7, 2.3, 1.9]
    expected = stats.ttest_1samp(np.log(values), 0.0).confidence_interval(0.95)
    mean, low, high = log_interval(values)
    assert mean == pytest.approx(stats.gmean(values))
    assert np.log([low, high]) == pytest.approx(list(expected))
    assert log_interval([2.0]) == (pytest.approx(2.0), None, None) and log_interval([]) == (None, None, None)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    draws = np.exp(rng.normal(0.3, 0.2, (4000, 3)))
    held = [low <= np.exp(0.3) <= high for _, low, high in map(log_interval, draws) if low and high]
    assert abs(np.mean(held) - 0.95) < 0.012


def result() -> SweepResult:
    """Two readouts and two methods, three seeds; gs-pg loses one of them, and all at the second readout of 'b'."""
    config = narrow(load_sweep_config(SWEEP), readouts_s=(0.028, 0.0), exposures_s=(0.0,), motions=["demo", "table1"])
    ate = {("rs-pg", 0.0): 1.0, ("rs-pg", 0.028): 1.2, ("gs-pg", 0.0): 1.0, ("gs-pg", 0.028): 8.0}
    cells = {}
    for case in cases_of(config):
        for method in ("gs-pg", "rs-pg"):
            found = []
            for seed in range(3):
                is_lost = method == "gs-pg" and (seed == 2 or (case.motion, case.readout_s) == ("table1", 0.028))
                metrics = {"ate_rmse_m": 1e-3 * ate[method, case.readout_s] * 1.1 ** (seed - 1)}
                lost = 60 if is_lost else 0
                found.append(Cell("", f"{case.name}_seed_{seed}", method, None if is_lost else metrics, 60, lost, 1.0))
            cells[case, method] = tuple(found)
    frames = dict.fromkeys(cases_of(config), 60)
    return SweepResult(config, ("gs-pg", "rs-pg"), ("orb-slam3",), cells, frames, {}, "1")


def test_tables_say_means_growth_and_what_was_lost(tmp_path: Path) -> None:
    found = result()
    demo, table1 = sweep_tables(found)
    assert demo.head == ("method", "0 ms", "28 ms", "most / least")
    ours = [str(entry) for entry in demo.rows[1]]
    assert ours[0] == "rs-pg" and ours[1].startswith("1.00 [0.79, 1.3]") and ours[3] == "1.20"
    theirs = [str(entry) for entry in demo.rows[0]]
    assert theirs[1].endswith("†") and theirs[3] == "8.00"
    assert [str(entry) for entry in table1.rows[0]][2:] == ["lost", "-"]
    text = write_sweep(found, tmp_path)
    assert "left out, not installed: orb-slam3" in text
    assert "gs-pg on table1_320px_readout_28ms_exposure_0ms 3 of 3" in text
    data = json.loads((tmp_path / "results.json").read_text())
    assert len(data["points"]) == 8 and len(data["cells"]) == 24
    assert {p["ate_m"] for p in data["points"] if p["lost"] == 3} == {None}
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 9


def test_growth_is_unknown_where_a_track_is_lost() -> None:
    points = [p for p in points_of(result()) if p.method == "gs-pg" and p.case.motion == "table1"]
    assert growth(points) is None and growth(points[:1]) is None


def test_growth_is_the_largest_over_the_smallest_wherever_they_are() -> None:
    case = Case("a", 0.0, 0.0)
    assert growth([Point(case, "m", (value,), 0) for value in (2.0, 6.0, 1.5, 3.0)]) == pytest.approx(4.0)


def test_the_picture_has_a_line_with_its_interval_for_each_method(tmp_path: Path) -> None:
    first = sweep_charts(result())[0]
    assert [line.name for line in first.lines] == ["gs-pg", "rs-pg"] and first.is_log
    ours = first.lines[1]
    np.testing.assert_allclose(ours.x, [0.0, 28.0])
    np.testing.assert_allclose(ours.y, [1.0, 1.2], rtol=1e-6)
    assert ours.low is not None and ours.high is not None and (ours.low < ours.y).all() and (ours.y < ours.high).all()
    draw_sweep(result(), tmp_path / "readout.png")
    assert (tmp_path / "readout.png").stat().st_size > 5000
