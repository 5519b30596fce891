"""Hostile USD files."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import hostile
import numpy as np
from hostile_cases import Base, Case, of_8_gb, piped, replaced_by, text_edited

from rsgen.formats.scenes.import_scene import import_scene
from rsgen.image_codecs import encode_png


def usd(folder: Path) -> Iterator[Case]:
    """Scenes that `rsgen import` reads by way of USD, as text, binary and in a zip."""
    from pxr import Usd, UsdUtils

    folder.mkdir(parents=True, exist_ok=True)
    text = folder / "usda"
    text.mkdir()
    (text / "paint.png").write_bytes(encode_png(np.full((8, 8, 3), 90, np.uint8)))
    (text / "room.usda").write_text(_USDA)
    binary, packed = folder / "usdc", folder / "usdz"
    for made in (binary, packed):
        made.mkdir()
    shutil.copy(text / "paint.png", binary / "paint.png")
    assert Usd.Stage.Open(str(text / "room.usda")).Export(str(binary / "room.usdc"))
    assert UsdUtils.CreateNewUsdzPackage(str(text / "room.usda"), str(packed / "room.usdz"))
    for kind, every in (("usda", 1), ("usdc", 1), ("usdz", 1)):
        base = Base("usd", folder / kind, lambda path, out, kind=kind: import_scene(path / f"room.{kind}", out))  # type: ignore[misc]
        yield from base.damaged(f"room.{kind}", every)
        yield base.case("8 GB", of_8_gb(f"room.{kind}"), kind == "usda")  # binary files are not read whole
        yield base.case("a pipe", piped(f"room.{kind}"))
    base = Base("usd", text, lambda path, out: import_scene(path / "room.usda", out))
    for name, old, new, refused in (
        ("2^31 corners", "[4]", "[2147483647]", True),
        ("-1 corners", "[4]", "[-1]", True),
        ("corners of no point", "[0, 1, 2, 3]", "[0, 1, 2, 2147483647]", True),
        ("corners below 0", "[0, 1, 2, 3]", "[0, 1, 2, -2147483648]", True),
        ("a point at infinity", "(1, 0, 1)", "(inf, 0, 1)", True),
        ("a point at 1e300", "(1, 0, 1)", "(1e300, 0, 1)", True),
        ("itself within itself", "def Mesh", 'def "R" (references = @room.usda@) {}\ndef Mesh', False),
        ("a secret within it", "def Mesh", 'def "R" (references = @../../beside/secret.txt@) {}\ndef Mesh', False),
        ("a device within it", "def Mesh", 'def "R" (references = @/dev/zero@) {}\ndef Mesh', False),
        ("a texture that is a device", "@paint.png@", "@/dev/zero@", False),
        ("a texture that is a secret", "@paint.png@", "@../../beside/secret.txt@", False),
        ("a name of 100,000 letters", '"Square"', f'"{"S" * 100_000}"', False),
        ("nested 3,000 deep", "def Mesh", 'def "N" {\n' * 3000 + "}\n" * 3000 + "def Mesh", False),
        ("nested 100,000 deep, unclosed", "def Mesh", 'def "N" {\n' * 100_000 + "def Mesh", True),
    ):
        yield base.case(name, text_edited("room.usda", old, new), refused)
    for name, data in (("670 MB", hostile.png_bomb(False)), ("430 MB", hostile.png_bomb(True))):
        yield base.case(f"a texture of {name}", replaced_by("paint.png", data), False)
    yield base.case("a texture that is a pipe", piped("paint.png"), False)


_USDA = """#usda 1.0
(
    upAxis = "Y"
    metersPerUnit = 1
)
def Material "Paint" {
    token outputs:surface.connect = </Paint/Surface.outputs:surface>
    def Shader "Surface" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </Paint/Image.outputs:rgb>
        token outputs:surface
    }
    def Shader "Image" {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @paint.png@
        float3 outputs:rgb
    }
}
def Mesh "Square" (prepend apiSchemas = ["MaterialBindingAPI"]) {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)]
    rel material:binding = </Paint>
}
"""
