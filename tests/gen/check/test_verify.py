"""`verify_sequence` passes what is right and fails each way of being wrong, in the check that is meant to notice."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import yaml

from rsgen.check.reprojection import reproject_depth
from rsgen.check.verify import Verification, verify_sequence
from rsgen.files import encode_yaml
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_exr, encode_npy, encode_png, read_exr
from rsgen.produce.writer import quantise
from rsgen.sequence.reader import read_sequence

FRAMES = 6
CHECKS = ["description", "files", "clocks", "images", "rows color", "rows depth", "ground truth", "scene"]
CHECKS += ["reprojection"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.make_sequence(tmp_path_factory.mktemp("finished") / "seq", frames=FRAMES)


@pytest.fixture
def seq(finished: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(finished, tmp_path / "seq"))


def failed(report: Verification) -> set[str]:
    assert all("\n" not in check.detail for check in report.checks)
    return {check.name for check in report.checks if not check.ok}


def test_a_right_sequence_passes(finished: Path) -> None:
    report = verify_sequence(finished)
    assert report.ok and [check.name for check in report.checks] == CHECKS
    assert "all checks passed" in report.text() and "FAIL" not in report.text()


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ({"scan": "bottom-top"}, {"scan": "bottom-top", "exposure_s": 0.01}),
        ({"scan": "left-right"}, {"scan": "right-left"}),
        ({"readout_s": 0.0}, {"readout_s": 0.0}),
        ({"rate_hz": 60.0, "offset_s": 0.0041, "exposure_s": 0.02}, {"rate_hz": 15.0, "readout_s": 0.06}),
        (
            {"model": "radtan", "distortion": [0.05, -0.02, 1e-3, -5e-4]},
            {"model": "fisheye", "distortion": [0.02, 0, 0, 0]},
        ),
    ],
)
def test_every_kind_of_camera_passes(tmp_path: Path, color: dict[str, Any], depth: dict[str, Any]) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(color=color, depth=depth), frames=4)
    report = verify_sequence(root)
    assert report.ok, report.text()


def test_part_of_a_sequence_passes_and_says_so(tmp_path: Path) -> None:
    writer = synthetic.open_writer(tmp_path / "seq", synthetic.make_config(), 6)
    synthetic.write_frames(writer, range(1, 4))
    synthetic.write_scene(writer.out)
    writer.finish()
    report = verify_sequence(writer.out)
    assert report.ok and "3 color of 6 (rendered in part)" in report.text()


def test_exact_depth_reprojects_to_micrometres(finished: Path) -> None:
    """Finite pixels are all that is left: at 64x48 the bilinear rule sees rows of different times, 58 mm apart."""
    sequence = read_sequence(finished)
    for k in range(FRAMES - 1):
        result = reproject_depth(sequence, k, k + 1)
        assert len(result.residual) > 1000
        assert np.median(np.abs(result.residual)) < 1e-5 and np.abs(result.residual).max() < 1e-3


def flip(path: Path, where: float = 0.6) -> None:
    data = bytearray(path.read_bytes())
    data[int(len(data) * where)] ^= 0x10
    path.write_bytes(data)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def replace_text(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def swap(first: Path, second: Path) -> None:
    a, b = first.read_bytes(), second.read_bytes()
    first.write_bytes(b)
    second.write_bytes(a)


def swap_depth(root: Path, first: int, second: int) -> None:
    for pattern in ("depth/{:06d}.png", "truth/depth/{:06d}.exr"):
        swap(root / pattern.format(first), root / pattern.format(second))


def edit_yaml(root: Path, stream: str, **change: Any) -> None:
    data = yaml.safe_load((root / "sequence.yaml").read_text())
    data["streams"][stream].update(change)
    (root / "sequence.yaml").write_bytes(encode_yaml(data))


def shift_rows(root: Path, stream: str) -> None:
    path = root / f"truth/rows_{stream}.npy"
    rows = np.load(path)
    np.save(path, np.roll(rows.reshape(-1, 7), 1, axis=0).reshape(rows.shape))


def nudge_row(root: Path, stream: str) -> None:
    path = root / f"truth/rows_{stream}.npy"
    rows = np.load(path)
    rows[3, 17, 4] += 1e-6
    np.save(path, rows)


def brighten_depth(root: Path) -> None:
    z = read_exr(root / "truth/depth/000002.exr", (48, 64))
    units = quantise(z, 5000.0)
    units[20, 30] += 1
    (root / "depth/000002.png").write_bytes(encode_png(units))


def rewrite_depth(root: Path, change: Callable[[np.ndarray], np.ndarray], frames: range = range(2, 3)) -> None:
    """Both files of depth frames changed alike, so that only a comparison between frames can tell."""
    for k in frames:
        z = change(read_exr(root / f"truth/depth/{k:06d}.exr", (48, 64))).astype(np.float32)
        (root / f"truth/depth/{k:06d}.exr").write_bytes(encode_exr(z))
        (root / f"depth/{k:06d}.png").write_bytes(encode_png(quantise(z, 5000.0)))


def drop_lines(root: Path, name: str, count: int) -> None:
    lines = (root / name).read_text().splitlines()
    (root / name).write_text("\n".join(lines[:-count]) + "\n")


DAMAGE: dict[str, tuple[Callable[[Path], Any], set[str]]] = {
    "color deleted": (lambda r: (r / "rgb/000003.png").unlink(), {"read"}),
    "depth deleted": (lambda r: (r / "depth/000003.png").unlink(), {"read"}),
    "truth deleted": (lambda r: (r / "truth/depth/000003.exr").unlink(), {"files", "images", "reprojection"}),
    "rows deleted": (lambda r: (r / "truth/rows_color.npy").unlink(), {"rows color"}),
    "scene deleted": (lambda r: (r / "scene.ply").unlink(), {"scene"}),
    "ground truth deleted": (lambda r: (r / "groundtruth.txt").unlink(), {"ground truth"}),
    "pairs deleted": (lambda r: (r / "associations.txt").unlink(), {"files"}),
    "spline deleted": (lambda r: (r / "spline.npz").unlink(), {"read"}),
    "color truncated": (lambda r: truncate(r / "rgb/000003.png"), {"images"}),
    "depth truncated": (lambda r: truncate(r / "depth/000003.png"), {"images"}),
    "truth truncated": (lambda r: truncate(r / "truth/depth/000003.exr"), {"images", "reprojection"}),
    "rows truncated": (lambda r: truncate(r / "truth/rows_color.npy"), {"rows color"}),
    "scene truncated": (lambda r: truncate(r / "scene.ply"), {"scene"}),
    "color corrupt": (lambda r: flip(r / "rgb/000000.png"), {"images"}),
    "depth corrupt": (lambda r: flip(r / "depth/000005.png"), {"images"}),
    "truth corrupt": (lambda r: flip(r / "truth/depth/000001.exr"), {"images", "reprojection"}),
    "color of another size": (
        lambda r: (r / "rgb/000001.png").write_bytes(encode_png(np.zeros((24, 32, 3), np.uint8))),
        {"images"},
    ),
    "color image for depth": (lambda r: shutil.copy(r / "rgb/000001.png", r / "depth/000001.png"), {"images"}),
    "rows of another size": (
        lambda r: (r / "truth/rows_depth.npy").write_bytes(encode_npy(np.zeros((FRAMES, 47, 7)))),
        {"rows depth", "scene", "reprojection"},
    ),
    "color rows shifted by one": (lambda r: shift_rows(r, "color"), {"rows color"}),
    "depth rows shifted by one": (lambda r: shift_rows(r, "depth"), {"rows depth"}),
    "one row nudged": (lambda r: nudge_row(r, "color"), {"rows color"}),
    "one depth pixel off by a unit": (brighten_depth, {"images"}),
    "neighbouring depth frames swapped": (lambda r: swap_depth(r, 2, 3), {"reprojection"}),
    "distant depth frames swapped": (lambda r: swap_depth(r, 0, 5), {"reprojection"}),
    "16-bit depth frames swapped": (lambda r: swap(r / "depth/000000.png", r / "depth/000001.png"), {"images"}),
    "depth upside down": (lambda r: rewrite_depth(r, np.flipud, range(FRAMES)), {"reprojection"}),
    "depth 30 % too near in one frame": (lambda r: rewrite_depth(r, lambda z: z * 0.7), {"reprojection"}),
    "noise in exact depth": (
        lambda r: rewrite_depth(r, lambda z: z * (1 + 0.01 * np.random.default_rng(0).standard_normal(z.shape))),
        {"reprojection"},
    ),
    "no depth at all in one frame": (lambda r: rewrite_depth(r, np.zeros_like), {"reprojection"}),
    "depth readout misstated": (
        lambda r: edit_yaml(r, "depth", readout_s=0.027),
        {"description", "rows depth", "reprojection"},
    ),
    "color readout misstated": (lambda r: edit_yaml(r, "color", readout_s=0.0279), {"description", "rows color"}),
    "exposure misstated": (lambda r: edit_yaml(r, "color", exposure_s=0.001), {"description", "rows color"}),
    "scan misstated": (
        lambda r: edit_yaml(r, "depth", scan="bottom-top"),
        {"description", "rows depth", "reprojection"},
    ),
    "intrinsics misstated": (
        lambda r: edit_yaml(r, "depth", intrinsics=[46.0, 46.0, 31.5, 23.5]),
        {"description", "scene", "reprojection"},
    ),
    "depth scale misstated": (lambda r: edit_yaml(r, "depth", depth_scale=4999.0), {"description", "images"}),
    "seed edited": (lambda r: replace_text(r / "sequence.yaml", "  seed: 0", "  seed: 1"), {"description"}),
    "rate misstated": (lambda r: edit_yaml(r, "color", rate_hz=29.0), {"read"}),
    "stamp edited": (lambda r: replace_text(r / "depth.txt", "0.033333333", "0.033433333"), {"read"}),
    "path edited": (lambda r: replace_text(r / "rgb.txt", "rgb/000002.png", "rgb/000003.png"), {"read"}),
    "listing shortened": (lambda r: drop_lines(r, "rgb.txt", 2), {"files"}),
    "pairs shortened": (lambda r: drop_lines(r, "associations.txt", 1), {"files"}),
    "pair edited": (lambda r: replace_text(r / "associations.txt", "depth/000002", "depth/000001"), {"files"}),
    "ground truth edited": (lambda r: replace_text(r / "groundtruth.txt", " 0.992", " 0.993"), {"ground truth"}),
    "ground truth shortened": (lambda r: drop_lines(r, "groundtruth.txt", 250), {"ground truth"}),
    "ground truth malformed": (lambda r: replace_text(r / "groundtruth.txt", " 0.", " zero."), {"ground truth"}),
    "stray image": (lambda r: shutil.copy(r / "rgb/000001.png", r / "rgb/000009.png"), {"files"}),
    "not a sequence": (lambda r: (r / "sequence.yaml").unlink(), {"read"}),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_fails_in_the_check_that_is_meant_for_it(seq: Path, kind: str) -> None:
    damage, expected = DAMAGE[kind]
    damage(seq)
    report = verify_sequence(seq)
    assert not report.ok and "FAIL" in report.text()
    assert expected <= failed(report) <= expected | {"scene", "reprojection"}, report.text()


@pytest.mark.parametrize("change", ["global shutter", "another spline", "half a frame late"])
def test_depth_rendered_otherwise_than_stated_fails(seq: Path, change: str) -> None:
    """The folder agrees with itself in all else: only the images were made with other poses."""
    config, spline = synthetic.make_config(), synthetic.make_spline()
    shutter, late = config.depth.shutter, 0.0
    if change == "global shutter":
        shutter = synthetic.make_config(depth={"readout_s": 0.0}).depth.shutter
    elif change == "another spline":
        points = spline.control_points @ se3.exp(np.random.default_rng(5).normal(0, 0.004, (33, 6)))
        spline = Spline(points, spline.t0, spline.dt)
    else:
        late = 1 / 60
    stamps = iter(read_sequence(seq).streams["depth"].stamps + late)
    rewrite_depth(
        seq,
        lambda z: synthetic.render_depth(spline, config.depth.camera, shutter, float(next(stamps))),
        range(FRAMES),
    )
    report = verify_sequence(seq)
    assert "reprojection" in failed(report) <= {"reprojection", "scene"}, report.text()


def test_a_scene_in_another_place_fails(seq: Path) -> None:
    box = synthetic.trimesh.creation.box(bounds=synthetic.BOX - [0.0, 0.0, 0.5])
    box.export(seq / "scene.ply")
    assert failed(verify_sequence(seq)) == {"scene"}


def test_a_missing_folder_is_a_failed_report(tmp_path: Path) -> None:
    report = verify_sequence(tmp_path / "nowhere")
    assert not report.ok and "no such folder" in report.text()


def test_a_flipped_bit_anywhere_never_raises(finished: Path, tmp_path: Path) -> None:
    """Descriptions, listings, poses and mesh (images have their own checks): a report, whatever the damage."""
    rng, noticed, tried = np.random.default_rng(7), 0, 0
    for name in [str(path.relative_to(finished)) for path in sorted(finished.rglob("*")) if path.is_file()]:
        if name.endswith((".png", ".exr")):
            continue
        for _ in range(3):
            root = Path(shutil.copytree(finished, tmp_path / f"seq{tried}"))
            data = bytearray((root / name).read_bytes())
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
            (root / name).write_bytes(data)
            report = verify_sequence(root, pairs=1)
            assert failed(report) or report.ok
            noticed, tried = noticed + (not report.ok), tried + 1
            shutil.rmtree(root)
    assert noticed > 0.6 * tried  # comments, mesh colours and last digits are free to differ


def test_another_ray_caster_agrees_and_notices_wrong_depth(finished: Path, seq: Path) -> None:
    def share(root: Path) -> float:
        check = verify_sequence(root, raycast=2).checks[-1]
        assert check.name == "ray casting" and not check.ok
        return float(check.detail.split("worst: ")[1].split(" %")[0])

    # The ball is analytic in the images and faceted in scene.ply: only the walls agree to 0.1 mm.
    assert 80 < share(finished) < 99.9
    rewrite_depth(seq, lambda z: z + np.float32(0.002), range(FRAMES))
    assert share(seq) < 10
