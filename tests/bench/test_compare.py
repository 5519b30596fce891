"""Comparing records: chance gives no alarm more often than it may, changes are found, and each rule holds."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nightly import sampled
from scipy import stats

from benchmarks.compare import compare
from benchmarks.comparison import SIGNIFICANCE
from benchmarks.inference import RunSpread, fisher_p, fit_prior, poisson_p, signed_rank_p, stouffer_p, tolerances
from rstrack.bench.figures import FIGURES, figure_of, heading
from rstrack.bench.record import CellRecord, read_records, write_records


def record(
    case: str, *runs: Mapping[str, Any], method: str = "rs-pg", measure: str = "track", **fields: Any
) -> CellRecord:
    settings = {"case": {"sequence": case}, "method": {}, "settings": {}, "group": ""}
    base = CellRecord(
        f"{measure}/{case}/{method}", "key", settings, tuple(range(len(runs))), tuple(dict(run) for run in runs),
        complete=True, machine={"cpu": "A", "load": 0.1},
    )  # fmt: skip
    return dataclasses.replace(base, **fields)


def by_cell(*records: CellRecord) -> dict[str, CellRecord]:
    return {r.cell: r for r in records}


def drawn(rng: np.random.Generator, sigmas: np.ndarray, shift: dict[int, float] | None = None) -> dict[str, CellRecord]:
    """Cells of three runs: errors that scatter by each cell's sigma in logarithms, some shifted by a factor."""
    out = []
    for k, sigma in enumerate(sigmas):
        values = np.exp(k % 5 + sigma * rng.normal(size=3)) * (shift or {}).get(k, 1.0)
        out.append(record(f"case{k}", *({"ate_mm": float(v)} for v in values)))
    return by_cell(*out)


# -- chance -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kept", "unlike"), sampled(itertools.product([False, True], [4.0, math.inf]), 4))
def test_chance_alone_gives_no_more_alarms_than_it_may(kept: bool, unlike: float) -> None:
    rng = np.random.default_rng(1)
    times, alarms = 200, 0
    for _ in range(times):
        scale = np.ones(40) if math.isinf(unlike) else unlike / rng.chisquare(unlike, 40)
        sigmas = 0.05 * np.sqrt(scale)
        old = drawn(rng, sigmas)
        alarms += bool(compare(tolerances(old) if kept else old, drawn(rng, sigmas)).worse)
    assert alarms <= stats.binom.ppf(0.999, times, SIGNIFICANCE)


def test_a_fifth_more_is_found_where_chance_is_a_twentieth() -> None:
    rng = np.random.default_rng(2)
    sigmas = np.full(40, 0.05)
    found = others = 0
    for _ in range(100):
        worse = compare(tolerances(drawn(rng, sigmas)), drawn(rng, sigmas, {3: 1.2})).worse
        found += any(change.cell == "track/case3/rs-pg" for change in worse)
        others += any(change.cell not in ("track/case3/rs-pg", "track/*/rs-pg") for change in worse)
    assert found >= 70
    assert others <= stats.binom.ppf(0.999, 100, SIGNIFICANCE)


def test_a_little_more_everywhere_is_found_in_the_mean() -> None:
    rng = np.random.default_rng(6)
    sigmas = 0.05 * np.sqrt(4.0 / rng.chisquare(4.0, 20))
    found = 0
    for _ in range(30):
        worse = compare(drawn(rng, sigmas), drawn(rng, sigmas, dict.fromkeys(range(20), 1.06))).worse
        found += any(change.cell == "track/*/rs-pg" for change in worse)
    assert found >= 27


def test_the_usual_variance_is_found_again() -> None:
    rng = np.random.default_rng(3)
    d0, s0 = 8.0, 0.03
    variances = s0**2 * d0 / rng.chisquare(d0, 4000)
    prior = fit_prior([RunSpread(float(v * rng.chisquare(4)), 4.0) for v in variances])
    assert prior is not None
    assert prior.variance == pytest.approx(s0**2, rel=0.05)
    assert prior.dof == pytest.approx(d0, rel=0.2)


def test_exact_tests_are_those_of_scipy_and_of_counting() -> None:
    d = [0.5, -1.25, 2.0, 3.5, 4.0, 5.5, -6.0, 7.0]
    assert signed_rank_p(d) == pytest.approx(stats.wilcoxon(d, alternative="greater", method="exact").pvalue)
    tied = [1.0, 1.0, -1.0, 2.0, 2.0, 0.0, 5.0]
    ranks = stats.rankdata(np.abs([x for x in tied if x]))
    seen = ranks @ np.array([x > 0 for x in tied if x])
    sums = [ranks @ np.array(signs) for signs in itertools.product((0, 1), repeat=len(ranks))]
    assert signed_rank_p(tied) == pytest.approx(np.mean(np.array(sums) >= seen))
    assert signed_rank_p([0.0, 0.0]) == 1.0
    table = np.array([[9, 91], [2, 98]])
    assert fisher_p(2, 100, 9, 100) == pytest.approx(stats.fisher_exact(table, alternative="greater")[1])
    assert stouffer_p([0.2, 0.01, 0.7]) == pytest.approx(stats.combine_pvalues([0.2, 0.01, 0.7], "stouffer").pvalue)
    assert 0.0 < stouffer_p([0.0, 0.5]) < 1e-6
    assert poisson_p(0, 3, 5, 3) == pytest.approx(0.5**5)


# -- rules ------------------------------------------------------------------------------------------------------------

NOISE = (0.97, 1.0, 1.03)


def cells(name: str, values: list[float], **more: Any) -> dict[str, CellRecord]:
    """One cell with these values, among twenty that scatter by three per cent."""
    fill = [record(f"other{k}", *({name: (1 + k) * f} for f in NOISE)) for k in range(20)]
    return by_cell(record("it", *({name: v} | more for v in values)), *fill)


def test_the_same_records_are_the_same() -> None:
    records = cells("ate_mm", [1.0, 1.05, 1.1], silent=0.0, lost=2.0, median_ms=40.0)
    found = compare(records, records)
    assert not found.worse and not found.better and not found.unknown and found.tests == 0
    assert found.same == found.compared == 21
    assert "nothing got worse" in found.text()


def test_digits_that_files_do_not_keep_are_no_change(tmp_path: Path) -> None:
    records = cells("ate_mm", [1.23456789, 1.05, 1.1])
    write_records(tmp_path / "gate.json", tolerances(records).values())
    assert compare(read_records(tmp_path / "gate.json"), records).tests == 0


@pytest.mark.parametrize(
    ("name", "old", "new", "verdict"),
    [
        ("ate_mm", [1.0, 1.02, 0.98], [1.4, 1.42, 1.38], "worse"),
        ("ate_mm", [1.0, 1.02, 0.98], [0.6, 0.62, 0.58], "better"),
        ("ate_mm", [1.0, 1.02, 0.98], [1.01, 1.03, 0.98], ""),
        ("ate_mm", [1.0], [1.5], "worse"),  # one run: the others' scatter
        ("ratio", [0.5, 0.51, 0.49], [0.9, 0.91, 0.89], "worse"),
        ("median_ms", [10.0, 10.1, 9.9], [90.0, 90.1, 89.9], ""),  # milliseconds are not judged
        ("nees", [1.2, 1.21, 1.19], [1 / 1.2, 1 / 1.21, 1 / 1.19], ""),  # as far from 1 as before
        ("nees", [1.0, 1.01, 0.99], [0.4, 0.41, 0.39], "worse"),
        ("nees", [2.0, 2.01, 1.99], [1.0, 1.01, 0.99], "better"),
        ("unheard_of", [1.0, 1.0, 1.0], [9.0, 9.0, 9.0], ""),
    ],
)
def test_means_are_judged_by_scatter(name: str, old: list[float], new: list[float], verdict: str) -> None:
    found = compare(tolerances(cells(name, old)), cells(name, new))
    assert ["track/it/rs-pg"] * (verdict == "worse") == [change.cell for change in found.worse]
    assert ["track/it/rs-pg"] * (verdict == "better") == [change.cell for change in found.better]


@pytest.mark.parametrize(
    ("name", "old", "new", "is_worse"),
    [
        ("coverage_90", [0.91, 0.90, 0.89], [0.6, 0.61, 0.62], True),
        ("coverage_90", [0.86, 0.87, 0.85], [0.94, 0.93, 0.95], False),
        ("psnr_db", [42.0, 42.1, 41.9], [38.0, 38.1, 37.9], True),
        ("psnr_db", [42.0, 42.1, 41.9], [46.0, 46.1, 45.9], False),
        ("bias_pct", [-0.2, -0.25, -0.15], [-2.0, -2.1, -1.9], True),
        ("bias_pct", [-0.2, -0.25, -0.15], [0.2, 0.25, 0.15], False),
    ],
)
def test_linear_scales(name: str, old: list[float], new: list[float], is_worse: bool) -> None:
    def with_others(values: list[float]) -> dict[str, CellRecord]:
        fill = [record(f"other{k}", *({name: 0.9 + d} for d in (-0.05, 0.0, 0.05))) for k in range(9)]
        return by_cell(record("it", *({name: v} for v in values)), *fill)

    assert bool(compare(with_others(old), with_others(new)).worse) == is_worse


def test_one_more_silently_wrong_frame_is_worse() -> None:
    found = compare(cells("ate_mm", [1.0, 1.0, 1.0], silent=0.0), cells("ate_mm", [1.0, 1.0, 1.0], silent=1.0))
    assert [(c.figure, c.old, c.new) for c in found.worse] == [("silent", 0.0, 3.0)]
    assert not compare(cells("ate_mm", [1.0], silent=4.0), cells("ate_mm", [1.0], silent=2.0)).worse


def test_lost_frames_are_shares_of_frames() -> None:
    def lost(count: float) -> dict[str, CellRecord]:
        return by_cell(record("it", *({"lost": count, "frames": 200.0} for _ in range(3))))

    assert not compare(lost(0), lost(1)).worse
    assert compare(lost(0), lost(4)).worse[0].figure == "lost"
    assert compare(lost(4), lost(0)).better
    without = [by_cell(record("it", {"lost": count})) for count in (0.0, 9.0)]
    assert compare(*without).worse


def test_faults_are_compared_one_by_one() -> None:
    rng = np.random.default_rng(4)
    base = rng.integers(0, 60, 90).astype(float)

    def faults(lost: np.ndarray, found: np.ndarray) -> dict[str, CellRecord]:
        runs = [{"lost": float(a), "found_in_5": float(b), "frames": 90.0} for a, b in zip(lost, found, strict=True)]
        return by_cell(record("it", *runs, measure="faults"))

    all_found = np.ones(90)
    some = faults(base, all_found)
    one_bad = base + 300 * (np.arange(90) == 3)
    assert not compare(some, faults(one_bad, all_found)).worse  # one fault says nothing of the others
    assert [c.figure for c in compare(some, faults(base + 2, all_found)).worse] == ["lost"]
    fewer = all_found - (np.arange(90) < 12)
    assert [c.figure for c in compare(some, faults(base, fewer)).worse] == ["found_in_5"]


def test_a_cell_that_fails_or_loses_its_figures_is_worse() -> None:
    old = cells("ate_mm", [1.0, 1.02, 1.04])
    it = old["track/it/rs-pg"]
    failed = old | by_cell(dataclasses.replace(it, runs=(), seeds=(), complete=False, error="no start"))
    assert "no start" in compare(old, failed).worse[0].text()
    skipped = old | by_cell(dataclasses.replace(it, runs=(), seeds=(), complete=False, error="absent", skipped=True))
    found = compare(old, skipped)
    assert not found.worse and found.cells == {"skipped": ("track/it/rs-pg",)}
    lost = old | by_cell(record("it", {"ate_mm": 1.0}, {"ate_mm": 1.02}, {"ate_mm": None}))
    assert compare(old, lost).worse[0].why == "missing in 1 of its runs"
    gone = old | by_cell(record("it", {"ate_mm": None}, {"ate_mm": None}, {"ate_mm": None}))
    assert compare(lost, gone).worse[0].why == "missing in 3 of its runs"
    assert not compare(failed, failed).worse


def test_what_cannot_be_compared_is_named() -> None:
    old = cells("ate_mm", [1.0, 1.02, 1.04])
    it = old.pop("track/it/rs-pg")
    assert compare(by_cell(it), {}).cells == {"not run": (it.cell,)}
    assert compare({}, by_cell(it)).cells == {"new": (it.cell,)}
    for other in (
        dataclasses.replace(it, settings=it.settings | {"group": "else"}),
        dataclasses.replace(it, seeds=(7, 8, 9)),
    ):
        found = compare(by_cell(it), by_cell(other))
        assert not found.worse and list(found.cells) == ["defined otherwise now, not compared"]
    assert list(compare(by_cell(it), by_cell(dataclasses.replace(it, complete=False))).cells) == ["not finished"]


def test_seeds_that_both_have_are_compared() -> None:
    one = record("it", {"silent": 1.0}, {"silent": 1.0})
    assert not compare(by_cell(one), by_cell(record("it", *[{"silent": 1.0}] * 5))).worse


def test_other_peoples_trackers_are_not_judged() -> None:
    old, new = (by_cell(record("it", {"silent": v}, method="open3d-icp")) for v in (0.0, 9.0))
    assert not compare(old, new).worse


def test_the_files_scatter_serves_where_few_cells_are_left() -> None:
    old, new = (cells("ate_mm", [f]) for f in (1.0, 1.5))
    kept, it = tolerances(old), "track/it/rs-pg"
    assert compare({it: old[it]}, {it: new[it]}).unknown
    assert compare({it: kept[it]}, {it: new[it]}).worse


def test_without_any_scatter_a_change_is_shown_and_not_judged() -> None:
    found = compare(by_cell(record("it", {"ate_mm": 1.0})), by_cell(record("it", {"ate_mm": 9.0})))
    assert not found.worse and found.unknown[0].figure == "ate_mm"
    assert "not judged" in found.text()


def test_text_has_worse_first_and_times_beside() -> None:
    old, new = (cells("ate_mm", [f * v for v in NOISE], silent=f - 1, median_ms=40 * f) for f in (1.0, 2.0))
    text = compare(old, new).text()
    assert text.startswith("WORSE: 2")
    assert "+100.0 %" in text and "median_ms: x 2.00 over 1 cells" in text and "2 figures got worse" in text


def test_every_figure_has_one_entry_and_a_heading() -> None:
    assert len({figure.pattern for figure in FIGURES}) == len(FIGURES)
    assert heading("ate_mm") == "ATE, mm" and heading("bake_s") == "bake, s" and heading("kind") == "kind"
    assert heading("converged_pct_1x") == "converged 1x, %"
    assert figure_of("ratio").is_judged
    assert not figure_of("lost_ms").is_judged and not figure_of("ratio_p99").is_judged


def test_more_silently_wrong_frames_are_counts_where_there_were_some() -> None:
    old, new, many = (cells("ate_mm", [1.0], silent=v, frames=100.0) for v in (4.0, 5.0, 60.0))
    assert not compare(old, new).worse
    assert [change.figure for change in compare(old, many).worse] == ["silent"]
