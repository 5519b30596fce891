"""Atomic writes and strict readers: the same bytes each time, whole files only, and never a silently wrong image."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import yaml

from rsgen import files
from rsgen import image_codecs as codecs
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline

RNG = np.random.default_rng(1)
RGB = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
UNITS = RNG.integers(0, 65536, (24, 32), dtype=np.uint16)
Z = RNG.random((24, 32), dtype=np.float32) * 5
ROWS = RNG.random((3, 24, 7))
GREY = RNG.integers(0, 256, (24, 32), dtype=np.uint8)

# name, bytes, reader
KINDS: list[tuple[str, bytes, Callable[[Path], np.ndarray], np.ndarray]] = [
    ("rgb.png", codecs.encode_png(RGB), lambda p: codecs.read_png(p, RGB.shape, np.uint8), RGB),
    ("grey.png", codecs.encode_png(GREY), lambda p: codecs.read_png(p, GREY.shape, np.uint8), GREY),
    ("depth.png", codecs.encode_png(UNITS), lambda p: codecs.read_png(p, UNITS.shape, np.uint16), UNITS),
    ("z.exr", codecs.encode_exr(Z), lambda p: codecs.read_exr(p, Z.shape), Z),
    ("rows.npy", codecs.encode_npy(ROWS), lambda p: codecs.read_npy(p, ROWS.shape), ROWS),
]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def one_line(error: pytest.ExceptionInfo[UserError], name: str) -> str:
    text = str(error.value)
    assert name in text and "\n" not in text
    return text


@pytest.mark.parametrize(("name", "data", "read", "expected"), KINDS, ids=[kind[0] for kind in KINDS])
def test_files_read_back_exactly(tmp_path: Path, name: str, data: bytes, read: Any, expected: np.ndarray) -> None:
    files.atomic_write(tmp_path / name, data)
    found = read(tmp_path / name)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)
    assert names(tmp_path) == [name]


@pytest.mark.parametrize(("name", "data", "read", "expected"), KINDS, ids=[kind[0] for kind in KINDS])
def test_truncation_is_always_noticed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, data: bytes, read: Any, expected: np.ndarray
) -> None:
    for length in [0, 1, 7, 8, 20, *range(33, len(data), len(data) // 40), len(data) - 1]:
        (tmp_path / name).write_bytes(data[:length])
        with pytest.raises(UserError) as error:
            read(tmp_path / name)
        one_line(error, name)
    assert capfd.readouterr() == ("", "")  # decoders that print their own complaints were not reached


@pytest.mark.parametrize(("name", "data", "read", "expected"), KINDS[:3], ids=[kind[0] for kind in KINDS[:3]])
def test_a_flipped_bit_never_gives_a_wrong_image(
    tmp_path: Path, name: str, data: bytes, read: Any, expected: np.ndarray
) -> None:
    positions = [*range(0, 400, 3), *range(400, len(data), max(1, len(data) // 60))]
    refused = 0
    for position in positions:
        broken = bytearray(data)
        broken[position] ^= 1 << (position % 8)
        (tmp_path / name).write_bytes(broken)
        try:
            found = read(tmp_path / name)
        except UserError as error:
            assert name in str(error) and "\n" not in str(error)
            refused += 1
        else:  # only where the checksum's own label was hit
            np.testing.assert_array_equal(found, expected)
    assert refused > 0.9 * len(positions)


def test_a_file_of_another_size_or_type_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(codecs.encode_png(UNITS))
    (tmp_path / "a.exr").write_bytes(codecs.encode_exr(Z))
    (tmp_path / "a.npy").write_bytes(codecs.encode_npy(ROWS.astype(np.float32)))
    for read in (
        lambda: codecs.read_png(tmp_path / "a.png", (24, 32, 3), np.uint8),
        lambda: codecs.read_png(tmp_path / "a.png", (32, 24), np.uint16),
        lambda: codecs.read_exr(tmp_path / "a.exr", (12, 32)),
        lambda: codecs.read_npy(tmp_path / "a.npy", ROWS.shape),
    ):
        with pytest.raises(UserError, match=r"sequence\.yaml asks for") as error:
            read()
        one_line(error, "a.")


@pytest.mark.parametrize(
    "text", ["a: {b: [1, 2.5e-3, .inf, yes, null, 'x']}\nc: &d [1, *d]", "a: &x {b: 1}\nc: {<<: *x, d: 2020-01-01}", ""]
)
def test_yaml_is_what_pyyaml_reads(text: str) -> None:
    known = text.replace("&d [1, *d]", "&d [1]\ne: *d")  # what stands for itself is refused
    assert files.parse_yaml(known) == yaml.safe_load(known)
    if known != text:
        with pytest.raises(yaml.YAMLError):
            files.parse_yaml(text)


def test_yaml_may_be_nested_as_deep_as_it_likes(tmp_path: Path) -> None:
    """Where libyaml takes the process with it."""
    assert files.parse_yaml("[" * 150 + "]" * 150) == yaml.safe_load("[" * 150 + "]" * 150)
    (tmp_path / "a.yaml").write_text("a: " + "[" * 200_000)
    with pytest.raises(UserError, match="not valid YAML"):
        files.read_yaml(tmp_path / "a.yaml")


def test_other_programs_read_the_images(tmp_path: Path) -> None:
    files.atomic_write(tmp_path / "a.png", codecs.encode_png(RGB))
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    np.testing.assert_array_equal(image[..., ::-1], RGB)
    files.atomic_write(tmp_path / "a.exr", codecs.encode_exr(Z))
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        np.testing.assert_array_equal(file.channels()["Z"].pixels, Z)


def test_an_exr_of_another_program_is_read(tmp_path: Path) -> None:
    with OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, {"Z": Z}) as file:
        file.write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(codecs.read_exr(tmp_path / "a.exr", Z.shape), Z)


def test_the_same_data_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = {"control_points": np.tile(np.eye(4), (5, 1, 1)), "t0": np.array(0.5), "dt": np.array(0.05)}
    first = codecs.encode_npz(arrays), codecs.encode_exr(Z), codecs.encode_png(RGB)
    monkeypatch.setattr("time.time", lambda: 2e9)
    assert (codecs.encode_npz(arrays), codecs.encode_exr(Z.copy()), codecs.encode_png(RGB.copy())) == first


def test_npz_is_what_spline_loads(tmp_path: Path) -> None:
    points = np.tile(np.eye(4), (5, 1, 1))
    points[:, 0, 3] = RNG.random(5)
    files.atomic_write(
        tmp_path / "s.npz", codecs.encode_npz({"control_points": points, "t0": np.array(0.1), "dt": np.array(0.05)})
    )
    spline = Spline.load(tmp_path / "s.npz")
    np.testing.assert_array_equal(spline.control_points, points)
    assert (spline.t0, spline.dt) == (0.1, 0.05)
    with np.load(io.BytesIO(codecs.encode_npz({"a": points}))) as data:
        np.testing.assert_array_equal(data["a"], points)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EDQUOT])
@pytest.mark.parametrize("where", ["open", "write", "replace"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, where: str
) -> None:
    path = tmp_path / "a.bin"
    files.atomic_write(path, b"old")

    def fail(*_: Any, **__: Any) -> Any:
        raise OSError(code, os.strerror(code))

    class Full(io.BytesIO):
        write = fail

    if where == "replace":
        monkeypatch.setattr(os, "replace", fail)
    else:
        opened = fail if where == "open" else lambda self, mode: (self.touch(), Full())[1]
        monkeypatch.setattr(Path, "open", opened)
    with pytest.raises(UserError, match=os.strerror(code)) as error:
        files.atomic_write(path, b"new")
    text = one_line(error, "a.bin")
    assert "--out" in text and "resume" in text
    monkeypatch.undo()
    assert path.read_bytes() == b"old" and names(tmp_path) == ["a.bin"]


def test_a_write_to_a_real_full_disk(tmp_path: Path) -> None:
    """/dev/full refuses every write with ENOSPC; the error text comes from the system itself."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    with pytest.raises(OSError) as raised, Path("/dev/full").open("wb") as file:
        file.write(b"x")
    assert "No space left" in str(files.write_error(tmp_path / "a", raised.value))


def test_an_interrupt_leaves_no_temporary_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        files.atomic_write(tmp_path / "a", b"x")
    assert names(tmp_path) == []


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_a_folder_that_cannot_be_replaced_stays_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def write(content: str) -> None:
        with files.whole_folder(tmp_path / "room") as folder:
            (folder / "a.txt").write_text(content)

    def fail(*_: Any) -> None:
        raise error

    write("old")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises((UserError, KeyboardInterrupt)):
            write("new")
    assert names(tmp_path) == ["room"] and (tmp_path / "room/a.txt").read_text() == "old"
    write("new")
    assert names(tmp_path) == ["room"] and (tmp_path / "room/a.txt").read_text() == "new"


def test_temporaries_of_dead_writers_are_removed_and_others_kept(tmp_path: Path) -> None:
    dead = 2**22 + 5  # above the largest process number of Linux
    for name in (f".a.png.{dead}.tmp", f".b.png.{os.getpid()}.tmp", ".notes.tmp", "c.png"):
        (tmp_path / name).touch()
    files.remove_stale_temporaries(tmp_path)
    assert names(tmp_path) == sorted([f".b.png.{os.getpid()}.tmp", ".notes.tmp", "c.png"])


def test_yaml_floats_survive_and_errors_name_the_line(tmp_path: Path) -> None:
    data = {"a": [1e-300, 0.1, 481.2, -0.0], "b": {"c": "text: with colon", "d": None}, "e": 1e-05}
    (tmp_path / "a.yaml").write_bytes(files.encode_yaml(data))
    assert files.read_yaml(tmp_path / "a.yaml") == data
    (tmp_path / "a.yaml").write_text("a: 1\nb: [1,\nc: 2\n")
    with pytest.raises(UserError, match="line 4"):
        files.read_yaml(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not a text file"):
        files.read_yaml(tmp_path / "a.yaml")


def test_wrong_arrays_are_not_encoded() -> None:
    for encode, image in (
        (codecs.encode_png, Z),
        (codecs.encode_png, RGB[..., :2]),
        (codecs.encode_exr, Z.astype(float)),
    ):
        with pytest.raises(ValueError, match="written from"):
            encode(image)


def test_what_a_library_writes_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "a.rrd"
    with pytest.raises(ValueError, match="midway"), files.whole_file(out) as temporary:
        temporary.write_bytes(b"half")
        assert temporary.suffix == ".rrd" and temporary.parent == tmp_path
        raise ValueError("midway")
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match=r"a\.rrd: cannot be written"), files.whole_file(out):
        raise OSError(28, "No space left on device")
    with files.whole_file(out) as temporary:
        temporary.write_bytes(b"whole")
        assert not out.exists()
    assert out.read_bytes() == b"whole" and list(tmp_path.iterdir()) == [out]
