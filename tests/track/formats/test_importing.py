"""Recordings of phones, scanners and our own exports come back; what becomes of the folder; what is no recording."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import recordings
import synthetic
from import_command import CONTENT, check_cameras, check_frames, fake_lzfse, imported, refused
from recordings import COLOR_K, COLOR_SIZE, COUNT

from rsgen.cli.main import main as rsgen
from rsgen.config.sections import ImuConfig
from rsgen.geometry import se3
from rsgen.image_codecs import encode_png
from rstrack import formats
from rstrack.cli.info import describe
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.registration import SharedImages

# --- others ----------------------------------------------------------------------------------------------------------


def check_truth(dataset: Dataset, poses: np.ndarray) -> None:
    assert dataset.truth_poses is not None
    wanted = poses @ dataset.rig.T_color_depth
    assert np.allclose(dataset.truth_poses.T_world_cam, wanted, atol=1e-6)


@pytest.mark.parametrize("stamped", [True, False])
def test_scannets_files_come_back(place: Path, capfd: pytest.CaptureFixture[str], stamped: bool) -> None:
    recordings.write_sens(place / "scene.sens", CONTENT, stamped)
    dataset, said = imported(capfd, "scene.sens")
    check_cameras(dataset, 1e-6)
    assert all((dataset.images.depth(k) == CONTENT.units[k] / np.float32(1000)).all() for k in range(COUNT))
    assert Path("out/rgb/000002.jpg").read_bytes() == recordings.jpeg(CONTENT.colors[2])
    check_truth(dataset, CONTENT.poses[[0, 2, 3, 4]])
    assert "1 of 5 poses" in said and "estimated, not measured: BundleFusion" in describe(dataset)
    gaps = np.diff(dataset.stamps)
    assert np.allclose(gaps, 0.0333667 if stamped else 1 / 30, atol=2e-6) and ("1/30 s" in said) != stamped


def test_record3ds_files_come_back(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_lzfse(monkeypatch)
    recordings.write_r3d(place / "one.r3d", CONTENT)
    dataset, said = imported(capfd, "one.r3d")
    assert not (place.parent / "outside.txt").exists() and not Path("/absolute.txt").exists()
    assert isinstance(dataset.images, SharedImages)
    for k in range(COUNT):
        assert np.allclose(dataset.images.images.depth(k), CONTENT.units[k, :15, :20] / 1000, atol=1e-7)
    check_truth(dataset, CONTENT.poses)
    assert dataset.rig.color_camera.fx == pytest.approx(COLOR_K[0] + 0.2) and "medians" in said
    depth = dataset.rig.depth_camera
    # A ray through the colour image's corner goes through depth's corner, whatever their pixels.
    corner = dataset.rig.color_camera.unproject([-0.5, -0.5])
    assert np.allclose(depth.project(corner)[0], [-0.5, -0.5]) and (depth.width, depth.height) == (20, 15)
    table, own = (np.loadtxt(f"out/{name}.csv", delimiter=",") for name in ("intrinsics", "intrinsics_depth"))
    assert np.allclose(table[:, 1], COLOR_K[0] + 0.1 * np.arange(COUNT)) and table.shape == (COUNT, 5)
    assert np.allclose(own[:, 1], table[:, 1] * depth.width / COLOR_SIZE[0]) and (own[:, 0] == table[:, 0]).all()
    assert "ARKit" in describe(dataset)


def test_record3d_without_its_unpacker_says_what_to_install(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    refused(capfd, str(recordings.write_r3d(place / "one.r3d", CONTENT).name), "LZFSE", "pip install", "pyliblzfse")


@pytest.mark.parametrize("per_frame", [True, False])
def test_stray_scanners_folders_come_back(place: Path, capfd: pytest.CaptureFixture[str], per_frame: bool) -> None:
    recordings.write_stray(place / "scan", CONTENT, per_frame)
    dataset, _ = imported(capfd, "scan")
    check_truth(dataset, CONTENT.poses)
    assert np.allclose(np.diff(dataset.stamps), 1 / 60, atol=1e-8)
    units = CONTENT.units[:, :15, :20]
    images = dataset.images.images if isinstance(dataset.images, SharedImages) else dataset.images
    assert isinstance(dataset.images, SharedImages) == per_frame
    for k in range(COUNT):
        z = images.depth(k)
        sure = (np.arange(20) >= 10)[None]
        assert (z == np.where(sure, units[k], 0) / np.float32(1000)).all()
        assert np.abs(images.color(k).astype(int) - (40 * k + 30)).max() < 6  # the video's own loss
    assert Path("out/intrinsics.csv").exists() == per_frame
    assert np.loadtxt("out/imu.csv", delimiter=",")[0].tolist() == [1e11, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0]
    dataset, _ = imported(capfd, "scan --force --confidence 0")
    images = dataset.images.images if isinstance(dataset.images, SharedImages) else dataset.images
    assert (images.depth(0) == units[0] / np.float32(1000)).all()


def test_an_exported_euroc_folder_comes_back(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = synthetic.make_config(32, 24, color={"readout_s": 0.02}, depth={"readout_s": 0.01, "scan": "bottom-top"})
    imu = ImuConfig(T_imu_depth=recordings.T_IMU_DEPTH.tolist(), accelerometer_range=50.0)
    writer = synthetic.open_writer(place / "seq", config.model_copy(update={"imu": imu}), 4)
    synthetic.write_frames(writer)
    synthetic.write_scene(place / "seq")
    writer.finish()
    assert rsgen(["export", "euroc", "seq"]) == 0
    dataset, said = imported(capfd, "seq")
    exact = open_dataset(Path("seq"))
    assert dataset.rig.color_shutter == exact.rig.color_shutter and dataset.rig.depth_shutter == exact.rig.depth_shutter
    assert dataset.rig.color_camera == exact.rig.color_camera and dataset.rig.depth_camera == exact.rig.depth_camera
    assert np.allclose(dataset.rig.T_color_depth, exact.rig.T_color_depth, atol=1e-12)
    assert "calibrate" not in said and dataset.depth_scale == exact.depth_scale
    assert dataset.imu is not None and exact.imu is not None
    assert np.allclose(dataset.imu.T_imu_depth, exact.imu.T_imu_depth, atol=1e-8)
    assert np.allclose(dataset.imu.accel, exact.imu.accel[-len(dataset.imu.accel) :], atol=1e-9)
    assert dataset.imu.noise.gyro_density == exact.imu.noise.gyro_density
    for k in range(len(exact)):
        assert (dataset.images.depth(k) == exact.images.depth(k)).all()
        assert (dataset.images.color(k) == exact.images.color(k)).all()
    assert dataset.truth_poses is not None and exact.truth is not None
    stamps = dataset.truth_poses.stamps
    epoch = np.round(dataset.stamps[0] - exact.stamps[0])
    inside = (stamps - epoch > exact.truth.t_begin) & (stamps - epoch < exact.truth.t_end)
    T = exact.truth.pose(stamps[inside] - epoch)
    assert inside.sum() > 10
    assert np.abs(se3.log(se3.inverse(T) @ dataset.truth_poses.T_world_cam[inside])).max() < 1e-6
    for name in ("data.csv", "sensor.yaml"):
        (place / "seq/mav0/depth0" / name).unlink()
    (place / "out").rename(place / "before")
    refused(capfd, "seq", "no depth images", "cam0")


def test_an_exported_bag_comes_back_with_its_shutters(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Its first stamp is 0, and counts."""
    config = synthetic.make_config(32, 24, color={"readout_s": 0.02}, depth={"readout_s": 0.01, "scan": "bottom-top"})
    writer = synthetic.open_writer(place / "seq", config, 4)
    synthetic.write_frames(writer)
    synthetic.write_scene(place / "seq")
    writer.finish()
    assert rsgen(["export", "mcap", "seq", "--out", "seq.mcap"]) == 0
    dataset, said = imported(capfd, "seq.mcap")
    exact = open_dataset(Path("seq"))
    assert exact.stamps[0] == 0.0 and dataset.stamps == pytest.approx(exact.stamps, abs=1e-9)
    assert dataset.rig.color_shutter == exact.rig.color_shutter and dataset.rig.depth_shutter == exact.rig.depth_shutter
    assert "calibrate" not in said and np.allclose(dataset.rig.T_color_depth, exact.rig.T_color_depth, atol=1e-9)
    for k in range(len(exact)):
        assert (dataset.images.depth(k) == exact.images.depth(k)).all()
        assert (dataset.images.color(k) == exact.images.color(k)).all()


# --- the folder ------------------------------------------------------------------------------------------------------


def test_a_folder_is_replaced_only_if_it_was_imported(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recordings.write_realsense(place / "rs.bag", CONTENT)
    (place / "out").mkdir()
    imported(capfd, "rs.bag")  # an empty one will do
    refused(capfd, "rs.bag", "--force")
    (place / "out/rgb/000000.png").write_bytes(b"damaged")
    check_frames(imported(capfd, "rs.bag --force")[0])
    (place / "out/import.json").unlink()
    refused(capfd, "rs.bag --force", "import.json")
    assert (place / "out/camera.yaml").exists()


def test_a_failed_import_leaves_the_folder_before_it(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recordings.write_sens(place / "scene.sens", CONTENT)
    imported(capfd, "scene.sens")
    before = {path: path.read_bytes() for path in sorted((place / "out").rglob("*")) if path.is_file()}
    data = bytearray((place / "scene.sens").read_bytes())
    data[-200:] = bytes(200)
    (place / "scene.sens").write_bytes(data)
    refused(capfd, "scene.sens --force", "frame 4", "damaged")
    assert before == {path: path.read_bytes() for path in sorted((place / "out").rglob("*")) if path.is_file()}


def test_what_is_no_recording_is_said_to_be_none(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (place / "empty").mkdir()
    (place / "none.bag").touch()
    (place / "text.bag").write_text("<!DOCTYPE html>")
    for name, said in (("nowhere", "no such"), ("empty", "known format"), ("none.bag", "empty"), ("text.bag", "known")):
        refused(capfd, name, said)
    recordings.write_realsense(place / "rs.bag", CONTENT)
    refused(capfd, "rs.bag --device nothing", "realsense-d435")


def test_the_reader_of_the_document_is_one_module_and_one_line(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """docs/adding-a-format.md: its module runs by its line in the registry."""
    text = (Path(__file__).parents[3] / "docs/adding-a-format.md").read_text().partition("## A recording")[2]
    code, line = re.findall(r"^```python\n(.*?)^```$", text, flags=re.M | re.S)
    module = ModuleType("rstrack.formats.frames_csv")
    exec(code, module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(formats, "READERS", dict(formats.READERS))
    exec(line, formats.__dict__)
    folder = place / "mine"
    folder.mkdir()
    (folder / "camera.txt").write_text(" ".join(map(str, (*recordings.DEPTH_SIZE, *recordings.DEPTH_K))))
    width, height = recordings.DEPTH_SIZE
    for k, units in enumerate(CONTENT.units):
        (folder / f"d{k}.png").write_bytes(encode_png(units))
        (folder / f"c{k}.png").write_bytes(encode_png(np.full((height, width, 3), k, np.uint8)))
    rows = [f"{ns},c{k}.png,d{k}.png" for k, ns in enumerate(CONTENT.depth_ns)]
    (folder / "frames.csv").write_text("\n".join(rows))
    dataset, said = imported(capfd, "mine")
    assert "folder of frames.csv" in said and dataset.rig.is_registered and len(dataset) == COUNT
    assert all((dataset.images.depth(k) == CONTENT.units[k] / np.float32(1000)).all() for k in range(COUNT))
    (folder / "frames.csv").write_text("now,c0.png,d0.png")
    refused(capfd, "mine --force", "expected", "frames.csv")


def test_metadata_of_any_shape(place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    fake_lzfse(monkeypatch)
    for change in (
        {"K": None}, {"K": [1] * 8}, {"poses": [[1]]}, {"poses": "x"}, {"frameTimestamps": ["x"] * 5},
        {"perFrameIntrinsicCoeffs": [[1e400] * 4] * 5}, {"dw": 10**9, "dh": 10**9}, {"dw": -1},
        {"fps": 0, "frameTimestamps": []},
        {"frameTimestamps": [1e300] * 5}, {"K": [0.0] * 9, "perFrameIntrinsicCoeffs": []},
    ):  # fmt: skip
        recordings.write_r3d(place / "one.r3d", CONTENT, **change)
        refused(capfd, "one.r3d", "one.r3d")
    # Poses that are none are no truth, and no reason to refuse the rest.
    odd = [[float("nan")] * 7, [0] * 7, [2, 0, 0, 0, 1, 1, 1], [0, 0, 0, 1, 1e300, 0, 0], [0, 0, 0, 1, 0, 0, 0]]
    recordings.write_r3d(place / "one.r3d", CONTENT, poses=odd)
    assert len(imported(capfd, "one.r3d")[0]) == COUNT
