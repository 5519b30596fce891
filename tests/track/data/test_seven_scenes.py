"""The layout of 7-Scenes: what is read, what is assumed and said, and one line or a frame left out for each fault."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.cli.info import describe
from rstrack.cli.main import main
from rstrack.data.dataset import open_dataset

WIDTH, HEIGHT, COUNT = 32, 24, 5
CAMERA = {"color": {"width": WIDTH, "height": HEIGHT, "intrinsics": [24.0, 25.0, 15.5, 11.5], "readout_s": 0.028}}


def units(k: int) -> np.ndarray:
    z = np.random.default_rng(k).integers(0, 5000, (HEIGHT, WIDTH), dtype=np.uint16)
    z[0, :3] = (65535, 0, 65534)
    return z


def pixels(k: int) -> np.ndarray:
    return np.random.default_rng([1, k]).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def pose(k: int) -> np.ndarray:
    return se3.exp(0.1 * k * np.array([1.0, -2.0, 0.5, 0.3, 0.2, -0.4]))


def make(root: Path, camera: bool = True, color: str = "png") -> Path:
    root.mkdir()
    for k in range(COUNT):
        cv2.imwrite(str(root / f"frame-{k:06d}.color.{color}"), pixels(k)[..., ::-1])
        cv2.imwrite(str(root / f"frame-{k:06d}.depth.png"), units(k))
        np.savetxt(root / f"frame-{k:06d}.pose.txt", pose(k), delimiter="\t ")
    if camera:
        (root / "camera.yaml").write_text(yaml.safe_dump(CAMERA))
    return root


def test_images_poses_and_numbers_become_frames(tmp_path: Path) -> None:
    dataset = open_dataset(make(tmp_path / "seq-01"))
    assert dataset.name == "seq-01" and len(dataset) == COUNT and dataset.truth is None
    np.testing.assert_allclose(dataset.stamps, np.arange(COUNT) / 30.0)
    for k, frame in enumerate(dataset.frames()):
        known = (units(k) > 0) & (units(k) < 65535)
        np.testing.assert_allclose(frame.depth.pixels, np.where(known, units(k) / 1000.0, 0.0), rtol=1e-6)
        np.testing.assert_array_equal(frame.colors[0].pixels, pixels(k))
    assert dataset.frame(0).depth.pixels[0, :3] == pytest.approx([0.0, 0.0, 65.534])
    assert dataset.truth_poses is not None
    np.testing.assert_allclose(dataset.truth_poses.T_world_cam, np.stack([pose(k) for k in range(COUNT)]), atol=1e-12)
    assert dataset.rig.depth_camera.fx == 24.0 and dataset.rig.color_shutter.readout_s == 0.028
    assert len(dataset.notes) == 1 and "1/30 s apart" in dataset.notes[0]


def test_a_number_left_out_is_a_gap_and_a_missing_colour_a_frame_without(tmp_path: Path) -> None:
    root = make(tmp_path / "s", color="jpg")
    (root / "frame-000001.depth.png").unlink()
    (root / "frame-000001.color.jpg").unlink()
    (root / "frame-000003.color.jpg").unlink()
    dataset = open_dataset(root)
    np.testing.assert_allclose(dataset.stamps, np.array([0, 2, 3, 4]) / 30.0)
    assert [len(group) for group in dataset.groups] == [1, 1, 0, 1]


def test_what_is_assumed_is_said(tmp_path: Path) -> None:
    root = tmp_path / "s"
    root.mkdir()
    for k in range(2):
        cv2.imwrite(str(root / f"frame-{k:06d}.color.png"), np.full((480, 640, 3), k, np.uint8))
        cv2.imwrite(str(root / f"frame-{k:06d}.depth.png"), np.full((480, 640), k, np.uint16))
    dataset = open_dataset(root)
    depth, color = dataset.rig.depth_camera, dataset.rig.color_camera
    assert (depth.fx, depth.fy, depth.cx, depth.cy) == (585.0, 585.0, 320.0, 240.0)
    assert (color.fx, color.fy, color.cx, color.cy) == (525.0, 525.0, 320.0, 240.0)
    assert 0.02 < np.linalg.norm(dataset.rig.T_color_depth[:3, 3]) < 0.03
    assert dataset.rig.depth_shutter.readout_s == dataset.rig.color_shutter.readout_s == 0.0
    assert dataset.truth_poses is None
    text = describe(dataset)
    assert "note     frames are taken to be 1/30 s apart" in text and "fx 585" in text.split("note")[2]


def test_poses_that_are_not_finite_are_no_truth(tmp_path: Path) -> None:
    root = make(tmp_path / "s")
    np.savetxt(root / "frame-000002.pose.txt", np.full((4, 4), -np.inf))
    (root / "frame-000004.pose.txt").unlink()
    dataset = open_dataset(root)
    assert dataset.truth_poses is not None
    np.testing.assert_allclose(dataset.truth_poses.stamps, np.array([0, 1, 3]) / 30.0)
    assert "1 of 4 pose files hold no finite pose" in dataset.notes[-1]


def test_numbers_at_which_nothing_is_new_take_no_time(tmp_path: Path) -> None:
    root = make(tmp_path / "s")
    repeat(root, "depth", 2)
    repeat(root, "color", 1)  # its images arrive a little earlier
    dataset = open_dataset(root)
    np.testing.assert_allclose(dataset.stamps, np.array([0, 1, 2, 3]) / 30.0)
    np.testing.assert_allclose(dataset.color_stamps, np.array([0, 1, 2, 3]) / 30.0)
    assert dataset.truth_poses is not None and dataset.timing is not None
    np.testing.assert_allclose(dataset.truth_poses.stamps, dataset.stamps)
    np.testing.assert_allclose(dataset.truth_poses.T_world_cam[2], pose(3), atol=1e-12)
    np.testing.assert_allclose(dataset.timing.depth.listed, np.array([0, 1, 3, 4]) / 30.0)
    np.testing.assert_array_equal(dataset.frame(2).colors[0].pixels, pixels(3))
    assert any("1 of 5 depth images are the one before again" in note for note in dataset.notes)


def test_a_slower_camera_repeats_without_the_other_and_numbers_are_times(tmp_path: Path) -> None:
    root = make(tmp_path / "s")
    for k in (1, 3):
        repeat(root, "depth", k)
    dataset = open_dataset(root)
    np.testing.assert_allclose(dataset.stamps, np.array([0, 2, 4]) / 30.0)
    np.testing.assert_allclose(dataset.color_stamps, np.arange(5) / 30.0)
    assert sum(len(group) for group in dataset.groups) == 5


def repeat(root: Path, kind: str, k: int) -> None:
    """Frame k's image is the one before."""
    before = root / f"frame-{k - 1:06d}.{kind}.png"
    (root / f"frame-{k:06d}.{kind}.png").write_bytes(before.read_bytes())


def test_listings_say_more_and_go_first(tmp_path: Path) -> None:
    root = make(tmp_path / "s")
    (root / "rgb.txt").write_text("7.0 frame-000000.color.png\n")
    (root / "depth.txt").write_text("7.0 frame-000000.depth.png\n")
    assert open_dataset(root).stamps.tolist() == [7.0]


# --- faults ----------------------------------------------------------------------------------------------------------

Fault = Callable[[Path], object]


def unlink(pattern: str) -> Fault:
    return lambda root: [path.unlink() for path in root.glob(pattern)]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def link_out(root: Path) -> None:
    target = root / "frame-000001.depth.png"
    target.rename(root.parent / "outside.png")
    target.symlink_to(root.parent / "outside.png")


FAULTS: dict[str, tuple[Fault, str]] = {
    "no depth": (unlink("*.depth.png"), "has no depth image"),
    "no colour": (unlink("*.color.png"), "has no colour image"),
    "nothing": (unlink("*"), "nothing that can be tracked: give an rsgen sequence"),
    "no camera, odd size": (unlink("camera.yaml"), "images are 32x24 and 32x24, and nothing states the cameras"),
    "two colours": (lambda r: cv2.imwrite(str(r / "frame-000001.color.jpg"), pixels(1)), "frame 1 has .* already"),
    "link out": (link_out, "path 'frame-000001.depth.png' leaves"),
    "short pose": (lambda r: (r / "frame-000003.pose.txt").write_text("1 2 3"), "000003.pose.txt: expected the 16"),
    "words for a pose": (lambda r: (r / "frame-000003.pose.txt").write_text("x " * 16), "000003.pose.txt: expected"),
    "scaled pose": (lambda r: np.savetxt(r / "frame-000000.pose.txt", 2 * pose(1)), "000000.pose.txt: is not a rigid"),
    "mirrored pose": (
        lambda r: np.savetxt(r / "frame-000000.pose.txt", np.diag([1.0, 1, -1, 1])), "000000.pose.txt: is not a rigid",
    ),
    "all truncated": (lambda r: [cut(path) for path in r.glob("*.depth.png")], "000000.depth.png: .*truncated"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_one_line(fault: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    damage, message = FAULTS[fault]
    root = make(tmp_path / "s")
    damage(root)
    with pytest.raises(UserError, match=message) as error:
        open_dataset(root)
    assert "\n" not in str(error.value)
    assert main(["track", str(root), "--out", str(tmp_path / "r"), "--quiet"]) == 2
    assert capfd.readouterr().err.count("\n") == 1


DAMAGED: dict[str, tuple[Fault, str]] = {
    "truncated": (lambda r: cut(r / "frame-000002.depth.png"), "truncated"),
    "8 bit": (lambda r: cv2.imwrite(str(r / "frame-000002.depth.png"), pixels(2)[..., 0]), "8-bit grey"),
    "wrong size": (lambda r: cv2.imwrite(str(r / "frame-000002.depth.png"), units(2)[1:]), "32x23"),
    "colour": (lambda r: cv2.imwrite(str(r / "frame-000002.depth.png"), pixels(2)), "8-bit colour"),
    "empty": (lambda r: (r / "frame-000002.depth.png").write_bytes(b""), "is empty"),
}


@pytest.mark.parametrize("fault", DAMAGED)
def test_one_damaged_depth_image_is_no_frame_and_a_damaged_colour_none(fault: str, tmp_path: Path) -> None:
    damage, message = DAMAGED[fault]
    root = make(tmp_path / "s")
    damage(root)
    (root / "frame-000003.color.png").write_bytes(b"hello")
    dataset = open_dataset(root)
    frame, problems = dataset.readable_frame(2)
    assert frame is None and len(problems) == 1 and "000002.depth.png" in problems[0] and message in problems[0]
    frame, problems = dataset.readable_frame(3)
    assert frame is not None and frame.colors == () and "000003.color.png" in problems[0]
    frame, problems = dataset.readable_frame(3, color=False)
    assert frame is not None and problems == ()
    frame, problems = dataset.readable_frame(1)
    assert frame is not None and len(frame.colors) == 1 and problems == ()


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_a_damaged_first_image_does_not_keep_the_folder_shut(kind: str, tmp_path: Path) -> None:
    root = make(tmp_path / "s")
    (root / f"frame-000000.{kind}.png").write_bytes(b"hello")
    dataset = open_dataset(root)
    assert len(dataset) == COUNT and len(dataset.readable_frame(0)[1]) == 1
