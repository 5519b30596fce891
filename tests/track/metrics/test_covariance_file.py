"""`rstrack export RUN covariance` by a reader of its own: the layout, the frame, and errors drawn from the model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimates import walk

from rsgen.geometry import se3
from rstrack.cli.main import main
from rstrack.data.estimate import write_estimate

STAMPS = np.array([0.5, 0.6, 0.7, 0.8, 0.9])


def read(path: Path) -> tuple[dict[str, str], np.ndarray, np.ndarray, np.ndarray]:
    """Header, stamps (n,), poses (n, 4, 4), covariances (n, 6, 6) of a SQUARE file with Gaussian poses."""
    lines = path.read_text().splitlines()
    header = dict(line[2:].split(" ", 1) for line in lines if line.startswith("#%"))
    rows = np.array([[float(word) for word in line.split()] for line in lines if not line.startswith("#")])
    assert rows.shape[1] == 1 + 7 + 21
    C = np.zeros((len(rows), 6, 6))
    entries = iter(rows[:, 8:].T)
    for a in range(6):
        for b in range(a + 1):
            C[:, a, b] = C[:, b, a] = next(entries)
    return header, rows[:, 0], se3.from_quat_trans(rows[:, 4:8], rows[:, 1:4]), C


def write_run(folder: Path, T: np.ndarray, parts: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]) -> Path:
    upper = np.triu_indices(6)
    frames: list[dict[str, Any]] = [
        {"stamp": t, "covariance": C[upper], "drift_world": D[upper]} | ({} if J is None else {"common": J})
        for t, (C, D, J) in zip(STAMPS, parts, strict=True)
    ]
    write_estimate(folder, STAMPS, T, None, {"frames": frames, "versions": {"rstrack": "1.2.3"}})
    return folder


def test_covariances_are_of_poses_against_the_first_in_the_cameras_frame(tmp_path: Path) -> None:
    """A pose's own error, a keyframe's, and the calibration's, drawn; the world is where the first frame is seen."""
    rng, count = np.random.default_rng(3), 40_000
    T = walk(6, 5, step=0.5)

    def drawn() -> np.ndarray:
        A = rng.normal(size=(6, 6))
        return 1e-6 * (A @ A.T / 6.0 + 0.2 * np.eye(6))

    nothing, world, own = np.zeros((6, 6)), drawn(), [drawn() for _ in T]
    common = 1e-3 * rng.normal(size=(5, 6, 3))
    own[0], keyframe = nothing, [0, 0, 0, 1, 1]
    drift = [k * world for k in keyframe]
    run = write_run(tmp_path / "run", T, list(zip(own, drift, common, strict=True)))
    assert main(["export", str(run), "covariance", "--out", str(tmp_path / "run.SQUARE")]) == 0
    _, stamps, poses, C = read(tmp_path / "run.SQUARE")
    np.testing.assert_allclose(stamps, STAMPS, atol=1e-9)
    np.testing.assert_allclose(poses, T, atol=1e-8)
    assert np.abs(C[0]).max() < 1e-30

    calibration = np.einsum("nam,cm->nca", common, rng.normal(size=(count, 3)))
    alone = np.stack([rng.multivariate_normal(np.zeros(6), one, count) for one in own])
    moved = se3.exp(rng.multivariate_normal(np.zeros(6), world, count))
    est = T[:, None] @ se3.exp(alone + calibration)
    est[3:] = moved @ est[3:]
    est = T[0] @ se3.inverse(est[0]) @ est
    for n in range(1, 5):
        half = np.linalg.inv(np.linalg.cholesky(C[n]))
        errors = se3.log(se3.inverse(est[n]) @ T[n])  # the truth is the mean times exp(ξ)
        np.testing.assert_allclose(half @ np.cov(errors.T) @ half.T, np.eye(6), atol=0.04)


def test_the_header_says_what_the_columns_are_and_frames_without_covariance_are_left_out(tmp_path: Path) -> None:
    T, C = walk(7, 5), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-6
    run = write_run(tmp_path / "run", T, [(C, 0.0 * C, None)] * 5)
    frames = (run / "run.json").read_text().replace('"stamp": 0.7', '"stamp": 0.75')
    (run / "run.json").write_text(frames)
    assert main(["export", str(run), "covariance", "--out", str(tmp_path / "run.SQUARE")]) == 0
    header, stamps, _, found = read(tmp_path / "run.SQUARE")
    assert header == {
        "FORMAT": "SQUARE/0.3", "REPRESENTATION": "gaussian_se3", "POSE_FRAME": "world", "BODY_FRAME": "depth",
        "GAUGE": "se3", "TIMESTAMP_UNIT": "seconds", "ALGORITHM": "rstrack", "ALGORITHM_VERSION": "1.2.3",
        "TANGENT_CONVENTION": "right_perturbation", "TANGENT_ORDER": "translation_rotation",
        "ROTATION_PARAM": "axis_angle",
    }  # fmt: skip
    assert stamps.tolist() == [0.5, 0.6, 0.8, 0.9]
    np.testing.assert_allclose(found, [C] * 4, rtol=1e-8)


def test_a_run_without_covariances_is_refused_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_estimate(tmp_path / "run", STAMPS, walk(8, 5), None, {})
    assert main(["export", str(tmp_path / "run"), "covariance", "--out", str(tmp_path / "x")]) == 2
    error = capfd.readouterr().err
    assert "run: has no covariances of poses" in error and error.count("\n") == 1 and not (tmp_path / "x").exists()
    assert main(["export", str(tmp_path / "run"), "poses", "--out", str(tmp_path / "x")]) == 2
    assert "covariance" in capfd.readouterr().err
