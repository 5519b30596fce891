"""Hundreds of wrong configs and damaged sequences through the commands: one line each, never a traceback or a hang."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fuzzing
import numpy as np
import pytest
import synthetic
import tiny
import yaml
from fuzzing import ConfigVariant
from nightly import QUICK_OR_ALL, sampled

import rsgen.cli.main
import rsgen.produce.parts
import rstrack.cli.main
from rsgen.config.config import describe_fields
from rsgen.image_codecs import encode_exr, encode_npy, encode_npz, encode_png
from rsgen.sequence.reader import read_sequence
from rstrack.data.estimate import write_estimate

# A warning would be one more line on stderr.
pytestmark = pytest.mark.filterwarnings("error")

SEED = 4
MAX_CPU_S = 10.0
FIELDS = [name for name, _, _ in describe_fields()]

Run = Callable[..., tuple[int, str, str]]


class RenderingBegan(Exception):
    """Raised in the place of the renderer: the config has been accepted."""


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    """A command line's status, stdout and stderr, which is one line for status 2 and else none; in a short time."""

    def run(*words: str | Path) -> tuple[int, str, str]:
        program = {"rsgen": rsgen.cli.main.main, "rstrack": rstrack.cli.main.main}[str(words[0])]
        capfd.readouterr()
        begin = time.process_time()
        status = program([str(word) for word in words[1:]])
        out, error = capfd.readouterr()
        assert time.process_time() - begin < MAX_CPU_S
        if status == 2:
            assert error.startswith(f"{words[0]}: ") and error.endswith("\n") and error.count("\n") == 1, error
            assert error[:-1].isprintable() and "Traceback" not in error, error
        else:
            assert status in (0, 1) and error == "", error
        return status, out, error

    return run


# --- configs ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scene and the trajectory that the configs name."""
    folder = tmp_path_factory.mktemp("studio")
    tiny.write_config(folder, 6)
    return folder


@pytest.fixture
def check(studio: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> Callable[[ConfigVariant], bool]:
    """Render a config: it is refused in one line that has the variant's word, or, if it may be, taken: then True."""

    def begin_rendering(*_: Any, **__: Any) -> None:
        raise RenderingBegan

    monkeypatch.setattr(rsgen.produce.parts, "FrameSource", begin_rendering)
    monkeypatch.chdir(studio)

    def check(variant: ConfigVariant) -> bool:
        Path("fuzzed.yaml").write_bytes(variant.text)
        out = tmp_path / "out"
        try:
            status, _, error = run("rsgen", "render", "fuzzed.yaml", "--frames", "0:1", "--out", out)
        except RenderingBegan:
            assert not variant.refused, variant.name
            shutil.rmtree(out)
            return True
        assert status == 2 and variant.word in error, (variant.name, error)
        assert not out.exists(), variant.name
        return False

    return check


@pytest.mark.parametrize("motion", [None, fuzzing.LINE, fuzzing.TOUR])
def test_what_the_variants_are_made_of_is_accepted(
    motion: dict[str, Any] | None, check: Callable[[ConfigVariant], bool]
) -> None:
    assert check(ConfigVariant("whole", fuzzing.yaml_bytes(fuzzing.base_config(motion)), "", False))


@pytest.mark.parametrize("field", sampled(FIELDS, 8))
def test_a_field_takes_no_odd_values(field: str, check: Callable[[ConfigVariant], bool]) -> None:
    for variant in fuzzing.config_variants(field, SEED, extremes=1):
        check(variant)


@pytest.mark.parametrize("is_quick", QUICK_OR_ALL)
def test_odd_sections_and_contradictions_are_refused(is_quick: bool, check: Callable[[ConfigVariant], bool]) -> None:
    for variant in list(fuzzing.structure_variants())[:: 4 if is_quick else 1]:
        check(variant)


@pytest.mark.parametrize("is_quick", QUICK_OR_ALL)
def test_garbage_is_no_config(is_quick: bool, check: Callable[[ConfigVariant], bool]) -> None:
    for variant in fuzzing.garbage_variants(SEED, edits=4 if is_quick else 24):
        check(variant)


def test_motion_stats_refuses_what_render_does(studio: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(studio)
    variants = [v for field in FIELDS[::9] for v in fuzzing.config_variants(field, SEED, 0)[:2]]
    for variant in variants + list(fuzzing.garbage_variants(SEED, 0))[::4]:
        Path("fuzzed.yaml").write_bytes(variant.text)
        status, out, error = run("rsgen", "motion", "stats", "fuzzed.yaml")
        assert status == 2 and out == "" and variant.word in error, variant.name


# --- sequences -------------------------------------------------------------------------------------------------------

DESCRIPTION = ("sequence.yaml", "rgb.txt", "depth.txt", "spline.npz")
IMAGES = ("rgb/000001.png", "depth/000001.png")
TRUTH = (
    "truth/depth/000001.exr",
    *(f"truth/{name}/000001.png" for name in ("color", "sharp", "global_middle")),
    *(f"truth/{name}/000001.exr" for name in ("flow_global_middle", "flow_next", "normals", "blur_length")),
    *(f"truth/{name}/000001.exr" for name in ("color_depth",)),
    "truth/rows_depth.npy",
    "truth/rows_color.npy",
)
TEXTS = ("associations.txt", "groundtruth.txt", "imu.csv", "scene.ply")
FILES = (*DESCRIPTION, *IMAGES, *TRUTH, *TEXTS)

READERS: dict[str, tuple[str, ...]] = {
    "rsgen info SEQ": (),
    "rsgen export kalibr SEQ --quiet --out OUT": (),
    "rsgen export euroc SEQ --quiet --copy --out OUT": (),
    "rsgen export registered SEQ --quiet --out OUT": ("depth/000001.png",),
    "rstrack info SEQ": (),
    "rstrack evaluate SEQ RUN": (),
}
"""Commands that read the description, and the images that they decode; other damage does not matter to them.

Every command misses an image that is not there, or is no file.
"""


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence seq/ and a perfect run of it, run/. Tests damage a file at a time and put it back."""
    folder = tmp_path_factory.mktemp("sequence")
    root = fuzzing.make_sequence(folder / "seq")
    read = read_sequence(root)
    stamps = read.streams["depth"].stamps
    write_estimate(folder / "run", stamps, read.spline.pose(stamps), read.spline, {"lost": 0})
    return root


@pytest.fixture
def use(sequence: Path, run: Run, tmp_path: Path) -> Callable[[str], tuple[int, str]]:
    """Run a line of READERS; returns its status and all that it printed."""

    def use(line: str) -> tuple[int, str]:
        places = {"SEQ": sequence, "RUN": sequence.parent / "run", "OUT": tmp_path / "out"}
        status, out, error = run(*(places.get(word, word) for word in line.split()))
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        return status, out + error

    return use


def verify(use: Callable[[str], tuple[int, str]]) -> tuple[int, str]:
    return use("rsgen verify SEQ --pairs 1")


def test_whole_sequences_pass(use: Callable[[str], tuple[int, str]], sequence: Path) -> None:
    every = {path.relative_to(sequence).as_posix() for path in sequence.rglob("*") if path.is_file()}
    assert every == {name.replace("000001", f"{k:06d}") for name in FILES for k in range(4)}
    for line in READERS:
        assert use(line)[0] == 0, line
    status, text = verify(use)
    assert status == 0, text


@pytest.mark.parametrize("name", sampled(FILES, 4))
def test_a_damaged_file_is_named_by_all_that_read_it(
    name: str, sequence: Path, use: Callable[[str], tuple[int, str]]
) -> None:
    path = sequence / name
    data = path.read_bytes()
    ways = {way: damage(data) for way, damage in fuzzing.damages(SEED).items()}
    # What may be left whole: a number's last digit, a comment, half of a list.
    vague = {"flipped"} if not name.endswith((".png", ".exr")) else set()
    vague |= {"cut"} if name.endswith(".txt") else set()
    lines, shifts = list(READERS), (0, 3) if name in (*DESCRIPTION, *IMAGES) else (0,)
    for k, (way, damaged) in enumerate([("missing", None), *ways.items()]):
        chosen = [lines[(k + shift + FILES.index(name)) % len(lines)] for shift in shifts]
        with fuzzing.replaced(path, damaged, missing=way == "missing"):
            for line in chosen:
                status, text = use(line)
                matters = name in (*DESCRIPTION, *READERS[line])
                matters |= name in IMAGES and way in ("missing", "a folder")
                matters |= name in IMAGES and "euroc" in line and way == "empty"
                if way not in vague or not matters:
                    assert status == (2 if matters else 0), (way, line, text)
                assert status == 0 or name in text, (way, line, text)
            if k % 3 == FILES.index(name) % 3:
                status, text = verify(use)
                assert (status == 1 and Path(name).name in text) or way in vague, (way, text)


@pytest.mark.parametrize("is_quick", QUICK_OR_ALL)
def test_whole_files_of_another_kind_or_size_are_named(
    is_quick: bool, sequence: Path, use: Callable[[str], tuple[int, str]]
) -> None:
    small, rows = np.zeros((9, 12), np.float32), np.zeros((4, 36, 7))
    points = read_sequence(sequence).spline.control_points
    cases: list[tuple[str, bytes]] = [
        ("rgb/000001.png", encode_png(np.zeros((36, 47, 3), np.uint8))),
        ("rgb/000001.png", encode_png(np.zeros((36, 48), np.uint16))),
        ("depth/000001.png", encode_png(np.zeros((48, 36), np.uint16))),
        ("depth/000001.png", encode_png(np.zeros((36, 48, 3), np.uint8))),
        ("depth/000001.png", encode_exr(small)),
        ("truth/depth/000001.exr", encode_exr(small)),
        ("truth/depth/000001.exr", encode_exr(np.full((36, 48), np.nan, np.float32))),
        ("truth/depth/000001.exr", encode_exr(np.full((36, 48), -1, np.float32))),
        ("truth/normals/000001.exr", encode_exr(np.zeros((36, 48), np.float32))),
        ("truth/normals/000001.exr", encode_exr(np.full((36, 48, 3), np.inf, np.float32), ("x", "y", "z"))),
        ("truth/flow_next/000001.exr", encode_exr(np.zeros((36, 48, 3), np.float32), ("u", "v", "w"))),
        ("truth/sharp/000001.png", encode_png(np.zeros((36, 48), np.uint16))),
        ("truth/rows_depth.npy", encode_npy(rows[:3])),
        ("truth/rows_depth.npy", encode_npy(rows.astype(np.float32))),
        ("truth/rows_color.npy", encode_npy(rows + np.nan)),
        ("truth/rows_color.npy", encode_npy(np.array({"a": 1}, dtype=object).astype(str))),
        ("spline.npz", encode_npy(rows)),
        ("spline.npz", encode_npz({"control_points": points, "t0": np.array(0.0)})),
        ("spline.npz", encode_npz({"control_points": points[:3], "t0": np.array(0.0), "dt": np.array(0.05)})),
        ("spline.npz", encode_npz({"control_points": points, "t0": np.array("now"), "dt": np.array(0.05)})),
        ("spline.npz", encode_npz({"control_points": points, "t0": np.zeros(3), "dt": np.array(0.05)})),
        ("spline.npz", encode_npz({"control_points": points * 2, "t0": np.array(0.0), "dt": np.array(0.05)})),
        ("imu.csv", (sequence / "imu.csv").read_bytes() + b"1,2,3,4,5,6,7\n"),
        ("imu.csv", (sequence / "imu.csv").read_bytes().replace(b"0.", b"9.", 1)),
        ("groundtruth.txt", (sequence / "groundtruth.txt").read_bytes().replace(b"0.", b"nan ", 1)),
    ]
    for t0, dt in ((np.nan, 0.05), (1e300, 0.05), (0.0, 1e300), (0.0, 1e-300), (0.0, -1.0), (1e18, 0.05)):
        arrays = {"control_points": points, "t0": np.array(t0), "dt": np.array(dt)}
        cases.append(("spline.npz", encode_npz(arrays)))
    for k, (name, data) in list(enumerate(cases))[:: 4 if is_quick else 1]:
        with fuzzing.replaced(sequence / name, data):
            status, text = verify(use)
            assert status == 1 and ("FAIL" in text), (k, text)
            for line in list(READERS)[k % 3 :: 3]:
                status, text = use(line)
                assert status == 0 or name in text, (k, line, text)


LISTINGS = [
    ("rgb.txt", b"0.0333", b"0.0334"),
    ("rgb.txt", b"rgb/000001.png", b"rgb/000002.png"),
    ("rgb.txt", b"rgb/000001.png", b"../seq/rgb/000001.png"),
    ("rgb.txt", b"rgb/000001.png", b"/etc/hostname"),
    ("depth.txt", b"depth/000001.png", b"depth/" + b"0" * 5000 + b"1.png"),
    ("depth.txt", b"depth/000001.png", b"depth/\x00.png"),
    ("depth.txt", b"depth/000001.png", b"depth/000001.png depth/000001.png"),
    ("depth.txt", b"depth/000001.png", b"depth/\xc2\xb2.png"),
    ("depth.txt", b"depth/000001.png", b"."),
    ("depth.txt", b"0.033333333", b"nan"),
    ("depth.txt", b"0.033333333", b"-1e400"),
    ("depth.txt", b"0.033333333", b"0.000000000"),
    ("depth.txt", b"0.033333333", b"9" * 400),
]


@pytest.mark.parametrize("case", sampled(range(len(LISTINGS)), 3))
def test_an_odd_line_in_a_listing_is_named(case: int, sequence: Path, use: Callable[[str], tuple[int, str]]) -> None:
    name, old, new = LISTINGS[case]
    data = (sequence / name).read_bytes()
    assert old in data
    with fuzzing.replaced(sequence / name, data.replace(old, new)):
        for line in (*list(READERS)[case % 2 :: 2], "rsgen info SEQ"):
            status, text = use(line)
            assert status == 2 and name in text, (line, text)
        assert verify(use)[0] == 1


def entries() -> Iterator[tuple[str, int]]:
    """Every entry of a sequence.yaml that there can be, and the number of values tried in its place."""
    config = synthetic.make_config()
    stream = ["size", "intrinsics", "model", "distortion", "rate_hz", "offset_s", "readout_s", "exposure_s", "scan"]
    for name in ("color", "depth"):
        yield from ((f"streams.{name}.{field}", 3) for field in (*stream, "frames", "first_stamp_s"))
        yield from ((f"config.{name}.{field}", 1) for field in sorted(config.content()[name]))
    yield from ((name, 3) for name in ("format", "name", "T_color_depth", "streams", "streams.depth.depth_scale"))
    others = ("noise", "truth", "seed", "config", "inputs", "versions", "fingerprint", "spline", "config.imu")
    yield from ((name, 3) for name in (*others, "config.imu.rate_hz", "config.imu.T_imu_depth", "config.imu.gravity"))


ODD = (
    *fuzzing.NEVER,
    *fuzzing.EXTREME,
    [1e300] * 4,
    [[1e300] * 4] * 4,
    [2048, 2048],
    "a\x00b",
    {"a\nb": ["\x1b[31m"]},
    {"depth": [], "sharp": ["Q"]},
)


@pytest.mark.parametrize(("entry", "count"), sampled(entries(), 8))
def test_no_entry_of_sequence_yaml_is_taken_on_trust(
    entry: str, count: int, sequence: Path, use: Callable[[str], tuple[int, str]]
) -> None:
    """Streams and extrinsics are all that a reader needs: those are refused where they cannot be; verify finds all."""
    path = sequence / "sequence.yaml"
    data = yaml.load(path.read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    rng = np.random.default_rng([SEED, *entry.encode()])
    lines = list(READERS)
    for k in rng.permutation(len(ODD))[:count]:
        changed = fuzzing.with_entry(data, entry, ODD[k])
        if changed == data:
            continue
        with fuzzing.replaced(path, fuzzing.yaml_bytes(changed)):
            needed = entry.startswith(("streams", "T_color_depth", "format")) and k < len(fuzzing.NEVER)
            for line in rng.choice(lines, 2, replace=False):
                status, text = use(line)
                assert (status == 2 and "sequence.yaml" in text) or not needed, (ODD[k], line, text)
            if k % 2:
                assert verify(use)[0] == 1 or entry in ("name", "noise", "spline", "seed"), ODD[k]


def test_a_name_cannot_lead_out_of_the_folder(sequence: Path, use: Callable[[str], tuple[int, str]]) -> None:
    path = sequence / "sequence.yaml"
    data = yaml.load(path.read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    for name in ("../../outside", "/tmp/outside", "a/b", "..", "a\x00b", ""):
        with fuzzing.replaced(path, fuzzing.yaml_bytes(data | {"name": name})):
            status, text = use("rsgen export rerun SEQ --quiet")
            assert status == 2 and "sequence.yaml: name" in text, name


def test_yaml_that_never_ends_is_refused(sequence: Path, use: Callable[[str], tuple[int, str]]) -> None:
    path = sequence / "sequence.yaml"
    for k, variant in enumerate(fuzzing.garbage_variants(SEED, 0)):
        extra = variant.text.removeprefix(fuzzing.yaml_bytes(fuzzing.base_config()))
        with fuzzing.replaced(path, path.read_bytes() + extra if extra != variant.text else extra):
            status, text = use("rsgen info SEQ")
            assert status == 0 or (status == 2 and "sequence.yaml" in text), variant.name
            assert status == 2 or variant.name not in ("doubling", "merging", "itself", "deep", "noise"), variant.name
            if k % 8 == 0:
                assert verify(use)[0] == status // 2, variant.name


def test_a_damaged_run_is_named(sequence: Path, use: Callable[[str], tuple[int, str]]) -> None:
    for name in ("trajectory.txt", "spline.npz", "run.json"):
        path = sequence.parent / "run" / name
        for way, damage in fuzzing.damages(SEED).items():
            with fuzzing.replaced(path, damage(path.read_bytes())):
                status, text = use("rstrack evaluate SEQ RUN")
                vague = way in ("flipped", "cut") and name != "spline.npz"
                assert (status == 2 and name in text) or vague, (name, way, text)
    info = sequence.parent / "run/run.json"
    for odd in (
        "[]",
        "3",
        '{"spline_valid": 3}',
        '{"spline_valid": [[1]]}',
        '{"spline_valid": {"a": "b"}}',
        "[" * 9999,
    ):
        with fuzzing.replaced(info, odd.encode()):
            status, text = use("rstrack evaluate SEQ RUN")
            assert status == 2 and "run" in text, odd


TRACKED = [
    ("rgb/000001.png", "empty"),
    ("depth/000000.png", "cut"),
    ("depth/000002.png", "flipped"),
    ("sequence.yaml", "noise"),
    ("rgb.txt", "zeros"),
    ("spline.npz", "cut"),
]


def test_tracking_names_what_it_cannot_read(sequence: Path, use: Callable[[str], tuple[int, str]]) -> None:
    for name, way in TRACKED:
        path = sequence / name
        with fuzzing.replaced(path, fuzzing.damages(SEED)[way](path.read_bytes())):
            status, text = use("rstrack track SEQ --out OUT --quiet --method rs-pg")
            # One image that cannot be read costs its frame, or itself; without a listing or cameras there is no track.
            assert status == (1 if name.endswith(".png") else 2) and name in text, (name, text)
