"""A run is refined: every frame against all keyframes that see it. On a ray-cast room."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from loop_room import FRAMES, OPTIONS, make_dataset, to_and_fro

from rsgen.config.sections import ImuConfig
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import simulate_imu, write_imu_csv
from rstrack.adjustment.refine import doubted
from rstrack.alignment.normal_equations import Quadratic
from rstrack.cli.main import main
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.data.imu.description import PHONE
from rstrack.data.imu.recording import ImuRecording, ReadImu
from rstrack.metrics.association import truth_of
from rstrack.metrics.run_evaluate import add_errors, load_run
from rstrack.options import Options
from rstrack.report.build import write_report
from rstrack.tracking.runs import refining
from rstrack.tracking.runs.record import Noise
from rstrack.tracking.runs.refining import Refined, contradiction, refine_run
from rstrack.tracking.runs.run import track

BIAS = (0.01, -0.008, 0.006)
# By how much the description has the IMU wrong: m, rad.
OFF = np.array([2e-3, -1e-3, 3e-3, 0.012, -0.006, 0.009])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refine")
    dataset = make_dataset(folder / "seq").with_color_falloff(1e-5)
    result = track(dataset, OPTIONS, folder / "run", noise=Noise(1.2e-3, 0.01, 1))
    assert result.lost == 0
    add_errors(folder / "run", truth_of(dataset), result.estimate)
    return folder / "run"


def ate(run: Path) -> float:
    return float(json.loads((run / "run.json").read_text())["metrics"]["ate_rmse_m"])


def test_refining_makes_a_run_better(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "refined"
    assert main(["refine", str(run), "--out", str(out), "--rounds", "3", "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "rounds in" in said and "IMU" not in said
    assert ate(out) < 0.85 * ate(run)
    info = json.loads((out / "run.json").read_text())
    rounds = info["refined"]["rounds"]
    assert len(rounds) <= 3 and rounds[-1]["moved_m"] < rounds[0]["moved_m"]
    # What it was made of lies beside it, the first pose stays, and poses go with the spline.
    # To the digits that are written: a pose read and written again may round its last one otherwise.
    np.testing.assert_allclose(np.loadtxt(out / "trajectory_online.txt"), np.loadtxt(run / "trajectory.txt"), atol=2e-9)
    before, after = read_estimate(run), read_estimate(out)
    np.testing.assert_allclose(after.T_world_depth[0], before.T_world_depth[0], atol=2e-8)
    assert after.spline is not None
    np.testing.assert_allclose(after.spline.pose(after.stamps), after.T_world_depth, atol=2e-8)
    # As the run saw it.
    assert info["dataset"]["color_falloff"] == 1e-5
    assert "refined" in write_report(out).read_text()


def test_a_run_refined_with_other_cameras_goes_by_them(run: Path, tmp_path: Path) -> None:
    tracked = load_run(run)
    assert tracked.dataset is not None and tracked.dataset.cameras is None
    rig = tracked.dataset.rig
    late = replace(rig.depth_shutter, readout_s=rig.depth_shutter.readout_s + 1e-3)
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(tracked.dataset.seen_with(replace(rig, depth_shutter=late)).cameras))
    refine_run(run, tmp_path / "refined", camera_file=other, rounds=1)
    again = load_run(tmp_path / "refined").dataset
    assert again is not None and again.rig.depth_shutter == late and again.rig.color_shutter == rig.color_shutter
    assert again.truth is not None and again.sequence is not None


def with_imu(run: Path, folder: Path) -> Path:
    """The same run as if an IMU had been used, whose description is elsewhere, and not quite right."""
    tracked = load_run(run)
    assert tracked.dataset is not None
    shutil.copytree(tracked.dataset.root, folder / "seq")
    shutil.copytree(run, folder / "run")
    truth, read = to_and_fro(), ImuConfig(gyroscope_bias=BIAS, accelerometer_bias=(0.1, -0.07, 0.05))
    write_imu_csv(folder / "seq" / "imu.csv", simulate_imu(truth, read, 0.0, truth.t_end, 2))
    densities = "\n".join(
        f"{n}: {getattr(read, n)}" for n in sorted(ImuConfig.model_fields) if "noise" in n or "walk" in n
    )
    (folder / "unit.yaml").write_text(f"{densities}\nT_imu_depth: {se3.exp(OFF).tolist()}\n")
    info = json.loads((run / "run.json").read_text())
    info["options"]["method"] = "rs-pgi"
    info["dataset"] |= {"path": str(folder / "seq"), "imu_file": str(folder / "unit.yaml")}
    (folder / "run" / "run.json").write_text(json.dumps(info))
    return folder / "run"


def turned_off(run: Path) -> float:
    """Root mean square of what lines' angular rates are off, rad/s."""
    spline, truth, t = read_estimate(run).spline, to_and_fro(), np.linspace(0.1, 0.9, 200)
    assert spline is not None
    return float(np.sqrt(((spline.velocity(t) - truth.velocity(t))[:, 3:] ** 2).mean()))


def test_an_imu_is_looked_at(run: Path, tmp_path: Path) -> None:
    used = with_imu(run, tmp_path)
    refined = refine_run(used, tmp_path / "refined", rounds=1)
    assert refined.before is not None and refined.after is not None
    assert refined.after.metrics.ate_rmse_m < 0.85 * refined.before.metrics.ate_rmse_m
    assert turned_off(tmp_path / "refined") < 0.3 * turned_off(run)
    told = json.loads((tmp_path / "refined" / "run.json").read_text())["imu"]
    off = np.abs(np.array(told["gyro_bias"]) - BIAS) / told["gyro_bias_sigma"]
    assert (off < 4.0).all() and max(told["gyro_bias_sigma"]) < 2e-3
    assert np.linalg.norm(told["gravity"]) == pytest.approx(9.80665, abs=0.1)
    turned = se3.log(np.array(told["T_imu_depth"]))[3:]
    assert np.linalg.norm(turned) < 0.5 * np.linalg.norm(OFF[3:])
    assert (np.abs(turned) < 4.0 * np.array(told["T_imu_depth_sigma"][3:])).all()
    assert "IMU: gravity known to" in refined.text() and "from where T_imu_depth has it" in refined.text()
    # Described by a file that is not there, or not there at all.
    with pytest.raises(UserError, match="nowhere"):
        refine_run(used, tmp_path / "out", imu_file=tmp_path / "nowhere.yaml")
    (tmp_path / "seq" / "imu.csv").unlink()
    with pytest.raises(UserError, match="has no IMU, which method rs-pgi"):
        refine_run(used, tmp_path / "out")


def test_an_accelerometer_alone_is_not_looked_at_and_that_is_said(run: Path, tmp_path: Path) -> None:
    tracked = load_run(run)
    assert tracked.dataset is not None
    alone = ImuRecording(np.arange(0.0, 1.0, 0.01), None, np.ones((100, 3)), PHONE, np.eye(4), 100.0)
    dataset = replace(tracked.dataset)
    object.__setattr__(dataset, "read_imu", ReadImu(alone, ()))
    assert refining._unit(dataset, tracked.estimate, Options(method="rs-pgi")) is None
    refined = Refined(
        tracked.estimate, [{"moved_m": 1e-3, "keyframes": 1, "pairs": 2}], None, None, 1.0, refining._NOT_LOOKED_AT
    )
    assert "the IMU was not looked at" in refined.text()


def test_an_imus_description_is_for_runs_that_use_one(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"is of rs-pg, which uses no IMU"):
        refine_run(run, tmp_path / "out", imu_file=tmp_path / "imu.yaml")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda run: (run / "spline.npz").unlink(), "has no spline"),
        (lambda run: (run / "run.json").write_text("{}"), "where its sequence is"),
        (
            lambda run: (run / "run.json").write_text(
                json.dumps(json.loads((run / "run.json").read_text()) | {"options": {"method": "magic"}})
            ),
            "unknown method 'magic'",
        ),
    ],
)
def test_what_cannot_be_refined_is_said_in_one_line(
    run: Path, tmp_path: Path, change: Callable[[Path], object], complaint: str
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    change(copy)
    with pytest.raises(UserError) as error:
        refine_run(copy, tmp_path / "out")
    assert complaint in str(error.value) and "\n" not in str(error.value)


def test_a_run_is_not_refined_onto_itself(run: Path) -> None:
    with pytest.raises(UserError, match="is the run itself"):
        refine_run(run, run)


def test_no_round_is_no_refinement(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--rounds 0: at least one round"):
        refine_run(run, tmp_path / "out", rounds=0)


def test_a_doubted_image_is_one_whose_offset_is_an_unknown_too() -> None:
    """Against the minimum over the offset, found by least squares of the whole cost."""
    rng = np.random.default_rng(5)
    A, b = rng.normal(size=(30, 18)), rng.normal(size=30)  # residuals A x − b of three control points
    to_world = se3.adjoint(se3.exp(rng.normal(size=6)))
    root = np.diag(rng.uniform(0.5, 3.0, size=6))
    found = doubted(Quadratic(4, A.T @ A, -A.T @ b), to_world, root @ root)
    assert found.first == 4

    together = A @ np.tile(to_world, (3, 1))

    def cost(x: np.ndarray) -> float:
        rows, right = np.vstack([together, root]), np.concatenate([b - A @ x, np.zeros(6)])
        offset = np.linalg.lstsq(rows, right, rcond=None)[0]
        return 0.5 * float(np.sum((rows @ offset - right) ** 2))

    for x in rng.normal(size=(5, 18)):
        told = 0.5 * x @ found.H @ x + found.g @ x
        assert told == pytest.approx(cost(x) - cost(np.zeros(18)), rel=1e-9, abs=1e-9)
    # Surely where it is, nothing changes.
    same = doubted(Quadratic(4, A.T @ A, -A.T @ b), to_world, 1e14 * np.eye(6))
    np.testing.assert_allclose(same.H, A.T @ A, atol=1e-8)


def test_a_frame_whose_colours_come_too_late_for_the_spline_is_refined_by_its_depth(run: Path) -> None:
    tracked = load_run(run)
    assert tracked.dataset is not None and tracked.estimate.spline is not None
    known = refining._known_frames(tracked.dataset, tracked.estimate)
    assert len(known) >= FRAMES - 1
    late = replace(tracked.dataset, color_stamps=tracked.dataset.color_stamps + 0.007)
    assert refining._known_frames(late, tracked.estimate) == known
    # Of those colours no line is asked for.
    end = tracked.estimate.info["spline_valid"][-1][1]
    assert refining._is_covered(tracked.estimate, end - 0.02, 0.019)
    assert not refining._is_covered(tracked.estimate, end - 0.02, 0.03)


def run_of(metres: float, off_m: float, common_m: float = 0.0) -> tuple[Estimate, Spline]:
    """A run at rest whose frames are known to `metres`, and what they have in common to `common_m`; and the same spline
    but for every other second, which is `off_m` away."""
    rng = np.random.default_rng(3)
    spline = Spline(np.repeat(np.eye(4)[None], 130, axis=0), 0.0, 0.05)
    stamps = np.arange(0.0, 6.0, 1.0 / 30.0)
    upper = (np.diag(np.repeat([metres**2, 1e-6], 3)))[np.triu_indices(6)].tolist()
    common = np.outer([1, 0, 0, 0, 0, 0], np.sin(np.pi * stamps)).T[:, :, None] * common_m
    frames = [
        {"stamp": t, "covariance": upper, "drift_world": [0.0] * 21, "common": c.tolist()}
        for t, c in zip(stamps, common, strict=True)
    ]  # fmt: skip
    moved = spline.control_points.copy()
    moved[:, 0, 3] = off_m * np.sin(np.pi * (np.arange(130) - 1) * 0.05) + 1e-5 * rng.normal(size=130)
    return Estimate(stamps, spline.pose(stamps), spline, {"frames": frames}), Spline(moved, 0.0, 0.05)


@pytest.mark.parametrize(
    ("metres", "off_m", "common_m", "is_ruled_out"),
    [(1e-3, 1e-3, 0.0, False), (1e-3, 2e-2, 0.0, True), (1e-3, 2e-2, 2e-2, False)],
)
def test_what_a_run_rules_out_is_given_back_unless_the_calibration_explains_it(
    metres: float, off_m: float, common_m: float, is_ruled_out: bool
) -> None:
    why = contradiction(*run_of(metres, off_m, common_m))
    assert bool(why) is is_ruled_out and ("calibrate" in why) is is_ruled_out


@pytest.mark.parametrize(("common_m", "is_outweighed"), [(0.0, False), (1e-3, False), (5e-3, True)])
def test_a_run_whose_camera_may_be_further_off_than_its_noise_is_not_refined(
    common_m: float, is_outweighed: bool, monkeypatch: pytest.MonkeyPatch, run: Path, tmp_path: Path
) -> None:
    why = refining.outweighed(run_of(1e-3, 0.0, common_m)[0])
    assert bool(why) is is_outweighed and ("calibrate" in why) is is_outweighed
    if is_outweighed:
        monkeypatch.setattr(refining, "outweighed", lambda _: why)
        refined = refine_run(run, tmp_path / "refined")
        before = load_run(run).estimate
        np.testing.assert_array_equal(refined.estimate.T_world_depth, before.T_world_depth)
        assert refined.text().startswith(why) and load_run(tmp_path / "refined").estimate.info["refined"]["kept"] == why
