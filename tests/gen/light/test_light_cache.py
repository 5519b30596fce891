"""Baked light is the same bytes again, and kept in a cache."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lit import (
    CORNELL,
    FLOOR,
    POINT,
    bake,
    scene_of,
    silent,
)

from rsgen.config.config import LightConfig
from rsgen.errors import UserError
from rsgen.light import bake as lighting
from rsgen.render.irradiance import IrradianceField, make_lattice
from rsgen.scene.loading import load_scene


def test_a_bake_is_deterministic(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, *CORNELL)
    reloaded = load_scene(tmp_path / "scene.xml")
    first, again = (bake(s, texel_m=0.15, bounces=2, gather_rays=32, direct_samples=16) for s in (scene, reloaded))
    assert first[1].tobytes() == again[1].tobytes() and first[2].tobytes() == again[2].tobytes()


LIGHT = LightConfig(texel_m=0.2, direct_samples=4, gather_rays=16, bounces=0)


def values_of(field: IrradianceField) -> np.ndarray:
    return np.array(field.values)


def test_the_second_call_loads_what_the_first_baked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(tmp_path, FLOOR, POINT)
    cache = tmp_path / "deep" / "cache"
    baked = lighting.baked_field(scene, "hash", LIGHT, cache, silent)
    assert len(list(cache.iterdir())) == 1  # no temporary file is left

    def fail(*_: Any) -> Any:
        raise AssertionError("baked again")

    with monkeypatch.context() as patch:
        patch.setattr(lighting, "bake", fail)
        loaded = lighting.baked_field(scene, "hash", LIGHT, cache, silent)
        np.testing.assert_array_equal(values_of(loaded), values_of(baked))
        with pytest.raises(AssertionError, match="baked again"):
            lighting.baked_field(scene, "another hash", LIGHT, cache, silent)

    # A damaged file is baked again and mended: truncated, garbage, empty, of another scene's size.
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, front=np.zeros((3, 4)), back=np.zeros((3, 4)))
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0xFF
    for damage in (whole[: len(whole) // 2], b"garbage", b"", wrong.read_bytes(), bytes(flipped)):
        file.write_bytes(damage)
        mended = lighting.baked_field(scene, "hash", LIGHT, cache, silent)
        np.testing.assert_array_equal(values_of(mended), values_of(baked))
        assert file.read_bytes() != damage


def test_the_caches_key_depends_on_all_that_decides_the_light() -> None:
    keys = [lighting.cache_key("scene", LIGHT), lighting.cache_key("other scene", LIGHT)]
    for name, value in {
        "texel_m": 0.3,
        "direct_samples": 5,
        "target_db": 41.0,
        "gather_rays": 17,
        "bounces": 1,
    }.items():
        keys.append(lighting.cache_key("scene", LIGHT.model_copy(update={name: value})))
    assert len(set(keys)) == len(keys)
    content = {"texel_m", "direct_samples", "target_db", "gather_rays", "bounces"}
    assert content | {"mode", "max_depth", "glossy_spp"} == set(LightConfig.model_fields)
    assert lighting.cache_key("scene", LIGHT.model_copy(update={"glossy_spp": 3})) == keys[0]
    # The reference integrator's settings do not touch the bake.
    assert lighting.cache_key("scene", LIGHT.model_copy(update={"max_depth": 3})) == keys[0]
    assert lighting.cache_key("scene", LIGHT) == keys[0]


def test_a_cache_that_cannot_be_written_only_warns(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = scene_of(tmp_path, FLOOR, POINT)
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with caplog.at_level(logging.WARNING, "rsgen"):
        field = lighting.baked_field(scene, "hash", LIGHT, blocked / "cache", silent)
    assert values_of(field).max() > 0
    assert len(caplog.records) == 1 and "cannot be written" in caplog.text


def test_the_cache_lies_beside_the_scene_or_in_the_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert lighting.cache_folder(tmp_path / "scene.xml") == tmp_path / ".rsgen-cache"
    monkeypatch.setattr(lighting.os, "access", lambda *_: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert lighting.cache_folder(tmp_path / "scene.xml") == tmp_path / "home" / "rsgen"


def test_a_dark_scene_is_an_error(tmp_path: Path) -> None:
    behind = POINT.replace('z="0.8"', 'z="5"').replace("1,2,4", "0")
    with pytest.raises(UserError, match="dark") as caught:
        bake(scene_of(tmp_path, FLOOR, behind))
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="dark"):
        bake(scene_of(tmp_path, FLOOR))


def test_progress_grows_to_one(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, FLOOR, POINT)
    seen: list[float] = []
    light = LIGHT.model_copy(update={"bounces": 3})
    lighting.bake(scene, make_lattice(scene, 0.1), light, lambda stage, fraction, note: seen.append(fraction))
    assert seen == sorted(seen) and seen[0] >= 0 and seen[-1] == 1.0
