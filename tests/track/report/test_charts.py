"""The picture of a run: its size, what is drawn in it and where, and that it does without a truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
from matplotlib.figure import Figure

import rsgen.figures
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.charts.chart import Chart, Curve, PathChart, Ticks
from rstrack.charts.runs import compared_errors, error_charts, inlier_charts, path_chart, run_plot
from rstrack.charts.to_file import write_charts
from rstrack.charts.to_page import figure_of
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.metrics.association import Truth, compare
from rstrack.metrics.evaluate import evaluate
from rstrack.metrics.run_evaluate import Tracked

SPLINE = synthetic.make_spline()
STAMPS = np.arange(39) / 30.0
CAMERA, SHUTTER = Camera(16, 12, 12.0, 12.0, 7.5, 5.5), Shutter(0.028)
WORLD = se3.exp(np.array([3.0, -1.0, 2.0, 0.4, -0.3, 0.4]))


def truth(motion: Spline | Trajectory = SPLINE) -> Truth:
    return Truth(motion, STAMPS, CAMERA, SHUTTER)


def diagnostics(stamps: np.ndarray) -> list[dict[str, Any]]:
    return [
        {
            "stamp": float(stamp), "sigma_depth_m": 1e-3, "sigma_intensity": None, "inliers_depth": 0.9 - 0.3 * stamp,
            "inliers_color": None if k < 3 else 0.7, "iterations": 12, "keyframe": k % 10 == 4, "lost": k in (20, 21),
        }
        for k, stamp in enumerate(stamps)
    ]  # fmt: skip


def estimate(kept: np.ndarray | None = None, **info: Any) -> Estimate:
    stamps = STAMPS if kept is None else STAMPS[kept]
    xi = 0.004 * np.random.default_rng(1).normal(size=(len(stamps), 6))
    return Estimate(stamps, se3.orthonormalise(WORLD @ SPLINE.pose(stamps) @ se3.exp(xi)), None, info)


def charts(of: Truth | None, run: Estimate) -> list[Chart | PathChart]:
    tracked = Tracked(run, None, of, None if of is None else compare(of, run))
    return [path_chart({"estimated": tracked}), *error_charts(tracked)[:2], *inlier_charts(tracked)]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Figure]:
    """Draws a run and returns the figure instead of writing it."""
    figures: list[Figure] = []
    monkeypatch.setattr(rsgen.figures, "save", lambda figure, path: figures.append(figure))

    def draw(of: Truth | None, run: Estimate) -> Figure:
        write_charts(charts(of, run), Path("x.png"), "a run")
        figures[-1].draw_without_rendering()
        return figures[-1]

    return draw


def line(axis: Any, label: str) -> np.ndarray:
    (found,) = [line for line in axis.lines if line.get_label() == label]
    return np.array(found.get_xydata())


def test_panels_and_their_values(drawn: Callable[..., Figure]) -> None:
    run = estimate(frames=diagnostics(STAMPS))
    figure = drawn(truth(), run)
    path, position, rotation, frames = figure.axes
    metrics = evaluate(truth(), run)
    values = position.lines[0].get_ydata()
    assert np.sqrt(np.mean(np.square(values))) == pytest.approx(1e3 * metrics.ate_rmse_m)
    assert position.lines[1].get_ydata()[0] == pytest.approx(1e3 * metrics.ate_rmse_m)
    assert 0.1 < np.max(rotation.lines[0].get_ydata()) < 3.0
    assert [axis.get_title(loc="left") for axis in figure.axes] == [
        "Path from above", "Position error after alignment, mm", "Rotation error after alignment, degrees",
        "Inliers, %",
    ]  # fmt: skip
    assert all(position.get_shared_x_axes().joined(position, axis) for axis in (rotation, frames))
    assert frames.get_xlabel() == "time since the first frame, s" and path.get_aspect() == 1.0
    np.testing.assert_allclose(line(frames, "depth")[:, 1], 100 * (0.9 - 0.3 * STAMPS))
    assert np.isnan(line(frames, "colour")[:3, 1]).all()
    ticks = {c.get_label(): [s[0, 0] for s in c.get_segments()] for c in frames.collections}
    np.testing.assert_allclose(ticks["keyframe"], STAMPS[4::10])
    np.testing.assert_allclose(ticks["lost"], STAMPS[20:22])


def test_the_path_is_aligned_and_seen_from_above(drawn: Callable[..., Figure]) -> None:
    # The synthetic camera looks along z with y down: from above, x is to the right and z upwards, not mirrored.
    path = drawn(truth(), estimate()).axes[0]
    assert (path.get_xlabel(), path.get_ylabel()) == ("x, m", "z, m")
    np.testing.assert_allclose(line(path, "estimated"), SPLINE.pose(STAMPS)[:, [0, 2], 3], atol=0.02)
    true = line(path, "true")
    np.testing.assert_allclose(true[[0, -1]], SPLINE.pose(STAMPS[[0, -1]])[:, [0, 2], 3], atol=1e-9)


def test_lines_break_off_where_the_track_was_lost(drawn: Callable[..., Figure]) -> None:
    figure = drawn(truth(), estimate(np.r_[0:15, 25:39]))
    for axis in figure.axes[1:]:
        assert np.flatnonzero(np.isnan(axis.lines[0].get_ydata())).tolist() == [15]
    assert np.isnan(line(figure.axes[0], "estimated")[15]).all()


def test_without_truth_there_are_no_errors(drawn: Callable[..., Figure]) -> None:
    figure = drawn(None, estimate(frames=diagnostics(STAMPS)))
    assert [axis.get_title(loc="left") for axis in figure.axes] == ["Path from above", "Inliers, %"]
    assert len(drawn(None, estimate()).axes) == 1


@pytest.mark.parametrize("frames", ["x", [], [1, None], [{"stamp": "a"}], {"stamp": 1.0}])
def test_other_things_called_frames_are_left_alone(drawn: Callable[..., Figure], frames: object) -> None:
    assert len(drawn(truth(), estimate(frames=frames)).axes) == 3


@pytest.mark.parametrize("with_truth", [True, False])
def test_no_text_overlaps(drawn: Callable[..., Figure], with_truth: bool) -> None:
    figure = drawn(truth() if with_truth else None, estimate(frames=diagnostics(STAMPS)))
    boxes = [figure._suptitle.get_window_extent()]  # type: ignore[attr-defined]
    for axis in figure.axes:
        boxes.append(axis._left_title.get_window_extent())
        boxes += [axis.xaxis.label.get_window_extent()] if axis.get_xlabel() else []
        legend = axis.get_legend()
        boxes += [text.get_window_extent() for text in legend.get_texts()] if legend else []
    for k, box in enumerate(boxes):
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
        assert not any(box.overlaps(other) for other in boxes[k + 1 :])


def test_a_png_is_1600_pixels_wide_and_a_pdf_is_a_pdf(tmp_path: Path) -> None:
    run = estimate(frames=diagnostics(STAMPS))
    write_charts(charts(truth(Trajectory(STAMPS, SPLINE.pose(STAMPS))), run), tmp_path / "run.png")
    picture = cv2.imread(str(tmp_path / "run.png"))
    assert picture is not None and picture.shape[1] == 1600
    write_charts(charts(None, run), tmp_path / "new" / "run.pdf")
    assert (tmp_path / "new" / "run.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(UserError, match="cannot be written as"):
        write_charts(charts(None, run), tmp_path / "run.xyz")


def test_a_run_is_plotted_from_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", frames=6)
    write_estimate(tmp_path / "run", STAMPS[:6], SPLINE.pose(STAMPS[:6]), SPLINE, {"frames": diagnostics(STAMPS[:6])})
    run_plot(root, tmp_path / "run", tmp_path / "a.png")
    run_plot(None, tmp_path / "run", tmp_path / "b.png")
    assert (tmp_path / "a.png").stat().st_size > (tmp_path / "b.png").stat().st_size > 10_000
    titles: list[str] = []
    monkeypatch.setattr("rstrack.charts.runs.write_charts", lambda charts, out, title: titles.append(title))
    run_plot(root, tmp_path / "run", tmp_path / "a.png")
    run_plot(None, tmp_path / "run", tmp_path / "b.png")
    assert titles[0].endswith(": 6 of 6 frames tracked, ATE 0.00 mm") and titles[1] == "run: 6 poses"


def test_both_drawers_draw_the_same_numbers(drawn: Callable[..., Figure]) -> None:
    run = estimate(np.r_[0:15, 25:39], frames=diagnostics(STAMPS))
    axes = drawn(truth(), run).axes
    paths, *others = charts(truth(), run)
    for axis, chart in zip(axes[1:], others, strict=True):
        traces = figure_of(chart, 1500)["data"]
        for line, trace in zip(axis.lines, traces, strict=False):
            assert line.get_label() == trace["name"]
            y = np.array(trace["y"], np.float64)
            np.testing.assert_allclose(np.asarray(line.get_ydata(), float), y, rtol=1e-3)
    for line, trace in zip(axes[0].lines, figure_of(paths, 1500)["data"], strict=False):
        in_space = np.array([trace["x"], trace["y"]], np.float64).T
        np.testing.assert_allclose(np.asarray(line.get_xydata(), float), in_space, atol=1e-4)


def test_time_is_counted_from_the_first_frame_by_both_drawers(
    drawn: Callable[..., Figure], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    epoch = 1305031453.371
    poses = estimate()
    run = Estimate(epoch + STAMPS, poses.T_world_depth, None, {"frames": diagnostics(epoch + STAMPS)})
    of = Truth(Trajectory(epoch + STAMPS, SPLINE.pose(STAMPS)), epoch + STAMPS)
    for axis in drawn(of, run).axes[1:]:
        np.testing.assert_allclose(axis.lines[0].get_xdata(), STAMPS, atol=1e-6)
    tracked = Tracked(run, None, of, compare(of, run))
    path, *others = [*charts(of, run), compared_errors({"a": tracked, "b": tracked})]
    for chart in others:
        np.testing.assert_allclose(figure_of(chart, 1500)["data"][0]["x"], STAMPS, atol=1e-4)
    assert all(trace["text"][-1].startswith("1.27 s") for trace in figure_of(path, 1500)["data"])
    write_estimate(tmp_path / "run", run.stamps, run.T_world_depth, None, run.info)
    labels: list[str] = []
    monkeypatch.setattr(
        "rstrack.charts.runs.write_charts", lambda charts, out, title: labels.append(charts[-1].x_label)
    )
    run_plot(None, tmp_path / "run", tmp_path / "a.png")
    assert labels == ["time since the first frame at 1305031453.371 s, s"]


def test_a_line_of_many_points_is_thinned_on_the_page() -> None:
    t = np.arange(10_000) / 100.0
    chart = Chart("a", "mm", lines=(Curve("b", "#000000", t, np.sin(t)),), ticks=(Ticks("c", "#000000", t[:3]),))
    line, ticks = figure_of(chart, 50)["data"]
    assert len(line["x"]) == 50 and line["x"][0] == 0.0 and line["x"][-1] == pytest.approx(99.99)
    assert ticks["y"] == [pytest.approx(-0.06, rel=1e-3)] * 3
