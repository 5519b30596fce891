"""Training packs: what is drawn, flow and masks against the images themselves, resuming, files as loaders want them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny import write_config

from rsgen.cli.main import main
from rsgen.config.config import Config, load_config
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.motion.stretch import Drawn, along, draw_stretch
from rsgen.pack.draw import PackOptions
from rsgen.pack.make import flo_bytes, mark_file, pdepth_text
from rsgen.produce.parts import load_motion

SPAN = [(2.0, 12.0), (0.0, 1.0)]


def spline() -> Spline:
    rng = np.random.default_rng(3)
    return Spline(se3.exp(np.cumsum(rng.normal(0.0, 0.05, (40, 6)), axis=0)), -0.2, 0.05)


def test_a_draw_depends_on_seed_and_index_alone_and_keeps_to_its_ranges() -> None:
    options = PackOptions(count=300, length=5, readout=(0.01, 0.03), exposure=(0.002, 0.004), speed=(0.5, 2.0))
    drawn = [draw_stretch(options.ranges, 7, k, SPAN, (30.0, 15.0)) for k in range(300)]
    assert drawn[41] == draw_stretch(replace(options, count=42).ranges, 7, 41, SPAN, (30.0, 15.0))
    assert drawn[41] != draw_stretch(options.ranges, 8, 41, SPAN, (30.0, 15.0))
    assert {d.config for d in drawn} == {0, 1}
    for d in drawn:
        begin, end = SPAN[d.config]
        last = d.start_s + d.speed * (4 / (30.0, 15.0)[d.config] + d.readout_s)
        assert begin <= d.start_s - d.speed * d.exposure_s + 1e-12 and last <= end + 1e-12
        assert 0.01 <= d.readout_s <= 0.03 and 0.002 <= d.exposure_s <= 0.004
        assert abs(np.degrees(d.turn[1])) <= 20.0 and abs(np.degrees(d.turn[0])) <= 20.0 / 3
    speeds = np.array([d.speed for d in drawn if d.config == 0])
    assert 0.5 <= speeds.min() < 0.55 and 1.85 < speeds.max() <= 2.0
    assert 0.3 < (speeds < 1.0).mean() < 0.7  # by ratio: half of them are slower than the config's


def test_the_cameras_curve_is_the_bodys_faster_turned_and_from_the_lens() -> None:
    body, T_depth_color = spline(), se3.exp(np.array([0.02, 0.01, -0.03, 0.1, 0.0, 0.2]))
    drawn = Drawn(0, 0.02, 0.0, 0.4, 2.5, (0.1, -0.3, 0.05), 1)
    camera = along(body, drawn.start_s, drawn.speed, drawn.turn, T_depth_color)
    t = np.linspace(0.0, 0.25, 7)
    T_turn = np.eye(4)
    T_turn[:3, :3] = so3.exp(np.array(drawn.turn))
    np.testing.assert_allclose(camera.pose(t), body.pose(0.4 + 2.5 * t) @ T_depth_color @ T_turn, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"readout": (0.03, 0.01)}, "--readout 0.03 0.01"), ({"length": 1}, "--length 1"), ({"count": 0}, "--count 0"),
        ({"speed": (0.0, 1.0)}, "--speed 0 1"), ({"turn_deg": 181.0}, "--turn-deg"),
        ({"exposure": (0.1,)}, "--exposure"),
    ],
)  # fmt: skip
def test_ranges_that_are_none_are_refused(change: dict[str, object], told: str) -> None:
    with pytest.raises(UserError, match=told):
        PackOptions(**change)  # type: ignore[arg-type]


def test_motions_too_short_and_readouts_too_long_are_refused() -> None:
    with pytest.raises(UserError, match=r"motion lasts 0\.01 s"):
        draw_stretch(PackOptions().ranges, 0, 0, [(0.0, 0.01)], [30.0])
    with pytest.raises(UserError, match=r"longer than the 0\.01667 s between frames"):
        draw_stretch(PackOptions().ranges, 0, 0, [(0.0, 10.0)], [60.0])


def test_flow_files_are_middleburys() -> None:
    flow = np.arange(24, dtype=np.float32).reshape(3, 4, 2)
    data = flo_bytes(flow)
    assert data[:4] == b"PIEH" and np.frombuffer(data[4:12], "<i4").tolist() == [4, 3]
    np.testing.assert_array_equal(np.frombuffer(data[12:], "<f4").reshape(3, 4, 2), flow)


def test_depth_is_text_that_numpy_reads() -> None:
    rng = np.random.default_rng(0)
    z = (10 ** rng.uniform(-4, 4, (30, 40))).astype(np.float32)
    z[0, :4] = (0.0, np.inf, np.nan, -1.0)
    read = np.loadtxt(pdepth_text(z).decode().splitlines())
    expected = np.where(np.isfinite(z) & (z > 0), z, 0).astype(float)
    assert read.shape == z.shape and np.abs(read - expected).max() <= 0.5001e-4


def test_the_velocity_log_is_one_line_of_six_numbers() -> None:
    drawn = Drawn(0, 0.02, 0.0, 0.0, 1.0, (0.0, 0.0, 0.0), 0)
    name, text = mark_file("carla-rs", drawn, np.arange(6.0), 30.0)
    lines = [line for line in text.decode().splitlines() if "#" not in line]
    assert name == "gt_vel.log" and [float(v) for v in lines[0].split(" ")] == [0, 1, 2, 3, 4, 5] and len(lines) == 1
    assert mark_file("fastec-rs", drawn, np.arange(6.0), 30.0)[0] == "meta.log"


# -- rendered ---------------------------------------------------------------------------------------------------------

OPTIONS = ("--length", "2", "--readout", "0.03", "0.03", "--speed", "8", "8", "--color.spp", "16", "--truth.spp", "16")


@pytest.fixture(scope="module")
def small_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_config(
        tmp_path_factory.mktemp("config"),
        frames=31,
        color={"width": 96, "height": 72, "intrinsics": [72.0, 72.0, 47.5, 35.5]},
    )


@pytest.fixture(scope="module")
def packed(small_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("packs") / "pack"
    assert main(["pack", str(small_config), "--count", "3", "--out", str(out), "--quiet", *OPTIONS]) == 0
    return out


def drawn_in(folder: Path, config: Config) -> tuple[Drawn, Spline]:
    """What was drawn for a sequence, and its camera's curve."""
    about = json.loads((folder / "sequence.json").read_text())
    names = ("readout_s", "exposure_s", "start_s", "speed", "seed")
    drawn = Drawn(config=0, turn=tuple(about["turn"]), **{name: about[name] for name in names})
    T_depth_color = se3.inverse(np.array(config.T_color_depth, float))
    return drawn, along(load_motion(config).spline, drawn.start_s, drawn.speed, drawn.turn, T_depth_color)


def read_flow(path: Path) -> np.ndarray:
    data = path.read_bytes()
    width, height = np.frombuffer(data[4:12], "<i4")
    return np.frombuffer(data[12:], "<f4").reshape(height, width, 2)


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    return float(10 * np.log10(255.0**2 / np.mean((a.astype(float) - b)[mask] ** 2)))


def test_a_pack_holds_whole_sequences_with_all_their_files(packed: Path) -> None:
    assert sorted(path.name for path in packed.iterdir()) == ["000000", "000001", "pack.yaml"]
    kinds = ("rs.png", "gs_f.png", "gs_m.png", "mask.png", "mask_m.png", "flow_mask.png", "flow_mask_m.png")
    names = {f"{k:04d}_{kind}" for k in (0, 1) for kind in kinds} | {
        f"{k:04d}{m}.flow" for k in (0, 1) for m in ("", "_m")
    }
    found = {path.name for path in (packed / "000001").iterdir()}
    assert found == names | {"gt_vel.log", "imu.csv", "sequence.json"}


@pytest.mark.parametrize(("suffix", "image"), [("", "gs_f"), ("_m", "gs_m")])
def test_the_global_image_moved_by_the_flow_is_the_rolling_one(packed: Path, suffix: str, image: str) -> None:
    for k in range(2):
        folder = packed / f"{k:06d}"
        rolling, still = (cv2.imread(str(folder / f"0001_{name}.png")) for name in ("rs", image))
        flow = read_flow(folder / f"0001{suffix}.flow")
        valid = cv2.imread(str(folder / f"0001_flow_mask{suffix}.png"), cv2.IMREAD_UNCHANGED) == 255
        rows, columns = np.mgrid[: valid.shape[0], : valid.shape[1]].astype(np.float32)
        moved = cv2.remap(still, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR)
        assert valid.mean() > 0.5 and np.abs(flow[valid]).max() > 1.0
        assert psnr(moved, rolling, valid) > psnr(still, rolling, valid) + 4.0


def test_masks_say_which_global_pixels_the_rolling_image_holds(packed: Path) -> None:
    """Pixels that the flow lands on are those of the mask, but for its edges."""
    folder = packed / "000000"
    flow, valid = read_flow(folder / "0001.flow"), cv2.imread(str(folder / "0001_flow_mask.png"), -1) == 255
    mask = cv2.imread(str(folder / "0001_mask.png"), -1)
    assert mask.dtype == np.uint8 and set(np.unique(mask)) <= {0, 255}
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    to = np.rint(np.stack([columns, rows], axis=-1)[valid] + flow[valid]).astype(int)
    landed = np.zeros(mask.shape, bool)
    landed[to[:, 1].clip(0, mask.shape[0] - 1), to[:, 0].clip(0, mask.shape[1] - 1)] = True
    landed = cv2.morphologyEx(landed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    assert (landed != (mask == 255)).mean() < 0.06


def test_the_gyroscope_reads_what_the_camera_turned(packed: Path, small_config: Path) -> None:
    table = np.loadtxt(packed / "000000/imu.csv", delimiter=",", comments="#")
    _, camera = drawn_in(packed / "000000", load_config(small_config))
    R = camera.pose(1e-9 * table[[0, -1], 0])[:, :3, :3]
    whole = np.eye(3)
    for rate in table[:-1, 1:4] / 2 + table[1:, 1:4] / 2:
        whole = whole @ so3.exp(rate * 1e-3)
    np.testing.assert_allclose(so3.log(R[0].T @ R[1]), so3.log(whole), atol=2e-5)


def test_a_pack_goes_on_where_it_ended_to_the_same_bytes(packed: Path, small_config: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    words = ["pack", str(small_config), "--out", str(again), "--quiet", *OPTIONS]
    assert main([*words, "--count", "2"]) == 0
    kept = (again / "000000/0000_rs.png").stat().st_mtime_ns
    assert main([*words, "--count", "4"]) == 0
    assert (again / "000000/0000_rs.png").stat().st_mtime_ns == kept
    for path in sorted(packed.rglob("*.*")):
        assert path.read_bytes() == (again / path.relative_to(packed)).read_bytes(), path.name


def test_another_pack_or_folder_is_not_written_into(
    packed: Path, small_config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(packed.rglob("*"))
    assert main(["pack", str(small_config), "--out", str(packed), "--quiet", *OPTIONS, "--seed", "5"]) == 2
    assert "holds another pack" in capsys.readouterr().err and sorted(packed.rglob("*")) == before
    (tmp_path / "x.txt").write_text("mine")
    assert main(["pack", str(small_config), "--out", str(tmp_path), "--quiet", *OPTIONS]) == 2
    told = capsys.readouterr().err
    assert "holds other files" in told and len(told.splitlines()) == 1


def test_depth_puts_points_where_the_flow_does(packed: Path, small_config: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep"
    words = ["pack", str(small_config), "--count", "2", "--out", str(out), "--quiet", "--depth", *OPTIONS]
    assert main(words) == 0
    folder = out / "000000"
    extra = {path.name for path in folder.iterdir()} - {path.name for path in (packed / "000000").iterdir()}
    assert extra == {"0000_rs.pdepth", "0001_rs.pdepth"}
    assert (folder / "0001_rs.png").read_bytes() == (packed / "000000/0001_rs.png").read_bytes()

    config = load_config(small_config)
    drawn, spline = drawn_in(folder, config)
    color = config.color.model_copy(update={"readout_s": drawn.readout_s, "exposure_s": drawn.exposure_s})
    camera, shutter, stamp = color.camera, color.shutter, 1 / color.rate_hz
    uv, z = camera.pixel_grid(), np.loadtxt(folder / "0001_rs.pdepth")
    T = spline.pose(shutter.line_mid_time(stamp, shutter.line_of_pixel(uv, camera), camera))
    p_world = se3.transform(T, camera.backproject(uv, z))
    first = spline.pose(float(shutter.line_mid_time(stamp, 0.0, camera)))
    at, _ = camera.project(se3.transform(se3.inverse(first), p_world))
    valid = cv2.imread(str(folder / "0001_flow_mask.png"), cv2.IMREAD_UNCHANGED) == 255
    off = np.abs(at - uv - read_flow(folder / "0001.flow"))[valid & (z > 0)]
    assert valid.mean() > 0.5 and np.abs((at - uv)[valid]).max() > 1.0 and off.max() < 0.02
