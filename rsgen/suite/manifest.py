"""Every file of a suite with its size and SHA-256, and how it has to match on another machine; and whether it does.

Rendered on another type of machine, numbers differ in their last bits: pixels at edges show the other surface, which
noise makes a level more. What each file may differ by is stated with it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from rsgen.errors import UserError
from rsgen.files import atomic_write, is_temporary, read_text, read_yaml
from rsgen.image_codecs import decoded
from rsgen.produce.generate import ORIGIN

FORMAT = "rsgen-manifest/1"
MANIFEST = "manifest.json"
_LEAST_DB = 40.0


@dataclass(frozen=True)
class FileRecord:
    """size: bytes. match: a name of _RULES. held_back: left out where truth is held back."""

    size: int
    sha256: str
    match: str
    held_back: bool = False


def rule_of(path: Path) -> str:
    """The rule of a file of a sequence. Raises OSError."""
    if path.name == "sequence.yaml":
        return "description"
    if path.name.startswith("boxes"):
        return "boxes"
    if path.parent.name in ("labels", "depth_labels"):
        return "labels"
    if path.suffix == ".png":
        with path.open("rb") as file:
            return "sensor" if file.read(25)[-1:] == b"\x10" else "image"  # bits a channel
    if path.suffix == ".exr":
        return "depth" if path.parent.name in ("depth", "color_depth") else "truth"
    if path.suffix == ".ply":
        return "surface"
    return "numbers" if path.suffix in (".npy", ".npz", ".csv") or path.name == "groundtruth.txt" else "exact"


def sha256_of(path: Path) -> str:
    """Hexadecimal. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def record_files(folder: Path) -> dict[str, FileRecord]:
    """All files of a sequence by their paths within it, but for what belongs to this machine. Raises OSError."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not is_temporary(path))
    names = {path.relative_to(folder).as_posix(): path for path in files if path.name != ORIGIN}
    return {name: FileRecord(path.stat().st_size, sha256_of(path), rule_of(path)) for name, path in names.items()}


def write_manifest(folder: Path, about: Mapping[str, str], files: Mapping[str, FileRecord]) -> None:
    """Write manifest.json, a line a file, in order; whole or not at all. Raises UserError."""
    rules = {name: words for name, (words, _) in _RULES.items()}
    head = json.dumps({"format": FORMAT, **about, "rules": rules}, indent=1)[:-2]
    rows = (f"  {json.dumps(path)}: {json.dumps(_record(files[path]))}" for path in sorted(files))
    atomic_write(folder / MANIFEST, (head + ',\n "files": {\n' + ",\n".join(rows) + "\n }\n}\n").encode())


def read_manifest(folder: Path) -> dict[str, FileRecord]:
    """Files by their paths within the suite's folder. Raises UserError: there is none, or it is none of ours."""
    path = folder / MANIFEST
    if not path.is_file():
        raise UserError(f"{folder}: has no {MANIFEST}: name a folder that 'rsgen suite render' has finished")
    try:
        data = json.loads(read_text(path))
        if data["format"] != FORMAT:
            raise UserError(f"{path}: format {data['format']!r}; this program reads {FORMAT}")
        return {_within(path, name): FileRecord(**record) for name, record in data["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UserError(f"{path}: is damaged: copy it again") from None


def verify(folder: Path, files: Mapping[str, FileRecord]) -> list[str]:
    """A line for each file of a copy that is missing or another one; files held back may be missing."""
    return _faults(files, lambda name, record: _copy_fault(folder / name, record))


def compare(folder: Path, other: Path, files: Mapping[str, FileRecord]) -> list[str]:
    """A line for each file of `folder` that does not match that of another rendering as its rule wants it."""
    return _faults(files, lambda name, record: _match_fault(folder / name, other / name, record))


# ---------------------------------------------------------------------------------------------------------------------


def _record(record: FileRecord) -> dict[str, Any]:
    return {name: value for name, value in asdict(record).items() if name != "held_back" or value}


def _within(manifest: Path, name: str) -> str:
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise UserError(f"{manifest}: path {name[:200]!r} leaves the folder")
    return name


def _faults(files: Mapping[str, FileRecord], check: Callable[[str, FileRecord], str | None]) -> list[str]:
    with ThreadPoolExecutor() as pool:
        found: Iterable[str | None] = pool.map(check, files, files.values())
        return [f"{name}: {fault}" for name, fault in zip(files, found, strict=True) if fault is not None]


def _copy_fault(path: Path, record: FileRecord) -> str | None:
    try:
        size = path.stat().st_size
        if size != record.size:
            return f"has {size} bytes, not {record.size}"
        return None if sha256_of(path) == record.sha256 else "has the right size and other bytes"
    except FileNotFoundError:
        return None if record.held_back else "is missing"
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _match_fault(mine: Path, theirs: Path, record: FileRecord) -> str | None:
    missing = [path for path in (mine, theirs) if not path.is_file()]
    if missing:
        return None if record.held_back else f"{missing[0]} is missing"
    try:
        same = mine.read_bytes() == theirs.read_bytes()
        return None if same else _RULES[record.match][1](mine, theirs)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        return f"cannot be compared ({str(error).splitlines()[0][:80]})"


def _description(a: Path, b: Path) -> str | None:
    mine, theirs = read_yaml(a), read_yaml(b)
    names = {*mine, *theirs} - {"versions", "inputs", "fingerprint"}
    other = sorted(name for name in names if mine.get(name) != theirs.get(name))
    return f"has another {other[0]}" if other else None


def _numbers(a: Path, b: Path) -> str | None:
    mine, theirs = _parsed(a), _parsed(b)
    if [x.shape for x in mine] != [x.shape for x in theirs]:
        return "has other shapes"
    most = max((float(np.abs(x - y).max()) for x, y in zip(mine, theirs, strict=True) if x.size), default=0.0)
    return None if most <= 1e-8 else f"differs by {most:.3g}"


def _parsed(path: Path) -> list[NDArray[Any]]:
    """Arrays of .npy and .npz, or all numbers of a text, a row a line."""
    if path.suffix in (".npy", ".npz"):
        loaded = np.load(path)
        return [loaded] if path.suffix == ".npy" else [loaded[name] for name in sorted(loaded)]
    lines = (line for line in read_text(path).splitlines() if line and not line.startswith("#"))
    return [np.array([line.replace(",", " ").split() for line in lines], float)]


def _image(a: Path, b: Path) -> str | None:
    mine, theirs = _pixels(a), _pixels(b)
    if mine.shape != theirs.shape:
        return "has another size"
    db = 10 * np.log10(255.0**2 / max(float(np.mean((mine - theirs) ** 2)), 1e-12))
    return None if db >= _LEAST_DB else f"PSNR {db:.1f} dB, less than {_LEAST_DB:g}"


def _truth(a: Path, b: Path) -> str | None:
    return _share(a, b, 1e-3 * max(1.0, float(np.abs(_pixels(a)).max())), 0.99, "0.001 of the largest")


def _pixels(path: Path) -> NDArray[Any]:
    """Of a PNG as OpenCV has it, or of an EXR, its channels by name."""
    if path.suffix == ".exr":
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            return np.nan_to_num(np.stack([channels[name].pixels.astype(float) for name in sorted(channels)], axis=-1))
    if (image := decoded(path.read_bytes())) is None:
        raise ValueError("no picture")
    return image.astype(float)


def _share(a: Path, b: Path, within: float, least: float, words: str) -> str | None:
    mine, theirs = _pixels(a), _pixels(b)
    if mine.shape != theirs.shape:
        return "has another size"
    share = float((np.abs(mine - theirs) <= within).mean())
    return None if share >= least else f"{100 * share:.2f} % of pixels are within {words}, less than {100 * least:g} %"


def _surface(a: Path, b: Path) -> str | None:
    sizes = a.stat().st_size, b.stat().st_size
    return None if sizes[0] == sizes[1] else f"has {sizes[0]} bytes, not {sizes[1]}"


# Every rule by its name: in words, and what it finds wrong with two files whose bytes differ.
_RULES: dict[str, tuple[str, Callable[[Path, Path], str | None]]] = {
    "exact": ("the same bytes", lambda *_: "has other bytes"),
    "description": ("the same but for versions, hashes of inputs and the fingerprint over both", _description),
    "numbers": ("the same text and shapes, numbers within 1e-8: a fit's last bits, or the last decimal", _numbers),
    "depth": (
        "metres within 0.1 mm in 99.9 % of pixels: at edges another surface may be seen",
        lambda a, b: _share(a, b, 1e-4, 0.999, "0.1 mm"),
    ),
    "labels": ("the same thing in 99 % of pixels", lambda a, b: _share(a, b, 0.0, 0.99, "the same thing")),
    "boxes": ("made from labels, which are compared themselves", lambda *_: None),
    "sensor": (
        "16-bit depth, the same within two units in 99 % of pixels",
        lambda a, b: _share(a, b, 2.0, 0.99, "two units"),
    ),
    "image": ("8 bits, PSNR 40 dB or more", _image),
    "truth": ("of 99 % of pixels within 0.001 of the channel's largest value", _truth),
    "surface": ("the same number of bytes: vertices may differ in their last bits", _surface),
}
