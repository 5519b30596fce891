"""Which poses are compared with which true ones, and in which common frame: SciPy, an optimiser, degenerate paths."""

from __future__ import annotations

import numpy as np
import pytest
from estimates import FRAMES, SPLINE, noisy, one_line, truth, walk
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation, Slerp

from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import align, compare
from rstrack.metrics.evaluate import evaluate

# --- alignment -------------------------------------------------------------------------------------------------------


def test_alignment_is_the_best_that_an_optimiser_finds() -> None:
    true, est = walk(3, 40), noisy(walk(3, 40), 4, 0.1)
    T, is_determined = align(true, est)
    assert is_determined

    def cost(xi: np.ndarray) -> float:
        return float(np.sum((se3.transform(se3.exp(xi) @ T, est[:, :3, 3]) - true[:, :3, 3]) ** 2))

    found = minimize(cost, 0.05 * np.ones(6), method="BFGS", options={"gtol": 1e-12})
    assert cost(np.zeros(6)) <= found.fun * (1 + 1e-12)
    assert cost(np.zeros(6)) > 0.0


# --- association -----------------------------------------------------------------------------------------------------


def test_a_spline_is_taken_at_the_stamps_and_those_outside_are_counted() -> None:
    stamps = np.arange(-0.1, 1.5, 0.0137)
    inside = stamps <= SPLINE.t_end
    poses = walk(2, len(stamps))
    poses[inside] = SPLINE.pose(stamps[inside])
    result = evaluate(truth(SPLINE), Estimate(stamps, se3.orthonormalise(poses)))
    assert result.ate_max_m < 1e-12
    assert (result.poses, result.poses_compared) == (len(stamps), int(inside.sum()))
    assert any(f"{int((~inside).sum())} of {len(stamps)}" in note for note in result.notes)


def test_a_stamp_rounded_out_of_the_spline_still_counts() -> None:
    stamps = np.array([SPLINE.t_begin - 4e-10, 0.1, 0.2, 0.3, SPLINE.t_end + 4e-10])
    estimate = Estimate(stamps, SPLINE.pose(np.clip(stamps, SPLINE.t_begin, SPLINE.t_end)))
    assert len(compare(truth(SPLINE), estimate).index) == 5


def test_poses_are_associated_within_20_ms_one_to_one() -> None:
    true = Trajectory(np.arange(20) * 0.1, walk(1, 20))
    stamps = np.array([0.0, 0.119, 0.221, 0.305, 0.306, 0.5])
    found = compare(truth(true), Estimate(stamps, walk(5, 6)))
    assert found.index.tolist() == [0, 1, 3, 5]
    np.testing.assert_array_equal(found.T_world_true, true.T_world_cam[[0, 1, 3, 5]])


def test_interpolated_truth_is_scipys_in_rotation_and_exact_on_a_screw() -> None:
    twist = np.array([0.4, -0.2, 0.3, 0.5, 0.2, -0.9])
    knots = np.arange(40) / 30.0
    true = Trajectory(knots, se3.exp(knots[:, None] * twist))
    stamps = np.linspace(0.0, knots[-1], 71)
    est = Estimate(stamps, se3.exp(stamps[:, None] * twist))
    found = compare(truth(true, interpolate=True), est)
    assert len(found.index) == 71
    np.testing.assert_allclose(found.T_world_true, est.T_world_depth, atol=1e-12)
    slerp = Slerp(knots, Rotation.from_matrix(true.T_world_cam[:, :3, :3]))
    np.testing.assert_allclose(found.T_world_true[:, :3, :3], slerp(stamps).as_matrix(), atol=1e-12)
    assert evaluate(truth(true, interpolate=True), est).ate_max_m < 1e-12
    assert evaluate(truth(true), est).ate_max_m > 1e-3


def test_interpolation_stays_out_of_gaps() -> None:
    true = Trajectory(np.array([0.0, 0.03, 0.06, 1.0, 1.03]), walk(1, 5))
    stamps = np.array([0.01, 0.04, 0.07, 0.5, 0.97, 0.99, 1.01, 1.04])
    found = compare(truth(true, interpolate=True), Estimate(stamps, walk(2, 8)))
    assert found.index.tolist() == [0, 1, 2, 5, 6]


@pytest.mark.parametrize("motion", [SPLINE, Trajectory(np.arange(20) * 0.1, walk(1, 20))], ids=["spline", "poses"])
def test_too_few_common_stamps_is_one_line(motion: Spline | Trajectory) -> None:
    stamps = np.array([0.1, 0.2, 50.0, 51.0])
    with pytest.raises(UserError) as error:
        evaluate(truth(motion), Estimate(stamps, walk(3, 4)))
    assert "2 of 4 poses" in one_line(error)


def test_frames_that_were_tracked_are_counted() -> None:
    kept = np.r_[0:10, 15:30]
    result = evaluate(truth(SPLINE), Estimate(FRAMES[kept], noisy(SPLINE.pose(FRAMES[kept]), 1)))
    assert (result.frames, result.frames_tracked) == (39, 25)
    assert result.coverage == pytest.approx(25 / 39)


# --- degenerate positions --------------------------------------------------------------------------------------------


def test_a_still_camera_is_aligned_by_its_orientations() -> None:
    true = walk(4, 50)
    true[:, :3, 3] = [1.0, 2.0, 3.0]
    world = se3.exp(np.array([3.0, -1.0, 2.0, 0.9, -1.3, 0.4]))
    result = compare(truth(Trajectory(FRAMES, true[:39])), Estimate(FRAMES, se3.orthonormalise(world @ true[:39])))
    assert not result.is_determined
    assert result.position_errors_m.max() < 1e-12 and result.rotation_errors_deg.max() < 1e-6


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.3, -0.5, 0.81]])
def test_the_spin_about_a_straight_path_is_that_of_the_orientations(axis: list[float]) -> None:
    true = walk(6, 39)
    true[:, :3, 3] = np.linspace(0, 1, 39)[:, None] ** 2 * np.array(axis)
    world = se3.exp(np.array([3.0, -1.0, 2.0, 0.9, -1.3, 0.4]))
    est = se3.orthonormalise(world @ true)
    result = compare(truth(Trajectory(FRAMES, true)), Estimate(FRAMES, est))
    assert not result.is_determined
    assert result.position_errors_m.max() < 1e-12 and result.rotation_errors_deg.max() < 1e-6

    # With noisy orientations: no other spin brings them closer.
    est = noisy(true, 7, 0.2)
    est[:, :3, 3] = true[:, :3, 3]
    T, _ = align(true, est)
    spins = so3.exp(np.linspace(-0.5, 0.5, 1001)[:, None] * np.array(axis) / np.linalg.norm(axis))
    fits = np.einsum("sij,njk,nik->s", spins @ T[:3, :3], est[:, :3, :3], true[:, :3, :3])
    assert int(np.argmax(fits)) == 500
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_a_nearly_flat_path_is_not_mirrored() -> None:
    # The little depth it has is inverted: a reflection would fit exactly, a rotation has to leave it.
    true = walk(3, 39)
    true[:, 2, 3] *= 0.01
    est = true.copy()
    est[:, 2, 3] *= -1.0
    T, is_determined = align(true, est)
    assert is_determined and np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.norm(so3.log(T[:3, :3])) < 0.1
