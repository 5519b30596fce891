"""Maps of the whole evaluation: what is fused how, what is kept, what fails, and that the report shows them."""

from __future__ import annotations

import base64
import dataclasses
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import trimesh
import yaml
from bench_evaluation import made_up_record, main

import rstrack.bench.experiments.pictures as mesh_pictures
from rstrack.bench.experiments.method_tables import write_results
from rstrack.bench.experiments.methods import Results, SequenceInfo
from rstrack.bench.experiments.pictures import draw_meshes, make_mesh, read_picture
from rstrack.bench.record import write_record
from rstrack.bench.runner import Outcome
from rstrack.data.estimate import write_estimate
from rstrack.report.build import write_report

FRAMES = 8
RUN = subprocess.run
METHODS = ("baseline", "rs-pg", "gs-g")
ATE_M = {"baseline": 0.0123, "rs-pg": 0.00045, "gs-g": 0.006}


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """seq/, and bench/ with a cell of each method, along the true path; the baseline has no spline."""
    folder = tmp_path_factory.mktemp("meshes")
    synthetic.make_sequence(folder / "seq", synthetic.make_config(), FRAMES)
    spline = synthetic.make_spline()
    stamps = np.arange(FRAMES) / synthetic.RATE_HZ
    for method in METHODS:
        run = folder / "bench/cells/track/a" / method
        write_estimate(run, stamps, spline.pose(stamps), None if method == "baseline" else spline, {"method": method})
    draw_meshes(of(folder), folder / "bench", warn=pytest.fail)
    return folder


@pytest.fixture
def place(original: Path, tmp_path: Path) -> Path:
    """A copy of it to change."""
    shutil.copytree(original / "bench", tmp_path / "w/bench")
    (tmp_path / "w/seq").symlink_to(original / "seq")
    return tmp_path / "w"


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What is fused (the method) and drawn ('picture', grey and at once) from now on."""
    made: list[str] = []
    real_map = mesh_pictures.run_map

    def watched_map(sequence: Path, run: Path, *rest: Any, **named: Any) -> Any:
        made.append(run.name)
        return real_map(sequence, run, *rest, **named)

    def draw(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        made.append("picture")
        (out,) = [word.removeprefix("--out=") for word in command if word.startswith("--out=")]
        cv2.imwrite(out, np.full((570, 720, 3), 128, np.uint8))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(mesh_pictures, "run_map", watched_map)
    monkeypatch.setattr(subprocess, "run", draw)
    yield made


def of(folder: Path, **changes: Any) -> Results:
    """Results with the cells, each with its record; `changes`: fields of the baseline's."""
    records = []
    for method in METHODS:
        figures = {"ate_mm": 1e3 * ATE_M[method], "drift_mm_s": 100.0, "drift_deg_s": 1.0, "frames": FRAMES, "lost": 0}
        record = made_up_record("a", method, total_s=1.0, **figures)
        change = {"key": f"key of {method}"} | (changes if method == "baseline" else {})
        record = dataclasses.replace(record, **change)
        write_record(folder / "bench/cells" / record.cell / "record.json", record)
        records.append(record)
    sequence = SequenceInfo("a", "hand-held", folder / "seq", FRAMES)
    return Results(sequences=(sequence,), methods=METHODS, records=tuple(records))


def panel(folder: Path, k: int) -> np.ndarray:
    """The k-th mesh of the picture (540, 720, 3), 6 px from the next and below 30 px of label."""
    image = cv2.imread(str(folder / "bench/plots/meshes_a.jpg"))
    assert image is not None and image.shape == (570, 2 * 720 + 6, 3)
    return np.asarray(image[30:, k * 726 : k * 726 + 720])


def distance_to_box(folder: Path, method: str) -> np.ndarray:
    """How far (n,) m a map's vertices, less those of the ball and near it, are from the walls of the true room."""
    mesh = trimesh.load(folder / "bench/cells/track/a" / method / "mesh.ply", process=False)
    p = np.asarray(mesh.vertices)
    p = p[np.linalg.norm(p - synthetic.BALL, axis=1) > 1.5 * synthetic.BALL_RADIUS]
    return np.abs(p[:, None] - synthetic.BOX).min(axis=(1, 2))


# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_lines_have_poses_of_their_own_where_the_method_says_so(original: Path) -> None:
    ours, baseline = distance_to_box(original, "rs-pg"), distance_to_box(original, "baseline")
    assert np.median(ours) < 0.001 < np.median(baseline)
    assert not (original / "bench/cells/track/a/gs-g/mesh.ply").exists()
    cell = of(original).records[2]
    options = make_mesh(of(original).sequences[0], cell, original / "bench")["options"]
    assert options["shutter"] == "gs", "gs-g has a spline, and takes the shutter for a global one all the same"
    assert np.median(distance_to_box(original, "gs-g")) > 0.001


def test_the_picture_shows_ours_first(original: Path) -> None:
    panels = [panel(original, k) for k in range(2)]
    assert all(p.std() > 20.0 and (p > 250).all(axis=-1).mean() < 0.96 for p in panels)
    assert np.abs(panels[0].astype(float) - panels[1]).mean() > 0.5
    of(original)
    found = read_picture(original / "bench", "a")
    assert found is not None and found.methods == ("rs-pg", "baseline")
    assert found.labels == ("rs-pg, ATE 0.45 mm", "baseline, ATE 12.3 mm") and found.panel_px == (720, 540)


def test_a_long_sequence_is_thinned(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    monkeypatch.setattr(mesh_pictures, "run_map", lambda _, __, ___, options, **____: seen.append(options.every))
    results = of(place)
    for frames in (30, 80, 648, 1509):
        shutil.rmtree(place / "bench/cells/track/a/gs-g", ignore_errors=True)
        (place / "bench/cells/track/a/gs-g").mkdir()
        make_mesh(dataclasses.replace(results.sequences[0], frames=frames), results.records[2], place / "bench")
    assert seen == [1, 1, 8, 19]


def test_what_is_there_is_kept_and_what_changed_is_made_again(place: Path, calls: list[str]) -> None:
    out = place / "bench"
    assert draw_meshes(of(place), out, warn=pytest.fail) == [out / "plots/meshes_a.jpg"]
    assert calls == []
    assert draw_meshes(of(place, key="another"), out, warn=pytest.fail) and calls == ["baseline", "picture"]
    calls.clear()
    (out / "plots/meshes_a.jpg").unlink()
    draw_meshes(of(place, key="another"), out, warn=pytest.fail)
    assert calls == ["picture"] and (out / "plots/meshes_a.jpg").is_file()
    calls.clear()
    draw_meshes(of(place, key="another"), out, ("baseline",), warn=pytest.fail)
    assert calls == ["picture"], "of fewer meshes"


def test_an_interrupt_leaves_nothing_half_made(place: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    out = place / "bench"
    with monkeypatch.context() as broken:

        def interrupted(_: Any, __: Any, mesh: Path, *___: Any, **____: Any) -> None:
            mesh.write_text("half of it")
            raise KeyboardInterrupt

        broken.setattr(mesh_pictures, "run_map", interrupted)
        with pytest.raises(KeyboardInterrupt):
            draw_meshes(of(place, key="another"), out, warn=pytest.fail)
    # Back to the inputs of the mesh that is no longer there.
    draw_meshes(of(place), out, warn=pytest.fail)
    assert calls == ["baseline"] and np.median(distance_to_box(place, "baseline")) > 0.0


def test_what_fails_is_said_and_the_others_are_drawn(
    place: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, said = place / "bench", list[str]()
    (out / "cells/track/a/baseline/trajectory.txt").write_text("not a trajectory\n")
    draw_meshes(of(place, key="another"), out, ("baseline", "rs-pg"), warn=said.append)
    assert len(said) == 1 and said[0].startswith("no mesh of baseline on a: ") and "trajectory.txt" in said[0]
    found = read_picture(out, "a")
    assert found is not None and found.methods == ("rs-pg",) and calls == ["baseline", "picture"]
    (out / "cells/track/a/rs-pg/mesh.ply").write_text("no mesh")
    said.clear()
    assert draw_meshes(of(place), out, ("rs-pg",), warn=said.append) != [] and said == []
    (out / "plots/meshes_a.jpg").unlink()
    monkeypatch.setattr(subprocess, "run", RUN)
    assert draw_meshes(of(place), out, ("rs-pg",), warn=said.append) == []
    (told,) = said
    assert "no picture of the meshes of a: rsgen preview --quiet failed: " in told and "mesh.ply" in told


def test_lost_tracks_are_not_shown(place: Path, calls: list[str]) -> None:
    lost = {"ate_mm": 1.0, "frames": FRAMES, "lost": FRAMES - 1}
    draw_meshes(of(place, runs=(lost,)), place / "bench", warn=pytest.fail)
    found = read_picture(place / "bench", "a")
    assert found is not None and found.methods == ("rs-pg",) and calls == ["picture"]


# ---------------------------------------------------------------------------------------------------------------------


def test_the_report_shows_the_parts_of_the_picture(place: Path) -> None:
    write_results(of(place), place / "bench")
    page = write_report(place / "bench").read_text()
    shown: dict[str, list[Any]] = {}
    for uri, alt in re.findall(r'<img[^>]*src="data:image/jpeg;base64,([^"]+)" alt="map from above, ([^"]+)"', page):
        shown.setdefault(alt, []).append(cv2.imdecode(np.frombuffer(base64.b64decode(uri), np.uint8), cv2.IMREAD_COLOR))
    assert list(sorted(shown)) == ["baseline, ATE 12.3 mm", "rs-pg, ATE 0.45 mm"]
    for k, label in enumerate(("rs-pg, ATE 0.45 mm", "baseline, ATE 12.3 mm")):
        large, small = sorted(shown[label], key=lambda image: -image.shape[1])
        assert large.shape == (540, 720, 3) and small.shape == (360, 480, 3)
        assert np.abs(large.astype(float) - panel(place, k)).mean() < 3.0
    assert "Map with baseline against rs-pg" in page


def test_the_report_leaves_out_maps_of_cells_that_were_run_again(place: Path) -> None:
    write_results(of(place, key="another"), place / "bench")
    assert read_picture(place / "bench", "a") is None
    page = write_report(place / "bench").read_text()
    assert "map from above" not in page
    write_results(of(place), place / "bench")
    (place / "bench/plots/meshes_a.jpg").write_text("no JPEG")
    page = write_report(place / "bench").read_text()
    assert "No maps of a: " in page and "map from above" not in page


@pytest.mark.parametrize(
    ("words", "drawn"), [("", True), ("--no-meshes", False), ("--quick", False), ("--quick --meshes", True)]
)
def test_the_command(
    place: Path, words: str, drawn: bool, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    results, called = of(place), []
    outcome = Outcome({record.cell: record for record in results.records})
    monkeypatch.setattr("rstrack.bench.runner.run_cells", lambda *_: outcome)
    monkeypatch.setattr("rstrack.bench.experiments.pictures.draw_plots", lambda *_: [])

    def draw(given: Results, out: Path, progress: Any, warn: Any) -> list[Path]:
        called.append((given.records, out))
        warn("no mesh of this one")
        raise KeyboardInterrupt

    monkeypatch.setattr(mesh_pictures, "draw_meshes", draw)
    entry = {"path": "seq", "group": "hand-held"}
    quick = {"sequences": ["a"], "methods": ["rs-pg"], "frames": 10}
    (place / "c.yaml").write_text(yaml.safe_dump({"sequences": {"a": entry}, "methods": ["rs-pg"], "quick": quick}))
    status = main(f"bench {place}/c.yaml --data {place} --out {place}/bench --quiet {words}")
    out, error = capfd.readouterr()
    assert called == ([(results.records, place / "bench")] if drawn else [])
    assert status == (130 if drawn else 0) and "rs-pg" in out
    assert ("no mesh of this one\n" in error and "the same command goes on" in error) == drawn


def test_meshes_of_methods_that_have_none_are_refused(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (place / "c.yaml").write_text(yaml.safe_dump({"sequences": {"a": {"path": "seq"}}, "methods": ["rs-g"]}))
    assert main(f"bench {place}/c.yaml --data {place} --out {place}/new --meshes") == 2
    assert capfd.readouterr().err == "rstrack: --meshes: is for rs-pg, gs-pg, baseline: add one of them to --method\n"
    assert not (place / "new").exists()
