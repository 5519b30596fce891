"""The page of a blur stress test: its numbers are those of the results file, its pictures the panels."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from report_util import NASTY, Parsed, make_stress, parse, picture

from rsgen.errors import UserError
from rstrack.bench.experiments.stress import StressResult, read_stress
from rstrack.report.build import write_report

PANELS = Path("cells/blur/exposure_20ms/rs-pg-mid-exposure/panels")
LABELS = {
    "exposure_0ms": "0 ms", "exposure_20ms": "20 ms", "exposure_30ms": "30 ms",
    "exposure_20ms_speed_2x": "20 ms, 2× speed",
}  # fmt: skip

SCORES = (("psnr_db", 2), ("psnr_db_least", 2), ("ssim", 4), ("gradient", 3))
Stored = dict[str, dict[str, dict[str, float]]]


def scores(stored: Stored, case: str, name: str, poses: str) -> list[float | None]:
    """By weights, the constant ones first."""
    figures = stored[case]["mid-exposure"]
    return [figures.get(f"{name}_{poses}_{weights}") for weights in ("constant", "sigma0.5", "sigma1")]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StressResult]:
    root = tmp_path_factory.mktemp("stress") / "made"
    root.mkdir()
    return root, make_stress(root)


@pytest.fixture(scope="module")
def stored(made: tuple[Path, StressResult]) -> Stored:
    """Figures in the file by sequence and photometric term."""
    found: Stored = {case: {} for case in LABELS}
    for cell in read_stress(made[0]).cells:
        found[cell.case][cell.variant] = cell.figures
    return found


@pytest.fixture(scope="module")
def page(made: tuple[Path, StressResult]) -> Parsed:
    return parse(write_report(made[0]))


@pytest.fixture
def copy(made: tuple[Path, StressResult], tmp_path: Path) -> Path:
    """The folder, for a test to damage."""
    return Path(shutil.copytree(made[0], tmp_path / "copy"))


def tables(page: Parsed) -> list[list[list[str]]]:
    """All tables in their order: heads and rows."""
    starts = [k for k, row in enumerate(page.rows) if row[0] == "sequence"]
    return [page.rows[a:b] for a, b in zip(starts, [*starts[1:], None], strict=True)]


def test_the_colour_tables_numbers_are_those_of_the_file(page: Parsed, stored: Stored) -> None:
    found = tables(page)
    assert len(found) == 4 + 4 + 2 + 1
    for n, poses in enumerate(("true", "estimated")):
        for k, (name, digits) in enumerate(SCORES):
            head, *rows = found[4 * n + k]
            assert head == ["sequence", "constant", "σ 0.5 px", "σ 1 px"]
            assert len(rows) == len(LABELS)
            for row, (case, label) in zip(rows, LABELS.items(), strict=True):
                values = scores(stored, case, name, poses)
                texts = ["-" if value is None else f"{value:.{digits}f}" for value in values]
                if name == "psnr_db":
                    label += " 4 keyframes"
                    gains = [f"{v - (values[0] or 0.0):+.2f}" for v in values[1:] if v is not None]
                    texts[1:] = [f"{text} {gain}" for text, gain in zip(texts[1:], gains, strict=True)]
                assert row == [label, *texts]
    assert found[6][1][1:] == ["-"] * 3, "no score, no number"


def test_the_depth_and_tracking_tables_numbers_are_those_of_the_file(page: Parsed, stored: Stored) -> None:
    *_, true, estimated, tracking = tables(page)
    for table, poses in ((true, "true"), (estimated, "estimated")):
        for row, (case, label) in zip(table[1:], LABELS.items(), strict=True):
            single, fused = (stored[case]["mid-exposure"][f"{what}_mm_{poses}"] for what in ("single", "fused"))
            assert row == [label, f"{single:.2f}", f"{fused:.2f}", f"{fused / single:.2f}"]
    assert tracking[0] == ["sequence", "mid-exposure", "end of exposure", "blur weight"]
    for row, (case, label) in zip(tracking[1:], LABELS.items(), strict=True):
        assert row[0] == label
        for text, variant in zip(row[1:], tracking[0][1:], strict=True):
            figures = stored[case].get(variant)
            if figures is None:
                assert text == "-"
                continue
            ate = f"{figures['ate_mm']:.2f}" if "ate_mm" in figures else "-"
            drift = f" {figures['drift_mm_s']:.2f} mm/s" if "drift_mm_s" in figures else ""
            assert text == f"{ate}{drift}" + (f" {figures['lost']:.0f} lost" if figures["lost"] else "")


def test_the_best_of_a_row_is_marked(made: tuple[Path, StressResult], stored: Stored) -> None:
    html = write_report(made[0]).read_text("utf-8")
    marked = re.findall(r'<td class="best">\s*([-+.\d]+)', html)
    expected = []
    for poses in ("true", "estimated"):
        for name, digits in SCORES:
            for case in LABELS:
                values = [value for value in scores(stored, case, name, poses) if value is not None]
                expected += [f"{max(values):.{digits}f}"] if values else []
    for case in LABELS:
        ate = [figures["ate_mm"] for figures in stored[case].values() if "ate_mm" in figures]
        expected.append(f"{min(ate):.2f}")
    assert marked == expected and len(marked) == 4 * 8 - 1 + 4


def test_the_headline_is_of_the_longest_exposure(page: Parsed, stored: Stored) -> None:
    figures = stored["exposure_30ms"]["mid-exposure"]
    constant, aware = (figures[f"psnr_db_true_{weights}"] for weights in ("constant", "sigma1"))
    top = page.text[: page.text.index("Green")]
    for text in (
        "30 ms exposure, true path", f"{aware - constant:+.2f} dB", f"{constant:.2f} dB with constant weights",
        f"{figures['fused_mm_true']:.2f} mm", f"{figures['single_mm_true']:.2f} mm in one frame",
        f"{figures['ate_mm']:.2f} mm",
        "0, 20, 30 ms, at 1×, 2× speed",
    ):  # fmt: skip
        assert text in top
    assert NASTY in page.text


def test_the_curves_are_the_gains_by_exposure_and_by_speed(page: Parsed, stored: Stored) -> None:
    from plotly.graph_objects import Figure  # type: ignore[import-untyped]

    for figure in page.figures:
        Figure(figure)  # raises ValueError for a wrong name or value
    assert len(page.figures) == 4 + 4 + 1

    def psnr(poses: str, weights: str, cases: tuple[str, ...]) -> Any:
        return np.array([stored[case]["mid-exposure"][f"psnr_db_{poses}_{weights}"] for case in cases])

    def gains(poses: str, sigma: float, cases: tuple[str, ...]) -> Any:
        return pytest.approx(psnr(poses, f"sigma{sigma:g}", cases) - psnr(poses, "constant", cases), abs=2e-3)

    slow, fast = ("exposure_0ms", "exposure_20ms", "exposure_30ms"), ("exposure_20ms", "exposure_20ms_speed_2x")
    for n, poses in enumerate(("true", "estimated")):
        by_exposure, absolute, _, by_speed = page.figures[4 * n : 4 * n + 4]
        for trace, sigma in zip(by_exposure["data"], (0.5, 1.0), strict=True):
            assert (trace["name"], trace["x"]) == (f"σ {sigma:g} px", [0.0, 20.0, 30.0])
            assert trace["y"] == gains(poses, sigma, slow)
        for trace, sigma in zip(by_speed["data"], (0.5, 1.0), strict=True):
            assert trace["x"] == [1.0, 2.0] and trace["y"] == gains(poses, sigma, fast)
        assert [trace["name"] for trace in absolute["data"]] == ["constant", "σ 0.5 px", "σ 1 px"]
        assert absolute["data"][0]["y"] == pytest.approx(psnr(poses, "constant", slow), abs=5e-3)
    lost = page.figures[-1]["data"][2]
    assert lost["name"] == "blur weight" and lost["y"] == [None]


def test_the_pictures_are_the_panels(page: Parsed, made: tuple[Path, StressResult]) -> None:
    uris = page.uris()
    assert len(uris) == 5 + 2
    for uri, name in zip(uris[:5], ("registered", "weights", "constant", "blur_aware", "sharp_view"), strict=True):
        panel = cv2.imread(str(made[0] / PANELS / f"{name}.png")).astype(float)
        others = [picture(uri).astype(float) - panel for uri in uris[:5]]
        errors = [np.mean(other**2) for other in others]
        assert np.argmin(errors) == uris.index(uri)
    assert {uris[5], uris[6]} == {uris[2], uris[3]}, "the slider's two"
    assert "white: 0.25" in page.text and "frame 12 of the sequence 20 ms" in page.text


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda d: d[0].pop("cell"), "0.cell: Field required"),
        (lambda d: d.clear(), "holds no records"),
        (lambda d: d[3].update(runs=[{"ate_mm": "high"}]), "3.runs.0.ate_mm"),
        (lambda d: d[2].update(settings={}), "is no stress test's"),
        (lambda d: d[2]["settings"]["settings"].update(speed="fast"), "is no stress test's"),
        (lambda d: d[0]["settings"]["settings"].update(sigmas_px=3), "is no stress test's"),
    ],
)
def test_a_broken_file_is_refused_in_one_line(copy: Path, change: Any, complaint: str) -> None:
    data = json.loads((copy / "stress.json").read_text())
    change(data)
    (copy / "stress.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match=rf"stress\.json: {complaint}.*: run 'rstrack bench stress' again$") as error:
        write_report(copy)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"config": "\\ud800"}', "\xff"])
def test_what_is_no_results_file_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "stress.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(UserError, match=r"stress\.json[^\n]*$"):
        write_report(tmp_path)


def test_a_sequence_of_its_own_is_refused(made: tuple[Path, StressResult], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a stress test knows its sequences: leave --sequence"):
        write_report(made[0], tmp_path)


def test_a_missing_damaged_or_unexplained_picture_costs_the_pictures_only(copy: Path) -> None:
    def without_pictures(why: str) -> None:
        page = parse(write_report(copy))
        assert "No pictures: " in page.text and why in page.text and not page.uris()
        assert len(tables(page)) == 11

    path = copy / PANELS / "constant.png"
    path.write_bytes(path.read_bytes()[:-40])
    without_pictures("constant.png")
    path.unlink()
    without_pictures("constant.png: cannot be read")
    (copy / PANELS / "panels.json").write_text('{"keyframe": 12, "width": 64, "height": 48, "white": true}')
    without_pictures("panels.json: white")
    shutil.rmtree(copy / PANELS)
    without_pictures("is not there")


def test_a_test_without_depth_or_other_speeds_has_a_page(copy: Path) -> None:
    data = [r for r in json.loads((copy / "stress.json").read_text()) if r["settings"]["settings"]["speed"] == 1.0]
    for record in data:
        figures = record["runs"][0]
        record["runs"] = [{name: figures[name] for name in figures if "estimated" not in name and "fused" not in name}]
    (copy / "stress.json").write_text(json.dumps(data))
    page = parse(write_report(copy))
    assert len(tables(page)) == 4 + 1 and len(page.figures) == 3 + 1
    assert "speed" not in page.text[: page.text.index("Tracking")]
