"""Mitsuba scenes in centimetres and with z up: with `scene.scale` and `scene.up` they are the same scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rendering import dr, mi
from scene_files import write_scene

from rsgen.errors import UserError
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.image_codecs import encode_exr
from rsgen.render.images import ColorRenderer, DepthRenderer
from rsgen.scene import placement
from rsgen.scene.loading import Board, content_hash, load_scene
from rsgen.scene.meshes import mesh_arrays
from rsgen.scene.placement import SceneOptions, camera_up

CAMERA = Camera(48, 36, 40.0, 40.0, 23.5, 17.5)
OPTIONS = SceneOptions(scale=0.01, up="z")
T_WORLD_CAM = np.array([[1.0, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 3], [0, 0, 0, 1]])


def written(folder: Path, in_file: bool) -> Path:
    """A room's corner with everything in it that has a place, in metres and y up, or in centimetres and z up."""
    unit = 100 if in_file else 1
    also = '<rotate x="1" angle="90"/><scale value="100"/>' if in_file else ""

    def at(x: float, y: float, z: float, unit: float = unit) -> list[float]:
        return [unit * c for c in ((x, -z, y) if in_file else (x, y, z))]

    def high(*xyz: float) -> list[float]:  # of spheres and cylinders, whose triangles begin at an axis of the file
        return [unit * c for c in xyz]

    def given(tag: str, name: str, *xyz: float) -> str:
        return f'<{tag} name="{name}" ' + " ".join(f'{axis}="{c}"' for axis, c in zip("xyz", xyz, strict=True)) + "/>"

    def pose(steps: str) -> str:
        return f'<transform name="to_world">{steps}{also}</transform>'

    def looking(origin: tuple[float, float, float], target: tuple[float, float, float]) -> str:
        places = {"origin": at(*origin), "target": at(*target), "up": at(0.1, 1, 0.1, 1)}
        words = " ".join(f'{k}="{", ".join(map(str, v))}"' for k, v in places.items())
        return f'<transform name="to_world"><lookat {words}/></transform>'

    def intensity(*rgb: float) -> str:
        return f'<rgb name="intensity" value="{", ".join(str(unit**2 * c) for c in rgb)}"/>'

    upright = "" if in_file else f'<transform name="to_world">{ON_ITS_BACK}</transform>'
    waves = '<string name="filename" value="waves.png"/></texture>'
    path = write_scene(
        folder,
        f'<shape type="rectangle">{pose(ON_ITS_BACK + TWICE)}<bsdf type="bumpmap"><texture type="bitmap" name="it">'
        f'{waves}<float name="scale" value="{0.3 * unit}"/><bsdf type="diffuse"/></bsdf></shape>',
        f'<shape type="rectangle">{pose(TWICE + moved(0, 1, -1.5))}</shape>',
        f'<shape type="sphere">{given("point", "center", *high(-0.6, 0.4, 0.5))}{upright}'
        f'<float name="radius" value="{0.5 * unit}"/></shape>',
        f'<shape type="cylinder">{given("point", "p0", *high(0.9, 0.4, 0))}{given("point", "p1", *high(0.7, 0.8, 1))}'
        f'{upright}<float name="radius" value="{0.2 * unit}"/></shape>',
        f'<shape type="shapegroup" id="g"><shape type="cube"/></shape><shape type="instance"><ref id="g"/>'
        f"{pose(SMALL + moved(0.1, 0.3, 0.2))}</shape>",
        f'<shape type="disk">{pose(SMALL + moved(-1.2, 1.2, -1))}<emitter type="area">'
        '<rgb name="radiance" value="9, 3, 1"/></emitter></shape>',
        f'<emitter type="point">{given("point", "position", *at(0.4, 1.5, 0.3))}{intensity(1, 2, 3)}</emitter>',
        f'<emitter type="spot">{looking((0.5, 3, 1), (0, 0, -0.5))}{intensity(4, 9, 2)}</emitter>',
        f'<emitter type="projector">{looking((-1, 2, 2), (0, 0.5, -1))}<float name="fov" value="30"/>'
        f'<float name="scale" value="{30 * unit**2}"/><texture name="irradiance" type="bitmap">{waves}</emitter>',
        f'<emitter type="directional">{given("vector", "direction", *at(0.2, -0.5, -0.7, 1))}</emitter>',
        f'<emitter type="directional">{looking((0, 0, 0), (-0.2, -0.5, -0.7))}</emitter>',
        '<emitter type="constant"><rgb name="radiance" value="0.05"/></emitter>',
    )
    u, v = np.meshgrid(np.linspace(0, 6 * np.pi, 32), np.linspace(0, 4 * np.pi, 32))
    heights = 127 + 60 * np.sin(u) * np.cos(v)
    mi.Bitmap(np.repeat(heights[..., None], 3, axis=2).astype(np.uint8)).write(str(folder / "waves.png"))
    return path


ON_ITS_BACK, TWICE, SMALL = '<rotate x="1" angle="-90"/>', '<scale value="2"/>', '<scale value="0.3"/>'


def moved(x: float, y: float, z: float) -> str:
    return f'<translate x="{x}" y="{y}" z="{z}"/>'


def poses(t: np.ndarray) -> np.ndarray:
    return np.broadcast_to(T_WORLD_CAM, (len(np.atleast_1d(t)), 4, 4))


def test_the_same_scene_in_centimetres_and_z_up(tmp_path: Path) -> None:
    metres = load_scene(written(tmp_path / "m", False))
    centimetres = load_scene(written(tmp_path / "cm", True), options=OPTIONS)
    path = mi.load_dict({"type": "path", "max_depth": 3})
    images = [ColorRenderer(scene, path, CAMERA, Shutter(), 8).render(poses, 0.0, 1) for scene in (metres, centimetres)]
    depths = [DepthRenderer(scene, CAMERA, Shutter()).render(poses, 0.0) for scene in (metres, centimetres)]
    assert images[0].std() > 0.05 and np.mean(depths[0] > 1) > 0.7
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(depths[1], depths[0], rtol=1e-6)


# The sun's direction is the world's, by Mitsuba's rule, so it turns by itself.
SURROUNDINGS = {
    "envmap": ("", '<string name="filename" value="sky.exr"/>', '<string name="filename" value="sky.exr"/>'),
    "sunsky": (
        '<rotate x="1" angle="-80"/>',
        '<float name="sun_aperture" value="9"/><vector name="sun_direction" x="0.3" y="0.5" z="-0.6"/>',
        '<float name="sun_aperture" value="9"/><vector name="sun_direction" x="0.3" y="0.6" z="0.5"/>',
    ),
}


@pytest.mark.parametrize("plugin", SURROUNDINGS)
def test_surroundings_turn_with_the_scene(tmp_path: Path, plugin: str) -> None:
    pose, in_metres, in_file = SURROUNDINGS[plugin]
    sky = np.random.default_rng(3).uniform(0.1, 1.0, (8, 16, 3)).astype(np.float32)
    d = np.random.default_rng(4).normal(size=(3, 2000))
    seen = []
    for folder, also, inside, options in (
        ("m", "", in_metres, SceneOptions()),
        ("cm", '<rotate x="1" angle="90"/>', in_file, OPTIONS),
    ):
        turned = f'<transform name="to_world">{pose}{also}</transform>'
        file = write_scene(
            tmp_path / folder, f'<emitter type="{plugin}">{turned}{inside}</emitter><shape type="cube"/>'
        )
        (file.parent / "sky.exr").write_bytes(encode_exr(sky, ("R", "G", "B")))
        si = dr.zeros(mi.SurfaceInteraction3f, d.shape[1])
        si.wi = mi.Vector3f((-d / np.linalg.norm(d, axis=0)).astype(np.float32))
        seen.append(np.array(load_scene(file, options=options).emitters()[0].eval(si)))
    assert seen[0].std() > 0.1 * seen[0].mean()
    assert np.quantile(np.abs(seen[1] - seen[0]), 0.99) < 1e-4 * seen[0].mean()


def test_a_board_stays_where_it_is_and_the_options_are_in_the_hash(tmp_path: Path) -> None:
    file = write_scene(tmp_path, '<shape type="cube"/>')
    T_world_board = np.eye(4)
    T_world_board[:3, 3] = 1, 2, 3
    grid = AprilGrid(2, 2, 0.1, 0.3)
    boards = [
        load_scene(file, Board(grid, T_world_board), options).shapes()[1] for options in (SceneOptions(), OPTIONS)
    ]
    np.testing.assert_array_equal(*(mesh_arrays(board)[0] for board in boards))
    hashes = [content_hash(file)] + [content_hash(file, o) for o in (SceneOptions(scale=0.01), SceneOptions(up="z"))]
    assert len(set(hashes)) == 3


def test_a_light_that_cannot_be_placed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placement, "_NO_PLACE", ())
    with pytest.raises(UserError, match=r"emitter 'constant' cannot be scaled.*take another") as error:
        load_scene(write_scene(tmp_path, '<shape type="cube"/><emitter type="constant"/>'), options=OPTIONS)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("camera", "up"),
    [
        ('<lookat origin="1,2,3" target="0,0,0" up="0, 0.5, 0.9"/>', "z"),
        ('<lookAt origin="1,2,3" target="0,0,0" up="-1 0 0"/>', "-x"),
        ('<matrix value="1 0 0 5  0 0.9 0.4 5  0 -0.4 0.9 5  0 0 0 1"/>', "y"),
        ('<lookat origin="1,2,3" target="0,0,0" up="1, 1, 0"/>', None),
        ('<lookat origin="1,2,3" target="0,0,0"/>', None),
        ('<rotate y="1" angle="30"/>', None),
        ('<matrix value="what"/>', None),
    ],
)
def test_the_camera_of_a_scene_tells_which_axis_is_up(tmp_path: Path, camera: str, up: str | None) -> None:
    file = write_scene(tmp_path, f'<sensor type="perspective"><transform name="toWorld">{camera}</transform></sensor>')
    assert camera_up(file) == up
