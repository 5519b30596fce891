"""What a suite is published with: README.md with Hugging Face's front matter, croissant.json, and thumbnails.

Croissant 1.0: https://docs.mlcommons.org/croissant/docs/croissant-spec.html; Hugging Face's front matter:
https://huggingface.co/docs/hub/datasets-cards.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, read_yaml
from rsgen.image_codecs import decoded
from rsgen.suite.definition import SUITE
from rsgen.suite.manifest import MANIFEST, FileRecord, read_manifest, sha256_of

_THUMBNAIL_PX = 240
# Hugging Face's classes by the number of rows, here images: below so many, so it is called.
_SIZES = ((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M"), (1e7, "1M<n<10M"))
# Sets of files within a sequence: name, glob, type, what.
_SETS = (
    ("color", "*/rgb/*.png", "image/png", "colour images, 8-bit sRGB"),
    ("depth", "*/depth/*.png", "image/png", "what the depth sensor reports, 16 bits, depth_scale units per metre"),
    ("exact-depth", "*/truth/depth/*.exr", "image/x-exr", "exact planar depth, float32, m, same pixels as depth"),
    ("trajectories", "*/groundtruth.txt", "text/plain", "TUM poses T_world_depth: stamp tx ty tz qx qy qz qw"),
    ("splines", "*/spline.npz", "application/x-npz", "the exact continuous-time ground truth"),
)
_CONTEXT = {
    "@language": "en", "@vocab": "https://schema.org/", "citeAs": "cr:citeAs", "column": "cr:column",
    "conformsTo": "dct:conformsTo", "cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"}, "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/", "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"}, "extract": "cr:extract", "field": "cr:field",
    "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject", "fileSet": "cr:fileSet", "format": "cr:format",
    "includes": "cr:includes", "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath", "key": "cr:key",
    "md5": "cr:md5", "parentField": "cr:parentField", "path": "cr:path", "recordSet": "cr:recordSet",
    "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated", "replace": "cr:replace",
    "samplingRate": "cr:samplingRate", "sc": "https://schema.org/", "separator": "cr:separator", "source": "cr:source",
    "subField": "cr:subField", "transform": "cr:transform",
}  # fmt: skip


def write_card(folder: Path) -> list[Path]:
    """Write README.md, croissant.json and thumbnails/NAME.jpg; returns their paths.

    Raises UserError: the folder is no finished suite, or cannot be written.
    """
    files, suite = read_manifest(folder), read_yaml(folder / SUITE)
    entries = [e for e in suite["entries"] if any(name.startswith(f"{e['name']}/") for name in files)]
    thumbnails = folder / "thumbnails"
    thumbnails.mkdir(exist_ok=True)
    written = []
    for entry in entries:
        if (picture := _thumbnail(folder, str(entry["name"]), files)) is not None:
            atomic_write(thumbnails / f"{entry['name']}.jpg", picture)
            written.append(thumbnails / f"{entry['name']}.jpg")
    atomic_write(folder / "README.md", readme(suite, entries, files).encode())
    data = croissant(suite, entries, {name: sha256_of(folder / name) for name in (MANIFEST, SUITE)})
    atomic_write(folder / "croissant.json", (json.dumps(data, indent=1) + "\n").encode())
    return [folder / "README.md", folder / "croissant.json", *written[:1]]


def readme(suite: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], files: Mapping[str, FileRecord]) -> str:
    """The dataset card. entries: of sequences that are there."""
    images = _images(files)
    tiers = dict.fromkeys(str(entry["tier"]) for entry in entries)
    front = {
        "pretty_name": f"{suite['name']} {suite['version']}",
        "license": str(suite["license"]).lower(),
        "task_categories": ["depth-estimation", "other"],
        "tags": ["slam", "visual-odometry", "rgb-d", "rolling-shutter", "motion-blur", "imu", "synthetic"],
        "size_categories": [next((name for below, name in _SIZES if images < below), "n>10M")],
        "configs": [{"config_name": tier, "data_files": _splits(entries, tier)} for tier in tiers],
    }
    size = sum(record.size for record in files.values() if not record.held_back) / 1e9
    lines = ["---", encode_yaml(front).decode().rstrip(), "---", "", f"# {suite['name']} {suite['version']}", ""]
    lines += [str(suite["about"]), ""]
    lines.append(f"{len(entries)} sequences, {images} images of colour and depth, {size:.2g} GB, {suite['license']}.")
    if suite.get("truth") != "whole":
        lines += ["", "The truth of test sequences is held back: they have images, listings and a camera.yaml."]
    lines += [
        "",
        "Each folder is one sequence: TUM's listings and images, `sequence.yaml` (cameras, readout, exposure, scan), "
        "and the truth: `groundtruth.txt`, `spline.npz` (the continuous trajectory), `truth/` (exact depth, the pose "
        f"of every image line). `{SUITE}` says what each is, `{MANIFEST}` has every file's size and SHA-256, and how "
        "it has to match where somebody renders the suite again.",
        "",
        "```",
        "rsgen suite verify .                     # is this copy whole?",
        "rstrack score . RESULTS --out board      # trajectories of any tracker, RESULTS/METHOD/NAME.txt",
        "```",
    ]
    for tier in tiers:
        rows = [entry for entry in entries if entry["tier"] == tier]
        lines += [
            "",
            f"## Tier {tier}",
            "",
            "| | sequence | role | group | room | readout, ms |",
            "|---|---|---|---|---|---|",
        ]
        lines += [_row(entry) for entry in rows]
    return "\n".join(lines) + "\n"


def croissant(
    suite: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], hashes: Mapping[str, str]
) -> dict[str, Any]:
    """Croissant 1.0 metadata: the files by kind, and a record of each sequence. hashes: SHA-256 of files by name."""
    types = {MANIFEST: "application/json", SUITE: "application/yaml"}
    objects = [
        {"@type": "cr:FileObject", "@id": name, "name": name, "contentUrl": name, "encodingFormat": types[name],
         "sha256": sha256}
        for name, sha256 in hashes.items()
    ]  # fmt: skip
    sets = [
        {
            "@type": "cr:FileSet",
            "@id": name,
            "name": name,
            "description": what,
            "encodingFormat": kind,
            "includes": glob,
        }
        for name, glob, kind, what in _SETS
    ]
    names = ("name", "tier", "role", "group", "scene")
    records = [{f"sequences/{field}": str(entry.get(field, "")) for field in names} for entry in entries]
    fields = [_field(f"sequences/{name}", f"{name} of a sequence, as in {SUITE}") for name in names]
    images = [
        _field("images/path", "of a colour image", source={"fileSet": {"@id": "color"},
               "extract": {"fileProperty": "fullpath"}}),
        _field("images/image", "the colour image", "sc:ImageObject", source={"fileSet": {"@id": "color"},
               "extract": {"fileProperty": "content"}}),
    ]  # fmt: skip
    return {
        "@context": _CONTEXT, "@type": "sc:Dataset", "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": str(suite["name"]), "description": str(suite["about"]), "version": _semantic(str(suite["version"])),
        "license": f"https://spdx.org/licenses/{suite['license']}.html", "url": str(suite.get("homepage") or "."),
        "distribution": objects + sets,
        "recordSet": [
            {"@type": "cr:RecordSet", "@id": "sequences", "name": "sequences", "key": {"@id": "sequences/name"},
             "field": fields, "data": records},
            {"@type": "cr:RecordSet", "@id": "images", "name": "images", "field": images},
        ],
    }  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------------


def _field(id: str, description: str, type: str = "sc:Text", **more: Any) -> dict[str, Any]:
    return {"@type": "cr:Field", "@id": id, "name": id, "description": description, "dataType": type, **more}


def _semantic(version: str) -> str:
    """Three numbers, as Croissant wants them."""
    return ".".join([*version.split("."), "0", "0"][:3])


def _splits(entries: Sequence[Mapping[str, Any]], tier: str) -> list[dict[str, Any]]:
    splits = []
    for role in ("train", "test"):
        names = [entry["name"] for entry in entries if (entry["tier"], entry["role"]) == (tier, role)]
        if names:
            splits.append({"split": role, "path": [f"{name}/rgb/*.png" for name in names]})
    return splits


def _images(files: Mapping[str, FileRecord]) -> int:
    """Of colour, grey and depth cameras, truth left out."""
    return sum(name.endswith(".png") and "/truth/" not in name for name in files)


def _row(entry: Mapping[str, Any]) -> str:
    readouts = ", ".join(f"{ms:g}" for ms in dict.fromkeys(entry["readout_ms"].values()))
    name = entry["name"]
    words = (f"![](thumbnails/{name}.jpg)", f"`{name}`", entry["role"], entry["group"], entry["scene"], readouts)
    return f"| {' | '.join(map(str, words))} |"


def _thumbnail(folder: Path, name: str, files: Mapping[str, FileRecord]) -> bytes | None:
    """JPEG of a sequence's middle 8-bit image; None where it has none."""
    images = [file for file, record in files.items()
              if file.startswith(f"{name}/") and record.match == "image" and "/truth/" not in file]  # fmt: skip
    if not images:
        return None
    path = folder / images[len(images) // 2]
    if not path.is_file() or (image := decoded(path.read_bytes())) is None:
        raise UserError(f"{path}: is missing or damaged: copy it again (rsgen suite verify {folder} says what else)")
    height = round(image.shape[0] * _THUMBNAIL_PX / image.shape[1])
    small = cv2.resize(image, (_THUMBNAIL_PX, height), interpolation=cv2.INTER_AREA)
    return bytes(np.asarray(cv2.imencode(".jpg", small)[1]))
