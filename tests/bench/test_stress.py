"""The blur stress test on a small analytic scene: sequences, scores, gain of blur-aware weights, what is written."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
import yaml
from scipy.ndimage import gaussian_filter

import rstrack.bench.measures.track
from rsgen.config.config import Config, load_config
from rsgen.console.command_line import parse_frames
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import fit_spline
from rsgen.produce.writer import SequenceWriter
from rsgen.sequence.format import stream_stamps
from rsgen.sequence.trajectory import read_trajectory
from rsgen.srgb import encode
from rstrack.bench.experiments.stress import (
    PATHS,
    StressOptions,
    StressResult,
    case_name,
    read_stress,
    stress_benchmark,
    stress_result,
)
from rstrack.bench.experiments.stress_results import draw_stress, write_stress
from rstrack.bench.measures import blur
from rstrack.bench.measures.blur import gradient_energy, psnr_db, ssim
from rstrack.bench.record import CellRecord
from rstrack.bench.runner import run_cells
from rstrack.bench.task import Sources
from rstrack.cli.main import main
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import Estimate

WIDTH, HEIGHT, FOCAL, FRAMES, SUBTIMES = 96, 72, 150.0, 18, 8
# Waves per metre: about seven pixels long on the far wall.
WAVES = np.array([[6.0, 3.0, 2.0], [-4.0, 6.0, -3.0], [2.0, -2.0, 6.0]])
T_EST_WORLD = se3.exp(np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.3]))


def shaken() -> Spline:
    """A camera whose shake comes and goes: up to 1.5 rad/s, and nearly at rest in between."""
    dt, t0 = 0.05, -0.2
    t = t0 + dt * (np.arange(40) - 1.0)
    turn = 0.12 * np.sin(2 * np.pi * 1.7 * t)
    xi = np.stack([0.05 * t, 0.02 * np.sin(5 * t), 0.05 * t, 0.5 * turn, turn, 0.1 * turn], axis=-1)
    return Spline(se3.exp(xi), t0, dt)


def light(p_world: np.ndarray) -> np.ndarray:
    """A texture of a few pixels' wavelength, linear RGB."""
    waves = np.sin(2.0 * np.pi * p_world @ WAVES)
    return np.asarray(0.4 + 0.17 * (waves + waves[..., [1, 2, 0]]))


def look(spline: Spline, config: Config, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Light (h, w, 3) and depth (h, w) of an image whose rows are taken at `times` (h,) in s."""
    camera = config.color.camera
    T = spline.pose(times)[:, None]
    d = np.einsum("...ij,...j->...i", T[..., :3, :3], camera.unproject(camera.pixel_grid()))
    p = np.broadcast_to(T[..., :3, 3], d.shape)
    z = synthetic.cast(p, d)
    return light(p + z[..., None] * d), z


def srgb(image: np.ndarray) -> np.ndarray:
    return np.rint(255.0 * encode(np.clip(image, 0.0, 1.0))).astype(np.uint8)


def write_config(path: Path, **depth: Any) -> Path:
    camera = {"width": WIDTH, "height": HEIGHT, "intrinsics": [FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2]}
    camera |= {"rate_hz": 30, "readout_s": 0.028}
    text = {
        "name": "tiny", "trajectory": {"file": "motion.txt"}, "scene": {"file": "box.ply"}, "color": camera,
        "depth": {**camera, "offset_s": 0.02, "noise": {"model": "gaussian"}, **depth},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(text))
    return path


def render(words: Sequence[str]) -> None:
    """What `rsgen render` does, of the box and the ball, with blur and with noise of depth."""
    assert words[0] == "render"
    config_file, rest = Path(words[1]), list(words[2:])
    rest.remove("--quiet")
    flags = {name.removeprefix("--"): value for name, value in zip(rest[::2], rest[1::2], strict=True)}
    out, frames = Path(flags.pop("out")), parse_frames(flags.pop("frames", None))
    config = load_config(config_file, flags)
    spline = shaken()
    if config.trajectory.file is not None and config.trajectory.file.exists():
        spline = fit_spline(read_trajectory(config.trajectory.file), config.trajectory.knot_spacing_s).spline
    stamps = [stream_stamps(0.0, 1.2, stream)[frames] for stream in (config.color, config.depth)]
    both = {"color": stamps[0], "depth": stamps[1]}
    writer = SequenceWriter.open(out, config, spline, both, {"synthetic": "1"}, {"scene": "box"})
    shutter, exposure = config.color.shutter, config.color.exposure_s
    rows = np.arange(HEIGHT)
    for k in writer.missing("color"):
        middle = shutter.line_mid_time(float(stamps[0][k]), rows, config.color.camera)
        ends = (np.arange(SUBTIMES) + 0.5) / SUBTIMES - 0.5 if exposure else np.zeros(1)
        image = np.mean([look(spline, config, middle + exposure * part)[0] for part in ends], axis=0)
        truth = {}
        if config.truth.global_shutter:
            truth["global_middle"] = srgb(look(spline, config, np.full(HEIGHT, middle.mean()))[0])
        writer.write_color(k, srgb(image), truth)
    for k in writer.missing("depth"):
        z = look(spline, config, config.depth.shutter.line_mid_time(float(stamps[1][k]), rows, config.depth.camera))[1]
        noise = 1.2e-3 * z**2 * np.random.default_rng([7, k]).standard_normal(z.shape)
        writer.write_depth(k, z.astype(np.float32), (z + noise).astype(np.float32))
    writer.finish()


def told_truth(dataset: Any, options: Any, out: Path, *_: Any) -> Any:
    """A tracker that finds the truth, in a world of its own, but for an error of a tenth of the exposure it is told."""
    spline = dataset.truth
    moved = Spline(T_EST_WORLD @ spline.control_points, spline.t0, spline.dt)
    T = moved.pose(dataset.stamps)
    T[::2, 0, 3] += 0.1 * dataset.rig.color_shutter.exposure_s
    info = {"keyframes": 1, "timings": {"frame_ms": [1.0], "start_s": 0.0, "total_s": 1.0}}
    estimate = Estimate(dataset.stamps, T, None if options.blur_sigma_px else moved, info)
    return SimpleNamespace(estimate=estimate, end="done", unreadable=())


def run_stress(config: Path, out: Path, options: StressOptions) -> tuple[CellRecord, ...]:
    sources = Sources(cache=out, render=render)
    return tuple(run_cells(stress_benchmark(config, sources, options), out, sources).records.values())


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[CellRecord, ...]]:
    out = tmp_path_factory.mktemp("stress")
    config = write_config(out / "tiny.yaml")
    options = StressOptions(exposures_s=(0.0, 0.02), speeds=(), sigmas_px=(1.0, 2.0), frames=FRAMES)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rstrack.bench.measures.track, "track", told_truth)
        return out / "made", run_stress(config, out / "made", options)


@pytest.fixture(scope="module")
def stressed(records: tuple[Path, tuple[CellRecord, ...]]) -> tuple[Path, StressResult]:
    return records[0], stress_result(records[1])


def test_blur_aware_colour_is_better_by_two_decibels(stressed: tuple[Path, StressResult]) -> None:
    _, report = stressed
    sharp, blurred = report.fused("true")
    assert [(cell.case, cell.sigmas_px) for cell in report.fused("true")] == [
        ("exposure_0ms", (None, 1.0, 2.0)),
        ("exposure_20ms", (None, 1.0, 2.0)),
    ]
    assert sharp.gain_db("true", 1.0) == 0.0  # nothing is blurred: all weights are 1
    gain = blurred.gain_db("true", 1.0)
    assert gain is not None and gain > 2.0 and blurred.gain_db("true", None) is None
    found = blurred.figures
    assert found["gradient_true_constant"] < found["gradient_true_sigma1"] < 1.0
    assert found["ssim_true_constant"] < found["ssim_true_sigma1"]
    assert sharp.figures["psnr_db_true_constant"] > found["psnr_db_true_sigma1"]
    counts = {cell.figures[f"keyframes_{poses}"] for cell in (sharp, blurred) for poses in PATHS}
    assert len(counts) == 1 and min(counts) >= 1


def test_fused_depth_has_half_the_error_of_a_frames(stressed: tuple[Path, StressResult]) -> None:
    _, report = stressed
    for cell in report.fused("true"):
        for poses in PATHS:
            assert cell.figures[f"fused_mm_{poses}"] < 0.5 * cell.figures[f"single_mm_{poses}"]
            # σ = 1.2e-3 z² with walls at 1.5 to 3 m, rectified by bilinear interpolation, which averages a little.
            assert 1.5 < cell.figures[f"single_mm_{poses}"] < 8.0


def test_scores_do_not_depend_on_the_world(stressed: tuple[Path, StressResult]) -> None:
    _, report = stressed
    assert report.fused("true") == report.fused("estimated")
    for cell in report.fused("true"):
        for weights in ("constant", "sigma1", "sigma2"):
            for name, tolerance in (("psnr_db", 0.02), ("psnr_db_least", 0.05), ("ssim", 2e-3), ("gradient", 2e-3)):
                true, found = (cell.figures[f"{name}_{poses}_{weights}"] for poses in PATHS)
                assert found == pytest.approx(true, abs=tolerance)


def test_tracking_is_compared_with_poses_at_the_end_of_exposure(stressed: tuple[Path, StressResult]) -> None:
    _, report = stressed
    assert [(cell.case, cell.variant, cell.figures["lost"]) for cell in report.cells] == [
        ("exposure_0ms", "mid-exposure", 0),
        ("exposure_20ms", "mid-exposure", 0),
        ("exposure_20ms", "mid-exposure, blur weight", 0),
        ("exposure_20ms", "end of exposure", 0),
    ]
    found = [cell.figures["ate_mm"] for cell in report.cells]
    # An error of a tenth of the exposure that the tracker is told, in every second pose.
    assert found == pytest.approx([0.0, 1.0, 1.0, 0.0], abs=0.05)


def test_exposures_differ_in_blur_only(stressed: tuple[Path, StressResult]) -> None:
    out, _ = stressed
    sharp, blurred = (open_dataset(next((out / "sequences").glob(f"tiny-exposure_{ms}ms-*[!n]"))) for ms in (0, 20))
    np.testing.assert_allclose(*(one.sequence.rows("color") for one in (sharp, blurred)), atol=1e-9)
    assert np.array_equal(sharp.images.depth(5), blurred.images.depth(5))
    assert not np.array_equal(sharp.images.color(5), blurred.images.color(5))


def test_what_is_written_can_be_read_again(records: tuple[Path, tuple[CellRecord, ...]]) -> None:
    out, found = records
    report, text = write_stress(found, out)
    draw_stress(report, out)
    names = ("stress.txt", "stress.md", "stress.csv", "stress.json", "stress.png", "panels.png")
    assert all((out / name).stat().st_size > 0 for name in names)
    read = read_stress(out)
    assert [cell.case for cell in read.cells] == [cell.case for cell in report.cells] and len(read.cells) == 4
    rows = list(csv.DictReader((out / "stress.csv").open()))
    psnr = [cell.figures["psnr_db_true_sigma1"] for cell in read.fused("true")]
    assert [float(row["psnr_db_true_sigma1"]) for row in rows[:2]] == pytest.approx(psnr, rel=1e-5)
    assert rows[2]["psnr_db_true_sigma1"] == "" and float(rows[2]["ate_mm"]) > 0.9
    gain = report.fused("true")[1].gain_db("true", 1.0)
    assert f"{gain:+.2f}" in text and "nan" not in text and text == (out / "stress.txt").read_text()[:-1]
    assert read.pictured is not None and read.pictured.case == "exposure_20ms" and read.panels is not None
    panels = blur.read_panels(out / read.panels)
    assert panels is not None and 0.0 < panels.white <= 1.0 and len(panels.images(out / read.panels)) == 5


def test_a_faster_sequence_takes_the_same_path(tmp_path: Path) -> None:
    config, asked = write_config(tmp_path / "tiny.yaml"), []

    def record(words: Sequence[str]) -> None:
        asked.append(list(words))
        if "--out" in words:
            folder = Path(words[words.index("--out") + 1])
            folder.mkdir(parents=True, exist_ok=True)
            shaken().save(folder / "spline.npz")

    options = StressOptions(exposures_s=(0.0,), speeds=(2.0,), frames=20)
    sources = Sources(cache=tmp_path / "out", render=record)
    cells = {cell.case: cell for cell in stress_benchmark(config, sources, options).cells}
    assert list(cells) == ["exposure_0ms", "exposure_20ms_speed_2x", "exposure_20ms_speed_2x_told_sharp"]
    record(sources.words(cells["exposure_20ms_speed_2x"].sequence))
    fast = load_config(Path(asked[1][1]))
    assert fast.trajectory.file is not None and fast.scene.file == (tmp_path / "box.ply").resolve()
    spline = fit_spline(read_trajectory(fast.trajectory.file), fast.trajectory.knot_spacing_s).spline
    slow = shaken()
    for part in (0.1, 0.33, 0.5, 0.9):
        want = slow.pose(slow.t_begin + part * (slow.t_end - slow.t_begin))
        found = spline.pose(spline.t_begin + part * (spline.t_end - spline.t_begin))
        np.testing.assert_allclose(found, want, atol=2e-6)
    assert spline.t_end - spline.t_begin == pytest.approx(0.5 * (slow.t_end - slow.t_begin))
    # Both carry the truth of their speed, and half the frames are as long a way.
    assert all('["middle"]' in words for words in asked)
    assert ["0:20" in asked[0], "0:10" in asked[1]] == [True, True]
    assert "--color.offset_s 0.03" in " ".join(asked[1]) and "--color.exposure_s 0.02" in " ".join(asked[1])


@pytest.mark.parametrize(
    ("change", "complaint"),
    [({"intrinsics": [140.0, 140.0, 47.5, 35.5]}, "same pinhole"), ({"readout_s": 0.02}, "same readout_s")],
)
def test_what_cannot_be_compared_is_refused(tmp_path: Path, change: dict[str, Any], complaint: str) -> None:
    config = write_config(tmp_path / "tiny.yaml", **change)
    options = StressOptions(exposures_s=(0.0,), speeds=(), frames=2)
    (record,) = run_stress(config, tmp_path / "out", options)
    assert record.error is not None and complaint in record.error
    assert stress_result([record]).failed == [f"Failed ({record.error}): blur/exposure_0ms/rs-pg."]


@pytest.mark.parametrize(
    "wrong",
    [{"exposures_s": ()}, {"exposures_s": (-1.0,)}, {"sigmas_px": (0.0,)}, {"speeds": (np.nan,)}, {"frames": 1}],
)
def test_absurd_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"^stress: [^\n]*$"):
        StressOptions(**wrong)


def test_a_failing_render_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "wrong.yaml").write_text("name: wrong\nscene: {}\nmotion: {}\n")
    assert main(["bench", str(tmp_path / "wrong.yaml"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("rstrack: rsgen render ") and "wrong.yaml failed: " in said


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("rstrack.bench.task.run_rsgen", render)
    monkeypatch.setattr(rstrack.bench.measures.track, "track", told_truth)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    config = write_config(tmp_path / "tiny.yaml")
    words = ["bench", str(config), "--frames", "0:8", "--exposure", "0", "--method", "rs-pg", "--quiet"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert said.err == "" and "20 ms, 4× speed" in said.out and "end of exposure" in said.out
    assert len(read_stress(tmp_path / "out").cells) == 1 + 2 * 3


def test_an_interrupt_before_anything_is_done(tmp_path: Path) -> None:
    assert write_stress([], tmp_path)[0].cells == ()
    with pytest.raises(UserError, match="holds no records"):
        read_stress(tmp_path)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--sequence", "a"], "--sequence: is not for a stress test"), (["--frames", "5:20"], "begins with frame 0"),
        (["--method", "rs-pg", "gs-pg"], "one method"), (["--method", "kiss-icp"], "one method"),
        (["--exposure", "2"], "between 0 and 1 s"), (["--width", "3"], "width 3"), (["--seeds", "2"], "--seeds"),
    ],
)  # fmt: skip
def test_wrong_words_are_refused(words: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "stress", *words]) == 2
    said = capsys.readouterr().err
    assert told in said and len(said.splitlines()) == 1


def test_cases_are_named_and_sorted() -> None:
    options = StressOptions(exposures_s=(0.02, 0.0), speeds=(4.0, 1.0, 2.0))
    assert options.cases == ((1.0, 0.0), (1.0, 0.02), (2.0, 0.02), (4.0, 0.02))
    assert case_name(2.5, 0.0125) == "exposure_12.5ms_speed_2.5x"


def test_image_scores_against_numpy_and_scipy() -> None:
    rng = np.random.default_rng(3)
    truth = rng.integers(0, 256, (40, 50, 3)).astype(np.uint8)
    image = np.clip(truth + rng.normal(0, 20, truth.shape), 0, 255).astype(np.uint8)
    known = np.ones((40, 50), bool)
    known[:, :6] = False
    assert psnr_db(truth, truth, known) == np.inf and ssim(truth, truth, known) == pytest.approx(1.0)
    damaged = image.copy()
    damaged[:, :6] = 0
    assert psnr_db(damaged, truth, known) == psnr_db(image, truth, known)
    assert ssim(damaged, truth, known) == pytest.approx(ssim(image, truth, known), abs=1e-12)
    mse = np.mean((image[:, 6:].astype(float) - truth[:, 6:]) ** 2)
    assert psnr_db(image, truth, known) == pytest.approx(20 * np.log10(255 / np.sqrt(mse)))

    def blur(a: np.ndarray) -> np.ndarray:
        return np.asarray(gaussian_filter(a, 1.5, truncate=5 / 1.5))

    a, b = (i.astype(float) @ np.array([0.299, 0.587, 0.114]) for i in (image, truth))
    numerator = (2 * blur(a) * blur(b) + 6.5025) * (2 * (blur(a * b) - blur(a) * blur(b)) + 58.5225)
    spread = blur(a * a) - blur(a) ** 2 + blur(b * b) - blur(b) ** 2
    want = numerator / ((blur(a) ** 2 + blur(b) ** 2 + 6.5025) * (spread + 58.5225))
    assert ssim(image, truth, known) == pytest.approx(want[5:-5, 11:-5].mean(), rel=1e-9)

    ramp = np.repeat(np.arange(50, dtype=np.uint8)[None, :, None] * 3, 40, axis=0).repeat(3, axis=2)
    assert gradient_energy(ramp, known) == pytest.approx(9.0)
