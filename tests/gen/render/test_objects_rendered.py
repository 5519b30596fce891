"""Things that move by themselves: their light against closed forms, and whole sequences with them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny
import yaml
from moving_things import BALL, BOX, CAMERA, CIRCLE, SWING
from rendering import constant_twist, mi
from scipy.spatial.transform import Rotation

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import load_config
from rsgen.geometry.shutter import Shutter
from rsgen.image_codecs import encode_exr, read_exr
from rsgen.light.probes import gathered_light
from rsgen.produce.parts import load_motion, open_frames
from rsgen.render.irradiance import IrradianceField, Lattice, make_lattice
from rsgen.scene.moving_objects import MovingObject, ObjectsInFrame, covered, harmonics, irradiance_coefficients
from rsgen.scene.object_meshes import load_object
from rsgen.sequence.reader import read_sequence

# --- light


@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.4, 1.9])
@pytest.mark.parametrize("distance", [1.05, 1.6, 4.0])
def test_a_ball_covers_its_form_factor(distance: float, tilt: float) -> None:
    """Against the cosine-weighted hemisphere cut into small parts."""
    k = (np.arange(400) + 0.5) / 400
    r, phi = np.sqrt(k)[:, None], 2 * np.pi * k[None]  # Malley: even in area on the disk is cosine-weighted
    d = np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - r * r) + 0 * phi], axis=-1)
    to = distance * np.array([np.sin(tilt), 0, np.cos(tilt)])
    along = d @ to
    expected = np.mean((along > 0) & (distance**2 - along**2 < 1))
    got = covered(tuple(mi.Float(float(x)) for x in to), (mi.Float(0), mi.Float(0), mi.Float(1)))
    assert abs(float(got[0]) - expected) < 4e-3


def test_light_from_all_sides_is_even_and_light_from_above_is_above() -> None:
    """Under an even sky, E = pi L whichever way a surface faces; half a sky lights as the cosine has it."""
    sky = mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": 0.7}})
    one = Lattice(np.array([0]), np.array([[1, 1]]), np.array([0]), np.full(64, -1), np.zeros(64, bool), points=4)
    dark = IrradianceField(one, *np.zeros((2, 4, 5), np.float32))
    c = gathered_light(sky, dark, np.array([[0.0, 0, 0], [3, 1, 2]]))
    for n in np.eye(3):
        e = np.array(harmonics(n)) @ c[0]
        np.testing.assert_allclose(e, 0.7 * np.pi, rtol=5e-3)
    u = Rotation.random(20000, random_state=3).as_matrix()[:, 0]
    above = np.mean(np.array(harmonics(u.T)) * (u[:, 1] > 0), axis=1) * 4 * np.pi
    c = irradiance_coefficients(np.repeat(above[:, None], 3, axis=1))
    for tilt in (0.0, 1.0, 2.0, np.pi):
        n = np.array([np.sin(tilt), np.cos(tilt), 0])
        # E of a half-sky on a surface tilted from it is pi (1 + cos) / 2; the second order misses a few hundredths.
        np.testing.assert_allclose((np.array(harmonics(n)) @ c)[0], np.pi * (1 + np.cos(tilt)) / 2, atol=0.05)


def test_light_off_walls_is_what_they_are_lit_by_and_reflect() -> None:
    """In a closed box of one albedo and one irradiance E all that arrives is albedo x E, whichever way it is faced."""
    paper = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}}
    box = mi.load_dict({"type": "scene", "box": {"type": "cube", "bsdf": paper}})
    lattice = make_lattice(box, 0.5)
    lit = np.tile(np.array([3.0, 2.0, 1.0, 1.0], np.float32), (lattice.points, 1))
    c = gathered_light(box, IrradianceField(lattice, lit, lit), np.array([[0.0, 0, 0], [0.3, -0.2, 0.5]]))
    for n in np.concatenate([np.eye(3), -np.eye(3)]):
        np.testing.assert_allclose(np.array(harmonics(n)) @ c, np.tile([1.2, 0.8, 0.4], (2, 1)), rtol=0.01)


# --- the whole

THINGS = [
    {"name": "ball", "shape": BALL, "motion": CIRCLE | {"position": [0.0, 0.5, 0.8], "spin_deg_s": 90}},
    {
        "name": "box",
        "shape": BOX | {"size_m": [1.0, 0.9, 0.3]},
        "motion": SWING | {"position": [-0.6, 0.2, 1.5], "pivot": [-0.6, -0.5, 1.5], "axis": [1, 0, 0]},
    },
]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("things")
    return tiny.write_config(
        folder, 4, objects=THINGS, color={"exposure_s": 0.03, "spp": 16}, depth={"exposure_s": 0.005}
    )


@pytest.fixture(scope="module")
def whole(config: Path) -> Path:
    out = config.parent / "whole"
    assert main(["render", str(config), "--out", str(out), "--quiet"]) == 0
    return out


def test_a_sequence_with_things_verifies_and_is_the_same_again(config: Path, whole: Path) -> None:
    report = verify_sequence(whole, raycast=4)
    assert report.ok, report.text()
    assert "ball, box:" in report.text()
    again = config.parent / "again"
    for frames in ("2:3", "0:4"):
        assert main(["render", str(config), "--out", str(again), "--quiet", "--frames", frames]) == 0
    assert tiny.digests(again) == tiny.digests(whole)
    sequence = read_sequence(whole)
    assert [(o.name, o.number) for o in sequence.objects] == [("ball", 1), ("box", 2)]
    rows = np.loadtxt(whole / "truth/objects/ball.txt")
    np.testing.assert_allclose(rows[:, 1:4], sequence.objects[0].spline.pose(rows[:, 0])[:, :3, 3], atol=1e-11)


def test_verify_notices_wrong_masks_poses_and_motions(whole: Path, tmp_path: Path) -> None:
    def failed(damage: Any, raycast: int = 0) -> set[str]:
        seq = Path(shutil.copytree(whole, tmp_path / "seq", dirs_exist_ok=True))
        damage(seq)
        return {check.name for check in verify_sequence(seq, raycast=raycast).checks if not check.ok}

    def still(seq: Path) -> None:
        data = dict(np.load(seq / "truth/objects/box_spline.npz"))
        data["control_points"][:] = data["control_points"][3]
        np.savez(seq / "truth/objects/box_spline.npz", **data)

    def unmasked(seq: Path) -> None:
        for path in (seq / "truth/depth_object_ids").iterdir():
            path.write_bytes(encode_exr(0 * read_exr(path, (36, 48), ("id",)), ("id",)))

    assert "objects" in failed(lambda seq: (seq / "truth/object_ids/000001.exr").unlink())
    assert {"objects", "reprojection"} <= failed(still)
    assert failed(unmasked, raycast=4) >= {"ray casting"}


def test_blur_is_the_mean_of_sharp_pictures_over_the_exposure(config: Path) -> None:
    loaded = load_config(config, {"color.spp": "64", "color.readout_s": "0.01"})
    made = load_motion(loaded)
    color = open_frames(loaded, objects=made.objects).color._color
    rest = constant_twist(np.zeros(6), made.spline.pose(np.array([0.06]))[0])  # only the things blur
    got = color.render(rest, 0.06, 1)
    mean = np.mean([color.render(rest, 0.06 - 0.03 * (k + 0.5) / 12, k, 0.0) for k in range(12)], axis=0)
    one = color.render(rest, 0.06 - 0.015, 5, 0.0)
    assert np.abs(mean - one).max() > 0.1  # they do move
    assert np.sqrt(np.mean((got - mean) ** 2)) < 0.45 * np.sqrt(np.mean((one - mean) ** 2))


def test_things_take_light_from_what_is_near_and_only_that(config: Path) -> None:
    loaded = load_config(config)
    made = load_motion(loaded)
    ball = MovingObject(load_object(loaded.objects[0]), made.objects[0])
    frame = ObjectsInFrame([ball], CAMERA, Shutter(), 0.05)
    middle = made.objects[0].pose(np.array([0.05]))[0, :3, 3]
    # Half-axes of the ball are 0.25, 0.2, 0.225: a floor touches it from below (y is down here).
    p = mi.Point3f(np.stack([middle + np.array([0, y, 0]) for y in (0.205, 0.35, 3.0)]).T.astype(np.float32))
    up = np.array(frame.openness(p, mi.Normal3f(0, -1, 0), mi.Float(0)))
    down = np.array(frame.openness(p, mi.Normal3f(0, 1, 0), mi.Float(0)))
    assert up[0] < 0.1 < up[1] < 0.85 < 0.98 < up[2] and down[0] > 0.8


def test_a_thing_that_comes_through_the_camera_is_refused(config: Path, capsys: Any) -> None:
    eye = load_motion(load_config(config)).spline.pose(np.array([0.05]))[0, :3, 3].tolist()
    poses = [{"time_s": s, "position": [eye[0], eye[1], eye[2] + 12 * (0.05 - s)]} for s in (-0.1, 0, 0.1, 0.2)]
    bad = [{"name": "arrow", "shape": BOX, "motion": {"kind": "waypoints", "waypoints": poses}}]
    out = config.parent / "bad"
    assert main(["render", str(config), "--out", str(out), "--quiet", "--objects", yaml.safe_dump(bad)]) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert "objects.arrow: comes through the camera at" in told and not out.exists()


def test_a_mesh_that_is_missing_is_told_in_one_line(config: Path, capsys: Any) -> None:
    bad = [{"name": "ghost", "mesh": "none.ply", "motion": CIRCLE}]
    assert main(["render", str(config), "--out", "x", "--quiet", "--objects", yaml.safe_dump(bad)]) == 2
    assert "objects.ghost: mesh none.ply: no such file" in capsys.readouterr().err
