"""The gallery: its page is what gallery.yaml lists, its pictures are there and small, and show what they say."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from synthetic import make_sequence

from benchmarks import gallery
from rsgen.console.configs import config_file
from rsgen.sequence.reader import read_sequence

ENTRIES = [entry for listed in gallery.entries().values() for entry in listed]


def test_the_page_is_what_is_listed_and_every_picture_is_there_and_small() -> None:
    assert gallery.PAGE.read_text() == gallery.page(), "python -m benchmarks.gallery writes it anew"
    pictures = {path.stem: path for path in gallery.PICTURES.iterdir()}
    assert set(pictures) == {entry.name for entry in ENTRIES} and len(ENTRIES) == len(pictures)
    assert sum(path.stat().st_size for path in pictures.values()) < 400_000
    assert {Image.open(path).size for path in pictures.values()} == {(2 * gallery.WIDTH + gallery.GAP, gallery.HEIGHT)}


def test_every_config_of_it_ships() -> None:
    assert len(ENTRIES) > 8 and all(config_file(entry.config).is_file() for entry in ENTRIES)


def test_a_picture_has_its_two_panels(tmp_path: Path) -> None:
    sequence = read_sequence(make_sequence(tmp_path / "box", frames=1))
    drawn = Image.open(io.BytesIO(gallery.picture(replace(ENTRIES[0], panels=("color", "depth"), zoom=1), sequence)))
    image = np.asarray(drawn).astype(float)
    left, right = image[:, : gallery.WIDTH], image[:, -gallery.WIDTH :]
    wanted = np.asarray(Image.fromarray(sequence.color(0)).resize((gallery.WIDTH, gallery.HEIGHT))).astype(float)
    assert np.corrcoef(left.ravel(), wanted.ravel())[0, 1] > 0.95
    assert np.abs(left - right).mean() > 20


def test_a_zoomed_picture_shows_the_middle(tmp_path: Path) -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    image[120:360, 160:480] = 255
    assert (gallery._resized(image, 2) == 255).all() and not gallery._resized(image, 1)[:50].any()


def test_depth_is_dark_where_it_is_near_and_white_where_there_is_none() -> None:
    z = np.array([[0.0, 1.0, 2.0, 3.0]], np.float32)
    colors = gallery._colored(z, np.array([[1.0, 1.0, 2.0, 3.0]], np.float32)).astype(int).sum(axis=-1)[0]
    assert colors[0] == 3 * 255 and colors[1] < colors[2] < colors[3]


def test_hue_of_flow_is_its_direction_and_what_moves_is_tinted() -> None:
    flow = np.array([[[3, 0, 1], [-3, 0, 1], [0, 0, 1], [3, 0, 0]]], np.float32)
    right, left, still, invalid = gallery._flow(flow)[0].astype(int)
    assert right[0] > right[2] and left[0] < left[2]
    assert np.ptp(still) == 0 and still[0] == 255 and not invalid.any()
    tinted = gallery._tinted(np.full((1, 2, 3), 90, np.uint8), np.array([[0, 1]], np.uint8))
    assert (tinted[0, 0] == 90).all() and np.ptp(tinted[0, 1].astype(int)) > 20


def test_wrong_words_are_answered(capsys: pytest.CaptureFixture[str]) -> None:
    assert gallery.main(["--render", "no-such-room"]) == 2 and gallery.main(["x"]) == 2
    assert "living_room" in capsys.readouterr().err
