"""Wrong configs and damaged files, generated: the same ones on every run, each with what may become of it.

for variant in config_variants(folder):
    (folder / "fuzzed.yaml").write_bytes(variant.text)
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import synthetic
import tiny
import yaml

from rsgen.config.config import Config, describe_fields
from rsgen.produce.records import image_truth

# No field takes any of these.
NEVER: tuple[Any, ...] = (
    "no such\tthing\n\x07", float("nan"), float("inf"), 1e300, -1e300, {"x": 1}, [{}], b"\x00\xff",
)  # fmt: skip
# Some fields take some of these.
EXTREME: tuple[Any, ...] = (
    -1, 0, 5e-324, 2**70, True, None, [], [0], "", "~", [[[1]]], "2001-13-45", -(10**400),
)  # fmt: skip

TRUTH = {
    "sharp": True, "global_shutter": ["middle"], "flow": ["global", "next"], "normals": True, "blur_length": True,
    "color_depth": True,
}  # fmt: skip
_POSE = np.eye(4).tolist()
_SAID = {"intrinsics": [36.0, 36.0, 23.5, 17.5], "model": "fisheye", "distortion": [0.0, 0.0, 0.0, 0.0]}
_SAID |= {"readout_s": 0.01, "exposure_s": 0.002, "scan": "bottom-top"}
_PACE = {"length_m": 0.6, "mean_speed_m_s": 0.3, "mean_rotation_deg_s": 8.0, "ramp_s": 0.4, "clearance_m": 0.05}
LINE = _PACE | {"kind": "line", "position": [0.1, 0.2, -0.5], "target": [0.0, 0.1, 1.0], "strokes": 2}
_AT = {"target": [0.0, 0.1, 1.0]}
TOUR: dict[str, Any] = _PACE | {
    "kind": "tour",
    "mean_rotation_deg_s": 20.0,
    "closed": False,
    "waypoints": [_AT | {"position": [x, 0.1, -0.5]} for x in (-0.3, 0.0, 0.3)],
}


@dataclass(frozen=True)
class ConfigVariant:
    """A config file. word: what the complaint has to say. refused: whether there has to be one."""

    name: str
    text: bytes
    word: str
    refused: bool


def base_config(motion: dict[str, Any] | None = None) -> dict[str, Any]:
    """A valid config with every field written out, for `tiny`'s scene and trajectory, or a motion."""
    data: dict[str, Any] = {
        "name": "fuzzed",
        "scene": {"file": "scene.xml"},
        "light": tiny.QUICK_LIGHT,
        "color": tiny.CAMERA
        | {"spp": 1, "exposure_s": 0.005, "noise": {"model": "camera"}}
        | {"auto_exposure": {}, "auto_white_balance": {}},
        "depth": tiny.CAMERA | {"noise": {"model": "kinect"}},
        "tremor": {},
        "stretch": {"duration_s": 0.1},
        "truth": TRUTH,
        "imu": {},
        "mocap": {},
        "target": {"T_world_target": _POSE},
        "faults": {
            "declared": {"color": _SAID, "depth": _SAID | {"depth_scale": 5000.0}, "T_color_depth": _POSE},
            "color": {},
            "depth": {},
            "imu": {},
        },
    }
    data |= {"motion": motion} if motion else {"trajectory": {"file": "motion.txt"}}
    every: dict[str, Any] = Config.model_validate(data).model_dump(mode="json")
    return every | {"motion": motion}  # a motion refuses the fields of other kinds


def config_variants(name: str, seed: int, extremes: int) -> list[ConfigVariant]:
    """Of one field, by its dotted name: four values that never fit, and `extremes` that may."""
    rng = np.random.default_rng([seed, *name.encode()])
    motion = TOUR if name in ("motion.waypoints", "motion.closed") else LINE
    base = base_config(motion if name.startswith("motion.") else None)
    value = _get(base, name)
    wrong: list[Any] = list(NEVER)
    if isinstance(value, list) and value and name not in ("truth.global_shutter", "truth.flow", "motion.waypoints"):
        wrong += [value[:-1], [*value, value[0]], *([*value[:-1], odd] for odd in (None, float("-inf"), 1e300))]
    chosen = [EXTREME[i] for i in rng.permutation(len(EXTREME))[:extremes]]
    last = name.split(".")[-1] if not name.endswith("intrinsics") else name.split(".")[0]  # "color: cx must be ..."
    wrong = [wrong[i] for i in rng.permutation(len(wrong))[:4]]
    made = [(item, True) for item in wrong] + [(item, False) for item in chosen]
    return [
        ConfigVariant(f"{name} = {item!r}"[:80], yaml_bytes(_with(base, name, item)), last if refused else "", refused)
        for item, refused in made
    ]


def structure_variants() -> Iterator[ConfigVariant]:
    """Sections and files that are not what they should be, and settings that contradict each other."""

    def refused(what: str, name: str, value: Any, word: str, motion: dict[str, Any] | None = None) -> ConfigVariant:
        return ConfigVariant(what, yaml_bytes(_with(base_config(motion), name, value)), word, True)

    base = base_config()
    sections = ["", *sorted({name.rsplit(".", 1)[0] for name, _, _ in describe_fields() if "." in name})]
    for section in sections:
        full = base_config(LINE) if section == "motion" else base
        prefix = f"{section}." if section else ""
        yield ConfigVariant(f"unknown in {section}", yaml_bytes(_with(full, f"{prefix}fov", 1)), "fov", True)
        yield ConfigVariant(f"odd key in {section}", yaml_bytes(_with(full, f"{prefix}a\nb\x1b[31m", 1)), "", True)
        for value in ([], "x", 3.5, [[1]]) if section else ():
            yield ConfigVariant(f"{section} = {value}", yaml_bytes(_with(full, section, value)), section, True)
    for name in ("name", "scene", "scene.file"):
        yield ConfigVariant(f"no {name}", yaml_bytes(_without(base, name)), name, True)
    for name in ("kind", "length_m", "position", "target"):
        yield ConfigVariant(f"no {name}", yaml_bytes(_without(base_config(LINE), f"motion.{name}")), name, True)
    yield refused("two motions", "motion", LINE, "trajectory.file")
    yield refused("no motion", "trajectory.file", None, "trajectory.file")
    yield refused("flow without target", "truth.global_shutter", [], "global_shutter")
    yield refused("a time twice", "truth.global_shutter", ["first", "first"], "global_shutter")
    yield refused("ranges", "depth.noise.max_range_m", 0.1, "max_range_m")
    yield refused("angles", "depth.noise.grazing_deg", [80.0, 20.0], "grazing_deg")
    yield refused("coefficients", "color.distortion", [0.1, 0.2], "distortion")
    yield refused("a mirror", "T_color_depth", np.diag([-1.0, 1, 1, 1]).tolist(), "T_color_depth")
    yield refused("a folded lens", "color", base["color"] | {"model": "radtan", "distortion": [-9.0, 0, 0, 0]}, "color")
    yield refused("scene missing", "scene.file", "nowhere.xml", "nowhere.xml")
    yield refused("trajectory missing", "trajectory.file", "nowhere.txt", "nowhere.txt")
    yield refused("scene is a folder", "scene.file", ".", "scene")
    for what, odd in (("null", "a\0b"), ("surrogate", "a\ud800b"), ("long", "x" * 5000), ("tilde", "~nobody~/x")):
        yield refused(f"{what} trajectory", "trajectory.file", odd, "")
        yield refused(f"{what} scene", "scene.file", f"{odd}.xml", "")
    yield refused("too late", "color.offset_s", 1e3, "offset_s")
    yield refused("too many frames", "depth.rate_hz", 1e12, "rate_hz")
    yield refused("too many knots", "trajectory.knot_spacing_s", 1e-9, "knot")
    limits: tuple[tuple[str, Any, str], ...] = (
        ("light.texel_m", 1e-9, "memory grows"),
        ("light.texel_m", 1e9, "texel_m"),
        ("color.exposure_gain", 1e7, "exposure_gain"),
        ("color.exposure_gain", 5e-324, "exposure_gain"),
        ("color.readout_s", 5e-324, "readout_s"),
        ("depth.exposure_s", 1e9, "exposure_s"),
        ("depth.rate_hz", 5e-324, "rate_hz"),
        ("depth.depth_scale", 1e10, "depth_scale"),
        ("color.noise.gain", 5e-324, "gain"),
        ("color.noise.full_well_e", 1e-9, "full_well_e"),
        ("depth.noise.disparity_step_px", 5e-324, "disparity_step_px"),
        ("depth.noise.lateral_sigma_px", 1e5, "lateral_sigma_px"),
        ("depth.noise.projector_baseline_m", 5e-324, "projector_baseline_m"),
        ("color.intrinsics", [5e-324, 36.0, 23.5, 17.5], "fx"),
        ("trajectory.T_world_file", [[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "T_world_file"),
    )
    for name, value, word in limits:
        yield refused(f"{name} = {value}"[:60], name, value, word)
    targets: tuple[tuple[str, Any, str], ...] = (
        ("length_m", 1e4, "length_m"),
        ("mean_rotation_deg_s", 1e4, "mean_rotation_deg_s"),
        ("shake_position_m", 0.1, "length_m"),
        ("shake_rotation_deg", 10.0, "mean_rotation_deg_s"),
        ("shake_band_hz", [0.51, 0.52], "shake_band_hz"),
        ("shake_band_hz", [6.0, 0.5], "shake_band_hz"),
        ("strokes", 1000, "strokes"),
        ("shake_position_m", 0.2, "shake_position_m"),
        ("shake_rotation_deg", 11.0, "shake_rotation_deg"),
        ("shake_exponent", 1e4, "shake_exponent"),
        ("sway_hz", 3.0, "sway_hz"),
        ("ramp_s", 0.05, "ramp_s"),
        ("position", LINE["target"], "position"),
        ("waypoints", TOUR["waypoints"], "waypoints"),
        ("clearance_m", 100.0, "clearance"),
    )
    for name, value, word in targets:
        yield refused(f"{name} cannot be {value}"[:60], f"motion.{name}", value, word, LINE)
    yield refused("one place twice", "motion.waypoints", [TOUR["waypoints"][0]] * 3, "waypoints", TOUR)


def garbage_variants(seed: int, edits: int) -> Iterator[ConfigVariant]:
    """Files that are no YAML, no mapping, or too much of one; and `edits` valid ones with bytes changed."""
    text = yaml_bytes(base_config())
    rng = np.random.default_rng(seed)
    doubling = b"a0: &a0 [x, x]\n" + b"".join(b"a%d: &a%d [*a%d, *a%d]\n" % (i, i, i - 1, i - 1) for i in range(1, 64))
    merging = doubling.replace(b"[x, x]", b"{k: 1}").replace(b"[", b"{<<: [").replace(b"]", b"]}")
    for name, data in {
        "empty": b"",
        "a comment": b"# nothing\n",
        "a word": b"fuzzed",
        "a list": b"- name: x\n",
        "null": b"~",
        "noise": rng.bytes(3000),
        "binary": b"\x00\xff\xfe" * 50,
        "utf-16": text.decode().encode("utf-16"),
        "a tab": text + b"\tseed: 3\n",
        "a brace": text + b"seed: {\n",
        "two documents": text + b"---\nname: b\n",
        "a tag": text + b"seed: !!python/object/apply:os.getcwd []\n",
        "an odd date": text + b"seed: 2001-13-45\n",
        "endless digits": text + b"seed: " + b"9" * 5000 + b"\n",
        "an unhashable key": text + b"? [a]\n: 3\n",
        "no anchor": text + b"seed: *nowhere\n",
        "itself": text + b"seed: &s [*s]\n",
        "itself in a mapping": text + b"imu: &s {rate_hz: *s}\n",
        "doubling": text + doubling + b"seed: *a63\n",
        "merging": text + merging + b"light: *a63\n",
        "deep": text + b"seed: " + b"[" * 3000 + b"]" * 3000 + b"\n",
        "two levels in": text.replace(b"color:", b"  color:", 1),
        "a web page": b"<!DOCTYPE html>\n<html><body>404: not found</body></html>\n",
    }.items():
        yield ConfigVariant(name, data, "fuzzed.yaml", True)
    for k in range(edits):
        edited = bytearray(text)
        for at in rng.integers(0, len(text), 1 + k % 4):
            edited[at] = rng.choice(np.frombuffer(b"[]{}:,-#&*!|>'\"%@ \n0e.x\x00\xc3", np.uint8))
        yield ConfigVariant(f"edit {k}", bytes(edited), "", False)
    for k in range(edits // 4):
        yield ConfigVariant(f"cut {k}", text[: int(rng.integers(1, len(text)))], "", False)


def yaml_bytes(data: dict[str, Any]) -> bytes:
    """YAML, special numbers and characters included."""
    try:
        return yaml.dump(data, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), sort_keys=False).encode()
    except UnicodeEncodeError:  # libyaml writes no surrogates
        return yaml.safe_dump(data, sort_keys=False).encode()


# --- sequences -------------------------------------------------------------------------------------------------------


def make_sequence(root: Path, frames: int = 4) -> Path:
    """A small sequence that verifies and has all there can be: noise, exact images, an IMU."""
    base = synthetic.make_config(
        48,
        36,
        color={"noise": {"model": "camera"}, "exposure_s": 0.004},
        depth={"noise": {"model": "kinect"}},
    )
    data = base.model_dump(mode="json", exclude={"motion"})
    config = Config.model_validate(data | {"truth": TRUTH, "imu": {"rate_hz": 100.0}})
    writer = synthetic.open_writer(root, config, frames)
    rng = np.random.default_rng(0)
    for k in range(frames):
        stamp = float(writer.stamps("color")[k])
        T_color_depth = np.array(config.T_color_depth)
        image = synthetic.render_color(writer.spline, config.color.camera, config.color.shutter, stamp, T_color_depth)
        truth: dict[str, Any] = {}
        for name, channels in image_truth(config, "color").items():
            planes = (len(channels),) if len(channels) > 1 else ()
            truth[name] = rng.random((36, 48, *planes)).astype(np.float32) if channels else image
        writer.write_color(k, image, truth)
    for k in writer.missing("depth"):
        stamp = float(writer.stamps("depth")[k])
        writer.write_depth(k, synthetic.render_depth(writer.spline, config.depth.camera, config.depth.shutter, stamp))
    synthetic.write_scene(root)
    writer.finish()
    return root


Damage = Callable[[bytes], bytes | None]
"""From a file's bytes to others; None: a folder of its name."""


def flipped(data: bytes, seed: int) -> bytes:
    """One bit turned over somewhere."""
    at, bit = np.random.default_rng(seed).integers([len(data), 8])
    return data[:at] + bytes([data[at] ^ (1 << int(bit))]) + data[at + 1 :]


def damages(seed: int) -> dict[str, Damage]:
    """Ways to damage any file, by name."""
    return {
        "empty": lambda data: b"",
        "cut": lambda data: data[: len(data) // 2],
        "noise": lambda data: np.random.default_rng(seed).bytes(2000),
        "zeros": lambda data: bytes(len(data)),
        "a web page": lambda data: b"<!DOCTYPE html>\n<html>404: not found</html>\n",
        "a folder": lambda data: None,
        "flipped": functools.partial(flipped, seed=seed),
    }


@contextmanager
def replaced(path: Path, data: bytes | None, missing: bool = False) -> Iterator[None]:
    """The file with other bytes, as a folder (None) or missing, for a while."""
    aside = path.with_name(f".{path.name}.aside.tmp")
    path.rename(aside)
    try:
        if data is None and not missing:
            path.mkdir()
        elif data is not None:
            path.write_bytes(data)
        yield
    finally:
        if path.is_dir():
            path.rmdir()
        else:
            path.unlink(missing_ok=True)
        aside.rename(path)


def leaves(data: Any, prefix: str = "") -> Iterator[str]:
    """Dotted names of all entries of nested mappings, sections included."""
    for key, value in data.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")


def with_entry(data: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    """A copy with the entry of a dotted name set."""
    return _with(data, name, value)


def _get(data: dict[str, Any], name: str) -> Any:
    for key in name.split("."):
        data = (data or {}).get(key)  # type: ignore[assignment]
    return data


def _with(data: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    data = copy.deepcopy(data)
    *sections, last = name.split(".")
    inner = data
    for section in sections:
        inner = inner[section]
    inner[last] = value
    return data


def _without(data: dict[str, Any], name: str) -> dict[str, Any]:
    data = copy.deepcopy(data)
    *sections, last = name.split(".")
    inner = data
    for section in sections:
        inner = inner[section]
    del inner[last]
    return data
