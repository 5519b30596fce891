"""The readout sweep: its cases, what is rendered and kept, noise by seeds, intervals, tables and the picture."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import yaml
from scipy import stats

import rstrack.bench.measures.track
from rsgen.config.config import load_config
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rstrack.bench.experiments.readout import (
    ReadoutExperiment,
    Sweep,
    SweepConfig,
    errors,
    growth,
    installed,
    load_sweep,
    log_interval,
    narrow,
    sweep_benchmark,
    sweep_charts,
    sweep_tables,
    write_sweep,
)
from rstrack.bench.record import CellRecord, read_records
from rstrack.bench.runner import Outcome, run_cells
from rstrack.bench.task import Sources
from rstrack.cli.main import main
from rstrack.options import Options

ROOT = Path(__file__).parents[2]
SWEEP = ROOT / "configs/readout_sweep.yaml"


def test_the_sweep_that_ships_is_the_one_asked_for() -> None:
    config = load_sweep(SWEEP)
    assert config.readouts_s == (0.0, 0.007, 0.014, 0.021, 0.028) and config.exposures_s == (0.0, 0.01)
    cells = sweep_benchmark(config, config.methods).cells
    assert len(config.motions) == 3 and len({cell.name for cell in cells}) == len(cells) == 30 * 10
    assert len({cell.case for cell in cells}) == 30 and all(cell.seeds == (0, 1, 2) for cell in cells)


@pytest.mark.parametrize("motion", ["demo", "table1"])
def test_rsgen_reads_what_it_is_told_of_a_case(motion: str) -> None:
    config = narrow(load_sweep(SWEEP), motions=[motion], width=160, frames=20)
    config = narrow(config, readouts_s=(0.014,), exposures_s=(0.010,))
    (cell,) = sweep_benchmark(config, ["rs-pg"], Options(fuse=False)).cells
    assert (cell.name, cell.options.fuse) == (f"track/{motion}_160px_readout_14ms_exposure_10ms/rs-pg-no-fuse", False)
    words = Sources().words(cell.sequence)
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
        (["--seeds", "0"], "seeds"),
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


def test_noise_is_of_the_seed_and_more_seeds_are_added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rendered once, by a stand-in; tracked once for each seed, with that seed's noise."""
    config = narrow(load_sweep(SWEEP), motions=["demo"], readouts_s=(0.02,), exposures_s=(0.0,), seeds=2, frames=12)
    made: list[Sequence[str]] = []
    seeds: list[int] = []

    def render(words: Sequence[str]) -> None:
        made.append(words)
        synthetic.make_sequence(Path(words[words.index("--out") + 1]), synthetic.make_config(), 12)

    def track(task: Any, progress: Any) -> dict[str, float]:
        noise = task.noise
        seeds.append(noise.seed)
        assert (noise.sigma_depth, noise.sigma_intensity) == (1.2e-3, 0.01) and len(task.dataset) == 12
        return {"frames": 12, "lost": 0, "ate_mm": 1.0 + noise.seed}

    monkeypatch.setattr(rstrack.bench.measures.track, "track_cell", track)

    def run(sweep: SweepConfig) -> Sweep:
        sources = Sources(cache=tmp_path / "cache", render=render)
        found = run_cells(sweep_benchmark(sweep, ["gs-pg", "rs-pg"]), tmp_path / "out", sources)
        return Sweep(sweep, tuple(found.records.values()))

    first = run(config)
    assert len(made) == 1 and "--frames" in made[0] and seeds == [0, 1, 0, 1]
    run(narrow(config, seeds=3))
    assert len(made) == 1 and seeds[4:] == [2, 2]
    record, _ = run(config).records
    assert errors(record) == errors(first.records[0]) == [1.0, 2.0] and len(seeds) == 6


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def render(words: Sequence[str]) -> None:
        assert json.loads(words[words.index("--color.width") + 1]) == 64
        synthetic.make_sequence(Path(words[words.index("--out") + 1]), synthetic.make_config(), 12)

    def track(task: Any, progress: Any) -> dict[str, float]:
        if task.cell.method == "gs-pg" and task.seed == 1:
            return {"frames": 12, "lost": 12}
        return {"frames": 12, "lost": 0, "ate_mm": 2.0, "drift_mm_s": 3.0, "drift_deg_s": 4.0}

    monkeypatch.setattr("rstrack.bench.task.run_rsgen", render)
    monkeypatch.setattr(rstrack.bench.measures.track, "track_cell", track)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = ["bench", str(SWEEP), "--sequence", "demo", "--width", "64", "--readout", "0", "0.01", "--exposure", "0"]
    words += ["--seeds", "2", "--frames", "0:12", "--out", str(tmp_path / "out")]
    assert main([*words, "--method", "rs-pg"]) == 0
    said = capsys.readouterr()
    assert "2 of 2 sequences are to be rendered first" in said.err and "2.00 [2.0, 2.0]" in said.out
    assert main([*words, "--method", "rs-pg", "gs-pg", "--quiet"]) == 1
    said = capsys.readouterr()
    assert said.err == "" and "gs-pg on demo_64px_readout_10ms_exposure_0ms 1 of 2" in said.out
    for name in ("records.json", "results.csv", "results.md", "results.txt", "plots/readout.png"):
        assert (tmp_path / "out" / name).stat().st_size > 100


def test_what_is_not_installed_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rstrack.bench.experiments.readout.find_spec", lambda name: None)
    assert installed(["rs-pg", "kiss-icp"]) == (("rs-pg",), ("kiss-icp",))
    with pytest.raises(UserError, match="none of kiss-icp, open3d-icp is installed"):
        installed(["kiss-icp", "open3d-icp"])


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


def result() -> Sweep:
    """Two readouts and two methods, three seeds; gs-pg loses one of them, and all at the second readout of 'b'."""
    config = narrow(load_sweep(SWEEP), readouts_s=(0.028, 0.0), exposures_s=(0.0,), motions=["demo", "table1"])
    ate = {("rs-pg", 0.0): 1.0, ("rs-pg", 0.028): 1.2, ("gs-pg", 0.0): 1.0, ("gs-pg", 0.028): 8.0}
    records = []
    for cell in sweep_benchmark(config, ["gs-pg", "rs-pg"]).cells:
        readout = cell.sequence.set["depth.readout_s"]
        runs: list[dict[str, float | None]] = []
        for seed in range(3):
            is_lost = cell.method == "gs-pg" and (seed == 2 or (cell.group, readout) == ("table1", 0.028))
            found = {"ate_mm": ate[cell.method, readout] * 1.1 ** (seed - 1), "lost": 0}
            runs.append({"frames": 60, "lost": 60} if is_lost else {"frames": 60, **found})
        records.append(CellRecord(cell.name, "", cell.as_dict(), (0, 1, 2), tuple(runs), True))
    return Sweep(config, tuple(records), ("orb-slam3",))


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
    records = read_records(tmp_path / "records.json")
    assert all(errors(records[r.cell]) == pytest.approx(errors(r), rel=1e-5) for r in found.records)
    rows = list(csv.DictReader((tmp_path / "results.csv").open()))
    assert len(rows) == 8 and {row["ate_mm"] for row in rows if row["lost"] == "3"} == {""}


def test_growth_is_the_largest_over_the_smallest_wherever_they_are() -> None:
    assert growth([2.0, 6.0, 1.5, 3.0]) == pytest.approx(4.0)
    assert growth([1.0, None]) is None and growth([1.0]) is None  # lost at one, or but one


def test_the_picture_has_a_line_with_its_interval_for_each_method(tmp_path: Path) -> None:
    first = sweep_charts(result())[0]
    assert [line.name for line in first.lines] == ["gs-pg", "rs-pg"] and first.is_log
    ours = first.lines[1]
    np.testing.assert_allclose(ours.x, [0.0, 28.0])
    np.testing.assert_allclose(ours.y, [1.0, 1.2], rtol=1e-6)
    assert ours.low is not None and ours.high is not None and (ours.low < ours.y).all() and (ours.y < ours.high).all()
    sweep = result()
    outcome = Outcome({record.cell: record for record in sweep.records})
    ReadoutExperiment(sweep.config, Options()).draw(outcome, tmp_path, no_progress, pytest.fail)
    assert (tmp_path / "plots/readout.png").stat().st_size > 5000
