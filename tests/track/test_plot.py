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
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.metrics.association import Truth
from rstrack.metrics.evaluate import evaluate
from rstrack.metrics.plot import plot_run, run_plot

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


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Figure]:
    """Draws a run and returns the figure instead of writing it."""
    figures: list[Figure] = []
    monkeypatch.setattr(rsgen.figures, "save", lambda figure, path: figures.append(figure))

    def draw(of: Truth | None, run: Estimate) -> Figure:
        plot_run(of, run, None if of is None else evaluate(of, run), Path("x.png"), "seq")
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
        "path from above", "position error, mm", "rotation error, degrees", "inliers, %",
    ]  # fmt: skip
    assert all(position.get_shared_x_axes().joined(position, axis) for axis in (rotation, frames))
    assert frames.get_xlabel() == "time, s" and path.get_aspect() == 1.0
    np.testing.assert_allclose(line(frames, "depth")[:, 1], 100 * (0.9 - 0.3 * STAMPS))
    assert np.isnan(line(frames, "colour")[:3, 1]).all()
    ticks = {c.get_label(): [s[0, 0] for s in c.get_segments()] for c in frames.collections}
    np.testing.assert_allclose(ticks["keyframe"], STAMPS[4::10])
    np.testing.assert_allclose(ticks["lost"], STAMPS[20:22])
    assert (
        f"ATE {1e3 * metrics.ate_rmse_m:.2f} mm" in figure.get_suptitle() and "seq: 39 of 39" in figure.get_suptitle()
    )


def test_the_path_is_aligned_and_seen_from_above(drawn: Callable[..., Figure]) -> None:
    # The synthetic camera looks along z with y down: from above, x is to the right and z upwards, not mirrored.
    path = drawn(truth(), estimate()).axes[0]
    assert (path.get_xlabel(), path.get_ylabel()) == ("x, m", "z, m") and not path.yaxis_inverted()
    np.testing.assert_allclose(line(path, "estimated"), SPLINE.pose(STAMPS)[:, [0, 2], 3], atol=0.02)
    true = line(path, "true")
    np.testing.assert_allclose(true[[0, -1]], SPLINE.pose(STAMPS[[0, -1]])[:, [0, 2], 3], atol=1e-9)


@pytest.mark.parametrize(
    ("turn", "labels", "is_flipped"),
    [
        ([np.pi, 0, 0], ("x, m", "z, m"), True),  # y up
        ([-np.pi / 2, 0, 0], ("x, m", "y, m"), False),  # z up
        ([np.pi / 2, 0, 0], ("x, m", "y, m"), True),  # z down
        ([0, 0, np.pi / 2], ("y, m", "z, m"), False),  # x up
        ([0, 0, -np.pi / 2], ("y, m", "z, m"), True),  # x down
    ],
)
def test_the_view_is_from_above_in_any_world(
    drawn: Callable[..., Figure], turn: list[float], labels: tuple[str, str], is_flipped: bool
) -> None:
    T = se3.exp([0, 0, 0, *turn])
    run = Estimate(STAMPS, se3.orthonormalise(T @ SPLINE.pose(STAMPS)))
    path = drawn(None, run).axes[0]
    assert (path.get_xlabel(), path.get_ylabel()) == labels and path.yaxis_inverted() == is_flipped
    # Right × up on the page points up in the world: against the camera's y.
    axes = np.eye(3)
    right, upwards = (axes["xyz".index(label[0])] for label in labels)
    towards_viewer = np.cross(right, -upwards if is_flipped else upwards)
    assert towards_viewer @ (T[:3, :3] @ [0, -1, 0]) == pytest.approx(1.0)


def test_lines_break_off_where_the_track_was_lost(drawn: Callable[..., Figure]) -> None:
    figure = drawn(truth(), estimate(np.r_[0:15, 25:39]))
    for axis in figure.axes[1:]:
        assert np.flatnonzero(np.isnan(axis.lines[0].get_ydata())).tolist() == [15]
    assert np.isnan(line(figure.axes[0], "estimated")[15]).all()


def test_without_truth_there_are_no_errors(drawn: Callable[..., Figure]) -> None:
    figure = drawn(None, estimate(frames=diagnostics(STAMPS)))
    assert [axis.get_title(loc="left") for axis in figure.axes] == ["path from above", "inliers, %"]
    assert "39 poses" in figure.get_suptitle()
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
    plot_run(truth(Trajectory(STAMPS, SPLINE.pose(STAMPS))), run, None, tmp_path / "run.png")
    picture = cv2.imread(str(tmp_path / "run.png"))
    assert picture is not None and picture.shape[1] == 1600
    plot_run(None, run, None, tmp_path / "new" / "run.pdf")
    assert (tmp_path / "new" / "run.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(UserError, match="cannot be written as"):
        plot_run(None, run, None, tmp_path / "run.xyz")


def test_a_run_is_plotted_from_folders(tmp_path: Path) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", frames=6)
    write_estimate(tmp_path / "run", STAMPS[:6], SPLINE.pose(STAMPS[:6]), SPLINE, {"frames": diagnostics(STAMPS[:6])})
    run_plot(root, tmp_path / "run", tmp_path / "a.png")
    run_plot(None, tmp_path / "run", tmp_path / "b.png")
    assert (tmp_path / "a.png").stat().st_size > (tmp_path / "b.png").stat().st_size > 10_000
