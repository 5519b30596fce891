"""Sequences of benchmarks: rendered once into the cache, and again when what they are made of changes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import yaml

from rsgen.config.config import load_config
from rsgen.console.configs import config_file, scaled
from rsgen.errors import UserError
from rstrack.bench.cells import SequenceEntry
from rstrack.bench.task import Absent, Sources, run_rsgen


class Renderer:
    """Stands for rsgen: notes the words, and writes a small sequence of so many frames."""

    def __init__(self) -> None:
        self.called: list[list[str]] = []

    def __call__(self, words: Sequence[str]) -> None:
        self.called.append(list(words))
        synthetic.make_sequence(Path(words[words.index("--out") + 1]), synthetic.make_config(), 4)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump({"name": "tiny", "trajectory": {"file": "motion.txt"}}))
    (tmp_path / "motion.txt").write_text("0 0 0 0 0 0 0 1\n")
    return path


def entry(config: Path, **fields: Any) -> SequenceEntry:
    return SequenceEntry(config=config, **({"frames": "0:4"} | fields))


def test_rendering_happens_once_and_again_when_something_changes(tmp_path: Path, config: Path) -> None:
    render = Renderer()
    sources = Sources(cache=tmp_path / "cache", render=render, scheduler="local:2")
    first = sources.folder(entry(config), "tiny")
    assert sources.folder(entry(config), "tiny") == first and first.parent == tmp_path / "cache/sequences"
    assert len(render.called) == 1 and render.called[0][-2:] == ["--scheduler", "local:2"]
    assert render.called[0][3:5] == ["--frames", "0:4"]
    others = [entry(config, set={"color.spp": 4}), entry(config, set={"color.spp": 8}), entry(config, frames="0:3")]
    folders = {first, *(sources.folder(other, "tiny") for other in others)}
    assert len(folders) == 4 == len(render.called) and "--color.spp 8" in " ".join(render.called[2])
    # What only names it differently is no other sequence.
    assert sources.folder(entry(config, group="other"), "tiny") == first
    (tmp_path / "motion.txt").write_text("0 0 0 1 0 0 0 1\n")
    assert sources.folder(entry(config), "tiny") not in folders
    config.write_text(config.read_text() + "seed: 3\n")
    sources.folder(entry(config), "tiny")
    assert len(render.called) == 6


def test_what_is_not_whole_is_finished(tmp_path: Path, config: Path) -> None:
    render = Renderer()
    sources = Sources(cache=tmp_path, render=render)
    assert not sources.found(entry(config), "tiny") and render.called == []
    folder = sources.folder(entry(config), "tiny")
    assert sources.found(entry(config), "tiny")
    for count, stream in enumerate(("rgb", "depth"), 2):
        sorted((folder / stream).glob("*.png"))[-1].unlink()
        assert not sources.found(entry(config), "tiny")
        assert sources.folder(entry(config), "tiny") == folder and len(render.called) == count
        assert sources.found(entry(config), "tiny")


def test_a_camera_may_drop_frames(tmp_path: Path, config: Path) -> None:
    """Regression: such a sequence was rendered again for every cell."""
    render = Renderer()
    sources = Sources(cache=tmp_path, render=render)
    folder = sources.folder(entry(config), "tiny")
    listing = folder / "depth.txt"
    listing.write_text("".join(listing.read_text().splitlines(keepends=True)[:-1]))
    assert sources.found(entry(config), "tiny") and len(render.called) == 1


def test_an_interrupted_render_is_not_taken_for_a_whole_one(tmp_path: Path, config: Path) -> None:
    def broken(words: Sequence[str]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Sources(cache=tmp_path, render=broken).folder(entry(config), "tiny")
    assert not Sources(cache=tmp_path).found(entry(config), "tiny")


def test_recordings_lie_in_the_folder_of_data(tmp_path: Path, config: Path) -> None:
    (tmp_path / "data/desk").mkdir(parents=True)
    sources = Sources(data=tmp_path / "data")
    assert sources.folder(SequenceEntry(path=Path("desk")), "desk") == (tmp_path / "data/desk").resolve()
    with pytest.raises(Absent, match="nowhere: is not there"):
        sources.folder(SequenceEntry(path=Path("nowhere")), "desk")
    with pytest.raises(Absent, match="--data DIR"):
        Sources().folder(SequenceEntry(path=Path("desk")), "desk")
    with pytest.raises(Absent, match=r"gt\.txt: is not there"):
        sources.folder(entry(config, data={"trajectory.file": "gt.txt"}), "tiny")


def test_files_of_data_are_fields_of_the_config(tmp_path: Path, config: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data/gt.txt").write_text("0 0 0 0 0 0 0 1\n")
    words = Sources(data=tmp_path / "data").words(entry(config, data={"trajectory.file": "gt.txt"}))
    assert json.loads(words[words.index("--trajectory.file") + 1]) == str((tmp_path / "data/gt.txt").resolve())


@pytest.mark.parametrize("name", ["demo", "lr_kt2"])
def test_scaled_images_show_the_same(name: str) -> None:
    path = config_file(name)
    fields = scaled(path, yaml.safe_load(path.read_text()), 160)
    small, whole = load_config(path, {key: json.dumps(value) for key, value in fields.items()}), load_config(path)
    for stream in ("color", "depth"):
        a, b = getattr(small, stream).camera, getattr(whole, stream).camera
        assert a.width == 160
        ends = [np.array([[-0.5, -0.5], [c.width - 0.5, c.height - 0.5]]) for c in (a, b)]
        np.testing.assert_allclose(a.unproject(ends[0]), b.unproject(ends[1]), atol=1e-6)


def test_a_config_without_a_size_cannot_be_scaled() -> None:
    with pytest.raises(UserError, match=r"^mine\.yaml: color: width[^\n]*$"):
        scaled(Path("mine.yaml"), {"color": {}}, 160)


def test_what_rsgen_complains_of_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "wrong.yaml").write_text("name: wrong\nscene: {}\n")
    with pytest.raises(UserError, match=r"^rsgen render .*wrong.yaml failed: [^\n]*$"):
        run_rsgen(["render", str(tmp_path / "wrong.yaml"), "--out", str(tmp_path / "out")])
