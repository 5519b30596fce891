"""Images of a lens that breathes: as the shared camera would have taken them, and tracked as if it had."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
import yaml

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.image_codecs import encode_png
from rsgen.sequence.format import pose_rows
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import Estimate
from rstrack.data.image_files import ImageFiles
from rstrack.data.registration import OwnIntrinsics, SharedImages
from rstrack.data.rig import Rig
from rstrack.metrics.association import truth_of
from rstrack.metrics.evaluate import evaluate
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

WIDTH, HEIGHT, FRAMES = 80, 60, 22  # two breaths
SHARED = Camera(WIDTH, HEIGHT, 62.0, 61.0, 39.2, 29.8)
SHUTTER, SPLINE = Shutter(0.02), synthetic.make_spline(0.3)
T_COLOR_DEPTH = synthetic.T_COLOR_DEPTH


def of(camera: Camera) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy]


def breathing(k: int, by: float = 0.02) -> Camera:
    """The lens at frame k: its focal length swings by 2 % to either side, its centre by half a pixel."""
    swing = by * np.sin(2 * np.pi * k / 11)
    moved = (SHARED.fx * (1 + swing), SHARED.fy * (1 + swing), SHARED.cx + 25 * swing, SHARED.cy - 20 * swing)
    return replace(SHARED, **dict(zip(("fx", "fy", "cx", "cy"), map(float, moved), strict=True)))


def shared(own: Camera, color: np.ndarray, depth: np.ndarray) -> SharedImages:
    """One image of either stream, taken by `own`."""

    class One:
        def color(self, k: int) -> np.ndarray:
            return color

        def depth(self, k: int) -> np.ndarray:
            return depth

    intrinsics = OwnIntrinsics(np.array([of(own)]), np.array(of(SHARED)))
    return SharedImages(One(), intrinsics, intrinsics)


@pytest.mark.parametrize("model", ["pinhole", "radtan", "fisheye"])
@pytest.mark.parametrize("k", [1, 3, 8])
def test_images_are_those_of_the_shared_camera(k: int, model: str) -> None:
    """Rendered anew with that camera; the lens's model does not matter."""
    lens = {"pinhole": (), "radtan": (-0.1, 0.03, 0.001, -0.002), "fisheye": (0.02, -0.01, 0.002, 0.0)}[model]
    own, base = (replace(c, model=model, distortion=lens) for c in (breathing(k), SHARED))  # type: ignore[arg-type]
    still = Shutter()  # lines have one time: what is left is the resampling
    images = {
        camera: (synthetic.render_color(SPLINE, camera, still, 0.3, T_COLOR_DEPTH),
                 synthetic.render_depth(SPLINE, camera, still, 0.3))
        for camera in (own, base)
    }  # fmt: skip
    taken = shared(own, *images[own])
    color, z = taken.color(0), taken.depth(0)
    wanted_color, wanted_z = images[base]
    inner = np.s_[3:-3, 3:-3]
    # The texture bends between pixels; corners of the room and the ball's rim keep the nearest depth.
    off, off_before = (np.abs(c[inner].astype(int) - wanted_color[inner]) for c in (color, images[own][0]))
    assert np.quantile(off, 0.9) <= 2 < 5 < np.quantile(off_before, 0.9)
    assert (z[inner] > 0).all()
    error, error_before = (np.abs(each / wanted_z - 1)[inner] for each in (z, images[own][1]))
    print(model, np.median(error), np.quantile(error, 0.75), np.median(error_before))
    # On a plane 1/z is linear in the pixels of a pinhole; a lens bends it by the square of a pixel.
    assert np.median(error) < (1e-6 if model == "pinhole" else 1e-4) < 1e-3 < np.median(error_before)


def test_images_of_the_shared_camera_stay_as_they_are() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = rng.random((HEIGHT, WIDTH), dtype=np.float32)
    taken = shared(SHARED, color, depth)
    assert taken.color(0) is color and taken.depth(0) is depth


def test_depth_is_not_mixed_across_edges_nor_made_where_nothing_is() -> None:
    z = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    z[:, 33:] = 3.0
    z[20:25, 10:15] = 0.0
    own = breathing(2)
    found = shared(own, np.zeros((HEIGHT, WIDTH, 3), np.uint8), z).depth(0)
    found = np.round(found, 5)
    assert set(np.unique(found)) == {0.0, 1.0, 3.0}
    # Where each pixel of the shared camera lies in the image, by the cameras themselves.
    uv = own.project(SHARED.unproject(SHARED.pixel_grid()))[0]
    inside = (uv >= 0).all(-1) & (uv <= (WIDTH - 1, HEIGHT - 1)).all(-1)
    assert (found[~inside] == 0).all() and not inside.all()
    far = np.abs(uv[..., 0] - 32.5) > 0.5
    hole = (np.abs(uv[..., 0] - 12) < 2) & (np.abs(uv[..., 1] - 22) < 2)
    assert (found[hole & inside] == 0).all() and hole.sum() > 8
    away = (np.abs(uv[..., 0] - 12) > 3.5) | (np.abs(uv[..., 1] - 22) > 3.5)
    np.testing.assert_array_equal(
        found[inside & far & away], np.where(uv[..., 0] < 32.5, 1.0, 3.0)[inside & far & away]
    )


# --- a recording -----------------------------------------------------------------------------------------------------


def write_recording(root: Path, breathes: bool) -> Path:
    """A TUM folder with truth and a camera.yaml; if it breathes, of its medians, with intrinsics.csv, as imported."""
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    stamps = 1.7e9 + np.arange(FRAMES) / 30
    tables: dict[str, list[str]] = {"intrinsics.csv": [], "intrinsics_depth.csv": []}
    for k in range(FRAMES):
        camera = breathing(k) if breathes else SHARED
        color = synthetic.render_color(SPLINE, camera, SHUTTER, k / 30, T_COLOR_DEPTH)
        z = synthetic.render_depth(SPLINE, camera, SHUTTER, k / 30)
        (root / f"rgb/{k}.png").write_bytes(encode_png(color))
        (root / f"depth/{k}.png").write_bytes(encode_png(np.rint(z * 20000).astype(np.uint16)))
        for lines in tables.values():
            lines.append(",".join([str(1_700_000_000 * 10**9 + round(k / 30 * 1e9)), *map(repr, of(camera))]))
    for name in ("rgb", "depth"):
        listing = [f"{stamp:.9f} {name}/{k}.png" for k, stamp in enumerate(stamps)]
        (root / f"{name}.txt").write_text("\n".join([*listing, ""]))
    for name, lines in tables.items():
        if breathes:
            (root / name).write_text("\n".join(["#timestamp [ns],fx,fy,cx,cy", *lines, ""]))
    medians = np.median([of(breathing(k) if breathes else SHARED) for k in range(FRAMES)], axis=0).tolist()
    stream = {"width": WIDTH, "height": HEIGHT, "intrinsics": medians, "readout_s": SHUTTER.readout_s}
    color = stream | {"offset_s": 0.0, "falloff": 0.0}
    camera_yaml = {"color": color, "depth": stream | {"depth_scale": 20000.0}, "stamps": "raw"}
    camera_yaml |= {"sigma": {"depth_image": 0.0}}
    (root / "camera.yaml").write_text(yaml.safe_dump(camera_yaml | {"T_color_depth": T_COLOR_DEPTH.tolist()}))
    poses = pose_rows(SPLINE.pose(np.arange(FRAMES) / 30) @ se3.inverse(T_COLOR_DEPTH))
    truth = [" ".join([f"{s:.9f}", *map(repr, row.tolist())]) for s, row in zip(stamps, poses, strict=True)]
    (root / "groundtruth.txt").write_text("\n".join([*truth, ""]))
    return root


def error_mm(root: Path) -> float:
    """ATE in mm of a track of all frames; infinite where it is lost."""
    dataset = open_dataset(root)
    tracker = Tracker(dataset.rig, Options(method="rs-pg", backend="llvm"))
    for frame in dataset.frames():
        tracker.feed(frame)
    if any(report.lost for report in tracker.reports):
        return math.inf
    stamps, T = tracker.trajectory
    found = evaluate(truth_of(dataset), Estimate(stamps, T, tracker.spline, {}))
    return 1e3 * found.ate_rmse_m


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("breathing")
    return write_recording(folder / "fixed", False), write_recording(folder / "breathing", True)


def test_a_lens_that_breathes_is_tracked_as_well_as_a_fixed_one(recordings: tuple[Path, Path], tmp_path: Path) -> None:
    fixed, breathes = recordings
    assert any("own, fx 60.8 to 63.2" in note for note in open_dataset(breathes).notes)
    ignored = Path(shutil.copytree(breathes, tmp_path / "ignored"))
    for name in ("intrinsics.csv", "intrinsics_depth.csv"):
        (ignored / name).unlink()
    errors = [error_mm(root) for root in (fixed, breathes, ignored)]
    print("ATE in mm, fixed, breathing, ignored:", errors)
    # What is lost is the rim, which the shortest focal length alone has seen; 0.2 more would do without innovations.
    assert errors[1] < errors[0] + 0.3 and errors[2] > 50 * errors[1], errors


def test_the_table_goes_by_stamps(recordings: tuple[Path, Path], tmp_path: Path) -> None:
    """Images that are not listed any more, or between two entries, get what is theirs."""
    root = Path(shutil.copytree(recordings[1], tmp_path / "some"))
    for name in ("rgb.txt", "depth.txt"):
        (root / name).write_text("\n".join((root / name).read_text().splitlines()[1::2]))
    table = (root / "intrinsics.csv").read_text().splitlines()
    (root / "intrinsics.csv").write_text("\n".join(table[:1] + table[2:4] + table[5:]))
    images = open_dataset(root).images
    assert isinstance(images, SharedImages) and images.own_color is not None and images.own_depth is not None
    odd = np.array([of(breathing(k)) for k in range(1, FRAMES, 2)])
    np.testing.assert_allclose(images.own_depth.own, odd, atol=1e-4)
    odd[1] = 0.5 * (odd_of := np.array([of(breathing(k)) for k in (2, 4)])).sum(axis=0)
    np.testing.assert_allclose(images.own_color.own, odd, atol=1e-4)
    assert odd_of.shape == (2, 4) and isinstance(images.images, ImageFiles) and isinstance(open_dataset(root).rig, Rig)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("# nothing\n", "rising stamps"),
        ("1,62,61,39\n", "line 1"),
        ("1,62,61,39,nan\n", "line 1"),
        ("1,62,-61,39,29\n", "line 1"),
        ("1.5,62,61,39,29\n", "line 1"),
        ("9" * 400 + ",62,61,39,29\n", "line 1"),
        ("2,62,61,39,29\n1,62,61,39,29\n", "rising stamps"),
        ("1,62,61,39,29\n2,62,61,39,29\n3,20,20,39,29\n", "not of one camera"),
        ("1,620,610,390,290\n", "not 62 as the camera file states"),
    ],
)
def test_a_wrong_table_is_one_line(recordings: tuple[Path, Path], tmp_path: Path, text: str, said: str) -> None:
    root = Path(shutil.copytree(recordings[0], tmp_path / "wrong"))
    (root / "intrinsics.csv").write_text(text)
    with pytest.raises(UserError) as caught:
        open_dataset(root)
    assert said in str(caught.value) and "intrinsics.csv" in str(caught.value) and "\n" not in str(caught.value)
