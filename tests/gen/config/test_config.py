"""Configs: what is right loads, what is wrong gives one line that names every wrong field, whatever the YAML holds."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fuzzing
import pytest
import yaml
from config_files import MINIMAL, load, refused
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rsgen.config.config import describe_fields, load_config, recorded_config, validate_config
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

ROTATED = [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def test_a_minimal_config_has_the_issues_defaults(tmp_path: Path) -> None:
    config = load(tmp_path, MINIMAL)
    assert config.color.camera == Camera(640, 480, 481.2, 480.0, 319.5, 239.5) == config.depth.camera
    assert config.color.shutter == Shutter(0.028) == config.depth.shutter
    assert (config.color.rate_hz, config.color.spp, config.depth.depth_scale) == (30.0, 16, 5000.0)
    assert config.light.mode == "baked" and config.trajectory.knot_spacing_s == 0.05


def test_paths_in_a_file_are_relative_to_it_and_those_of_overrides_to_the_working_directory(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    config = load(tmp_path / "sub", MINIMAL)
    assert config.trajectory.file == tmp_path / "sub/t.txt" and config.scene.file == tmp_path / "sub/s.xml"
    config = load(tmp_path, MINIMAL | {"scene": {"file": "/abs/s.xml"}}, {"trajectory.file": "here/t.txt"})
    assert config.trajectory.file == Path("here/t.txt") and config.scene.file == Path("/abs/s.xml")
    config = load(tmp_path, MINIMAL | {"scene": {"file": "~/s.xml"}})
    assert config.scene.file == Path.home() / "s.xml"


def test_overrides_are_parsed_as_yaml(tmp_path: Path) -> None:
    overrides = {
        "color.spp": "64",
        "depth.readout_s": "0",
        "depth.scan": "left-right",
        "color.intrinsics": "[400, 400, 319.5, 239.5]",
        "light.mode": "path",
        "T_color_depth": str(ROTATED),
        "seed": "7",
    }
    config = load(tmp_path, MINIMAL, overrides)
    assert config.color.spp == 64 and config.depth.readout_s == 0 and config.depth.scan == "left-right"
    assert config.color.intrinsics == (400, 400, 319.5, 239.5) and config.light.mode == "path" and config.seed == 7
    assert config.T_color_depth[0] == (0, -1, 0, 0.1)
    assert load(tmp_path, MINIMAL | {"color": {"spp": 4, "rate_hz": 10}}, overrides).color.rate_hz == 10
    assert load(tmp_path, MINIMAL, {"color.exposure_s": "1e-2"}).color.exposure_s == 0.01  # a string to YAML 1.1


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"name": None}, ["name"]),
        ({"name": "a/b"}, ["name", "'a/b'"]),
        ({"name": ".."}, ["name"]),
        ({"name": "."}, ["name"]),
        ({"trajectory": {}}, ["trajectory.file", "required"]),
        ({"trajectory": "t.txt"}, ["trajectory"]),
        ({"trajectory": {"file": 5}}, ["trajectory.file"]),
        ({"trajectory": {"file": "t", "format": "kitti"}}, ["trajectory.format", "'kitti'"]),
        ({"trajectory": {"file": "t", "knot_spacing_s": 0}}, ["trajectory.knot_spacing_s", "0"]),
        ({"trajectory": {"file": "t", "T_world_file": [[1, 0], [0, 1]]}}, ["trajectory.T_world_file"]),
        ({"color": {"spp": 0}}, ["color.spp", "got 0"]),
        ({"color": {"spp": "many"}}, ["color.spp", "'many'"]),
        ({"color": {"ssp": 16}}, ["color.ssp", "no such field"]),
        ({"colour": {"spp": 16}}, ["colour", "no such field"]),
        ({"color": {"rate_hz": 0}}, ["color.rate_hz"]),
        ({"color": {"rate_hz": float("inf")}}, ["color.rate_hz"]),
        ({"color": {"readout_s": -0.01}}, ["color.readout_s", "-0.01"]),
        ({"color": {"exposure_s": float("nan")}}, ["color.exposure_s"]),
        ({"color": {"intrinsics": [1, 2, 3]}}, ["color.intrinsics"]),
        ({"color": {"intrinsics": [-481.2, 480, 319.5, 239.5]}}, ["color", "fx"]),
        ({"color": {"model": "radtan", "distortion": [0.1]}}, ["color", "radtan"]),
        ({"color": {"scan": "spiral"}}, ["color.scan", "'spiral'"]),
        ({"color": {"width": 640.5}}, ["color.width", "640.5"]),
        ({"depth": {"depth_scale": 0}}, ["depth.depth_scale"]),
        ({"depth": {"spp": 4}}, ["depth.spp", "no such field"]),
        ({"depth": [1, 2]}, ["depth"]),
        ({"light": {"mode": "magic"}}, ["light.mode", "'magic'"]),
        ({"T_color_depth": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, ["T_color_depth", "rigid"]),
        ({"T_color_depth": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, ["T_color_depth", "rigid"]),
        ({"T_color_depth": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]}, ["T_color_depth", "rigid"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"backend": "opencl"}, ["backend", "'opencl'"]),
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, change: dict[str, Any], parts: list[str]) -> None:
    refused(tmp_path, MINIMAL | change, "config.yaml", *parts)


def test_a_motion_or_a_file(tmp_path: Path) -> None:
    motion = {"kind": "line", "length_m": 2.0, "mean_speed_m_s": 0.4, "mean_rotation_deg_s": 10.0,
              "position": [0, 1, 0], "target": [0, 1, 1]}  # fmt: skip
    made = {key: value for key, value in MINIMAL.items() if key != "trajectory"} | {"motion": motion}
    config = load(tmp_path, made)
    assert config.motion is not None and config.motion.kind == "line" and config.trajectory.file is None
    again = recorded_config(config.content(), "again")  # defaults written out, the scene by its name
    assert again.model_copy(update={"scene": config.scene}) == config and again.scene.file == Path("s.xml")
    refused(tmp_path, MINIMAL | {"motion": motion}, "trajectory.file", "not both")
    refused(tmp_path, made | {"motion": motion | {"kind": "jump"}}, "motion.kind", "'jump'")


def test_all_wrong_fields_are_named_at_once(tmp_path: Path) -> None:
    refused(tmp_path, {"name": "x", "scene": {}, "color": {"spp": -1}}, "scene.file: is required", "color.spp")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "mapping"),
        ("- a\n- b\n", "mapping"),
        ("just words", "mapping"),
        ("name: [demo\nscene: x\n", "line 2"),
        ("name: demo\n\tscene: x\n", "line 2"),
        ("name: !!python/object:os.system x\n", "YAML"),
        ("a: &a [*a]\nname: b\n", "config.yaml"),
        ("a: 2026-99-99\n", "config.yaml"),
        ("? [a, b]\n: c\n", "config.yaml"),
        ("1: 2\n", "config.yaml"),
        ("name: demo\n" + "[" * 5000, "config.yaml"),
        ("name: 'a\u0000b'\n", "config.yaml"),
    ],
)
def test_text_that_is_no_config_gives_one_line(tmp_path: Path, text: str, part: str) -> None:
    refused(tmp_path, text, part)


def test_files_that_cannot_be_read_give_one_line(tmp_path: Path) -> None:
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x01")
    for path, part in (
        (tmp_path / "none.yaml", "No such file"),
        (tmp_path, "directory"),
        (tmp_path / "binary.yaml", "not a text file"),
        (tmp_path / ("x" * 300), "too long"),
    ):
        with pytest.raises(UserError, match=part) as error:
            load_config(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        ({"color.ssp": "16"}, ["color.ssp", "no such field"]),
        ({"color.spp": "many"}, ["color.spp", "'many'"]),
        ({"color.spp": "[1"}, ["--color.spp", "[1"]),
        ({"name.first": "x"}, ["--name.first", "'name' is not a section"]),
        ({"depth.readout_s": ""}, ["depth.readout_s"]),
        ({"a..b": "1"}, ["a"]),
        ({"": "1"}, ["no such field"]),
        ({"seed": "2026-99-99"}, ["seed"]),
        ({"color.width": "[" * 5000}, ["color.width"]),
    ],
)
def test_a_wrong_override_is_named(tmp_path: Path, overrides: dict[str, str], parts: list[str]) -> None:
    refused(tmp_path, MINIMAL, *parts, overrides=overrides)


def test_content_is_what_decides_the_bytes(tmp_path: Path) -> None:
    content = load(tmp_path, MINIMAL).content()
    assert content["trajectory"]["file"] == "t.txt" and "backend" not in content  # no machine's paths or devices
    assert yaml.safe_load(yaml.safe_dump(content)) == content
    (tmp_path / "elsewhere").mkdir()
    assert load(tmp_path / "elsewhere", MINIMAL, {"backend": "llvm"}).content() == content
    assert load(tmp_path, MINIMAL, {"color.spp": "17"}).content() != content


def test_content_loads_again(tmp_path: Path) -> None:
    color = {"model": "fisheye", "distortion": [0, 0, 0, 0]}
    config = load(tmp_path, MINIMAL | {"T_color_depth": ROTATED, "color": color})
    assert recorded_config(config.content(), "again").content() == config.content()


def test_every_field_is_described() -> None:
    rows = {name: (default, text) for name, default, text in describe_fields()}
    assert rows["scene.file"][0] == "required" and rows["motion.kind"][0] == "required" and rows["color.spp"][0] == "16"
    assert "color.readout_s" in rows and "T_color_depth" in rows and "light.mode" in rows
    assert all(text for _, text in rows.values())


# --- limits -----------------------------------------------------------------------------------------------------------

LIMITS = [
    ("trajectory.knot_spacing_s", 1e-9, 1e3),
    ("trajectory.smoothing", 0.0, 1e6),
    ("light.texel_m", 1e-3, 100),
    ("color.rate_hz", 1e-4, 1e5),
    ("color.offset_s", -1e9, 1e9),
    ("color.readout_s", 1e-9, 3600),
    ("depth.exposure_s", 1e-9, 3600),
    ("color.exposure_gain", 1e-6, 1e6),
    ("depth.depth_scale", 1e-3, 1e9),
    ("color.noise.exposure_ev", -16, 16),
    ("color.noise.full_well_e", 1, 1e9),
    ("color.noise.read_noise_e", 0, 1e9),
    ("color.noise.gain", 1e-3, 1000),
    ("depth.noise.axial_nearest_m", 0, 1e4),
    ("depth.noise.projector_baseline_m", 1e-4, 100),
    ("depth.noise.lateral_sigma_px", 0, 100),
    ("depth.noise.disparity_step_px", 1e-6, 100),
    ("depth.noise.axial_growth_per_m", 0, 100),
    ("depth.noise.gaussian_per_m", 0, 100),
    ("motion.sway_hz", 1e-6, 2),
    ("motion.shake_position_m", 0, 0.1),
    ("motion.shake_rotation_deg", 0, 10),
    ("motion.shake_exponent", 0, 8),
    ("motion.ramp_s", 0.1, 0.9),  # of 2 s
]


@pytest.mark.parametrize(("name", "low", "high"), LIMITS)
def test_numbers_are_taken_up_to_their_limits(name: str, low: float, high: float) -> None:
    base = fuzzing.base_config(fuzzing.LINE if name.startswith("motion.") else None)
    for value in (low, high):
        validate_config(fuzzing.with_entry(base, name, value), "here")
    below = low * 0.99 if low > 0 else low - 0.01 * max(1, abs(low))
    for value in (below, high * 1.3):
        with pytest.raises(UserError, match=rf"here: .*{name.rpartition('.')[2]}") as error:
            validate_config(fuzzing.with_entry(base, name, value), "here")
        assert "\n" not in str(error.value)


def test_zero_switches_off_what_else_has_a_least_value() -> None:
    base = fuzzing.with_entry(fuzzing.base_config(), "color.auto_exposure", None)  # it needs an exposure to begin with
    names = ("color.readout_s", "color.exposure_s", "color.noise.gain", "depth.noise.disparity_step_px")
    for name in (*names, "faults.color.grid_s"):
        validate_config(fuzzing.with_entry(base, name, 0), "here")


def test_a_limit_says_its_reason(tmp_path: Path) -> None:
    part = "light.texel_m: must lie in 0.001 to 100 m: memory grows with 1 / texel_m^2, got 0.0001"
    refused(tmp_path, MINIMAL, part, overrides={"light.texel_m": "0.0001"})


def numbers(data: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where the floats of nested mappings and lists are."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield from numbers(value, (*at, key))
    if isinstance(data, float):
        yield at


@pytest.mark.parametrize("motion", [None, fuzzing.LINE, fuzzing.TOUR])
def test_no_number_is_unlimited(motion: dict[str, Any] | None) -> None:
    base = fuzzing.base_config(motion)
    base["color"] |= {"model": "radtan", "distortion": [0.0] * 5}
    base["imu"] |= {"gyroscope_range": 10.0, "accelerometer_range": 100.0}
    if motion is None:
        base["trajectory"]["T_world_file"] = [[float(i == j) for j in range(4)] for i in range(4)]
        base["trajectory"]["icl_start"] = base["trajectory"]["T_world_file"][:3]
    validate_config(base, "here")
    places = list(numbers(base))
    assert len(places) > 100 and ("color", "noise", "gain") in places and ("trajectory", "smoothing") in places
    for place in places:
        for value in (1e300, -1e300):
            data = copy.deepcopy(base)
            inner = data
            for key in place[:-1]:
                inner = inner[key]
            inner[place[-1]] = value
            with pytest.raises(UserError) as error:
                validate_config(data, "here")
            assert all(str(key) in str(error.value) for key in place[:2] if isinstance(key, str)), str(error.value)


FUZZ = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=10), st.dates(), st.binary(max_size=4)
)
NAMES = st.one_of(
    st.sampled_from(sorted({part for name, _, _ in describe_fields() for part in name.split(".")} | {"colour", ""})),
    st.text(max_size=5),
    st.integers(),
    st.none(),
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4), max_leaves=12
)


@FUZZ
@given(data=st.dictionaries(NAMES, VALUES, max_size=6), minimal=st.booleans())
@example(data={"color": {None: 1}}, minimal=True)
@example(data={"color": {"spp": 10**400}}, minimal=True)
@example(data={"T_color_depth": [[1e308] * 4] * 4}, minimal=True)
def test_any_yaml_loads_or_gives_one_line(tmp_path: Path, data: dict[Any, Any], minimal: bool) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(MINIMAL | data if minimal else data), encoding="utf-8")
    try:
        load_config(path)
    except UserError as error:
        assert len(str(error).splitlines()) == 1


@FUZZ
@given(
    key=st.one_of(st.sampled_from([name for name, _, _ in describe_fields()]), st.text(max_size=8)),
    text=st.one_of(st.text(max_size=12), st.floats().map(str), st.integers().map(str)),
)
def test_any_override_loads_or_gives_one_line(tmp_path: Path, key: str, text: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(MINIMAL))
    try:
        load_config(path, {key: text})
    except UserError as error:
        assert len(str(error).splitlines()) == 1


def test_the_home_of_nobody_gives_one_line(tmp_path: Path) -> None:
    refused(tmp_path, MINIMAL | {"scene": {"file": "~no_such_user/s.xml"}}, "scene.file")


def test_relative_config_paths_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load(tmp_path, MINIMAL)
    monkeypatch.chdir(tmp_path)
    assert load_config(Path("config.yaml")).scene.file == Path("s.xml")
    assert os.fspath(load_config(Path("config.yaml")).trajectory.file) == "t.txt"


# --- every pixel needs a ray ------------------------------------------------------------------------------------------

SEEN = [
    {"model": "radtan", "distortion": [-0.28, 0.074, 0.0002, 0.00002]},  # EuRoC's cameras
    {"model": "fisheye", "distortion": [0.0035, 0.0007, -0.002, 0.0002]},  # TUM-VI's, its corners cropped
    {"model": "radtan", "distortion": [0.3, 0.1, 0.0, 0.0, 0.01]},
    {"model": "pinhole", "intrinsics": [5.0, 5.0, 319.5, 239.5]},
]
UNSEEN = [
    ({"model": "radtan", "distortion": [-0.5, 0.0, 0.0, 0.0]}, "(-0.5, -0.5)"),  # folds back inside the image
    ({"model": "fisheye", "distortion": [0.0] * 4, "intrinsics": [190.0, 190.0, 319.5, 239.5]}, "(-0.5, -0.5)"),
    # Only one corner's outermost edge, 799.3 px from the centre, is beyond 90 degrees: f pi / 2 = 799.0 px.
    ({"model": "fisheye", "distortion": [0.0] * 4, "intrinsics": [508.66, 508.66, 0.0, 479.0]}, "(639.5, -0.5)"),
    # The image lies aside from the axis altogether.
    ({"model": "fisheye", "distortion": [0.0] * 4, "intrinsics": [400.0, 400.0, -900.0, 239.5]}, "(-0.5, -0.5)"),
]


@pytest.mark.parametrize("stream", ["color", "depth"])
@pytest.mark.parametrize("fields", SEEN)
def test_usual_distortions_are_accepted(tmp_path: Path, stream: str, fields: dict[str, Any]) -> None:
    assert getattr(load(tmp_path, MINIMAL | {stream: fields}), stream).model == fields["model"]


@pytest.mark.parametrize("stream", ["color", "depth"])
@pytest.mark.parametrize(("fields", "pixel"), UNSEEN)
def test_a_pixel_that_no_ray_reaches_is_refused(
    tmp_path: Path, stream: str, fields: dict[str, Any], pixel: str
) -> None:
    refused(tmp_path, MINIMAL | {stream: fields}, f"{stream}: distortion: no ray reaches pixel {pixel}")


# --- former names -----------------------------------------------------------------------------------------------------
