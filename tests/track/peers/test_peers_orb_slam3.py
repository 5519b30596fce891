"""ORB-SLAM3 as a peer: its vocabulary, settings, and what becomes of its process; itself only where it is installed."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.peers import orb_slam3
from rstrack.peers.orb_slam3 import (
    BYTES,
    Vocabulary,
    orb_descriptors,
    settings_text,
    train_vocabulary,
    write_vocabulary,
)
from rstrack.peers.orb_slam3_worker import work
from rstrack.peers.peer import run_logged


def clustered(rng: np.random.Generator, clusters: int = 12, each: int = 40) -> list[np.ndarray]:
    """Images of descriptors about 12 far centres, a few bits off each; each image shows all but one of them."""
    centres = rng.integers(0, 256, (clusters, BYTES), dtype=np.uint8)
    images = []
    for left_out in range(clusters):
        rows = [centres[k] for k in range(clusters) if k != left_out for _ in range(each // 10)]
        bits = np.unpackbits(np.array(rows), axis=1)
        flips = rng.random(bits.shape) < 0.01
        images.append(np.packbits(bits ^ flips, axis=1))
    return images


def words_of(vocabulary: Vocabulary, descriptor: np.ndarray) -> int:
    """Node of the word that DBoW2 gives a descriptor: down the tree, to the nearest child each time."""
    node = 0
    while True:
        children = np.flatnonzero(vocabulary.parent == node)
        if not len(children):
            return node
        far = np.unpackbits(vocabulary.descriptor[children] ^ descriptor, axis=1).sum(axis=1)
        node = int(children[far.argmin()]) + 1


def test_the_tree_tells_clusters_apart_and_weighs_them_by_how_rare_they_are() -> None:
    images = clustered(np.random.default_rng(1))
    tree = train_vocabulary(images, branches=4, levels=2, seed=0)
    assert (tree.parent < np.arange(1, len(tree.parent) + 1)).all()  # parents come first
    assert len(np.unique(tree.parent)) > 2 and np.bincount(tree.parent).max() <= 4
    assert not np.isin(np.flatnonzero(tree.is_word) + 1, tree.parent).any()
    words = [{words_of(tree, d) for d in image} for image in images]
    for node in set().union(*words):
        shown = sum(node in found for found in words)
        assert tree.weight[node - 1] == pytest.approx(np.log(len(images) / shown), abs=0.2)
    assert (tree.weight[~tree.is_word] == 0).all()
    again = train_vocabulary(images, branches=4, levels=2, seed=0)
    np.testing.assert_array_equal(tree.descriptor, again.descriptor)


def test_a_words_bits_are_those_of_most_of_its_features() -> None:
    images = clustered(np.random.default_rng(1))
    centres = np.random.default_rng(1).integers(0, 256, (12, BYTES), dtype=np.uint8)
    tree = train_vocabulary(images, branches=12, levels=1, seed=0)
    far = np.unpackbits(centres[:, None] ^ tree.descriptor[None], axis=-1).sum(axis=-1).min(axis=1)
    assert (far == 0).sum() >= 10  # two may have been taken for one


def test_a_few_descriptors_are_words_each() -> None:
    rng = np.random.default_rng(0)
    few = rng.integers(0, 256, (3, BYTES), dtype=np.uint8)
    tree = train_vocabulary([few], branches=10, levels=3)
    assert tree.is_word.all() and len(tree.parent) == 3
    np.testing.assert_array_equal(tree.descriptor, few)
    with pytest.raises(ValueError, match="no descriptors"):
        train_vocabulary([np.zeros((0, BYTES), np.uint8)])


def test_the_file_is_dbow2s(tmp_path: Path) -> None:
    tree = train_vocabulary(clustered(np.random.default_rng(2)), branches=4, levels=2)
    write_vocabulary(tmp_path / "v.txt", tree)
    text = (tmp_path / "v.txt").read_text()
    assert not text.endswith("\n")  # it would be one node more
    head, *lines = text.split("\n")
    assert head == "4 2 0 0" and len(lines) == len(tree.parent)
    for k, line in enumerate(lines):
        parent, is_word, *rest = line.split(" ")
        assert (int(parent), bool(int(is_word))) == (tree.parent[k], tree.is_word[k]) and len(rest) == BYTES + 1
        assert bytes(map(int, rest[:-1])) == tree.descriptor[k].tobytes()


def test_features_of_an_image_and_of_none() -> None:
    texture = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    image = cv2.resize(texture, (320, 240), interpolation=cv2.INTER_NEAREST)
    found, none = orb_descriptors([image, np.full((240, 320, 3), 90, np.uint8)])
    assert len(found) > 100 and found.shape[1] == BYTES and none.shape == (0, BYTES)


def test_settings_are_read_by_opencv(tmp_path: Path) -> None:
    camera = Camera(320, 240, 240.6, 240.0, 159.5, 119.5)
    (tmp_path / "s.yaml").write_text(settings_text(camera, 29.97))
    file = cv2.FileStorage(str(tmp_path / "s.yaml"), cv2.FILE_STORAGE_READ)
    assert file.getNode("Camera1.fx").real() == 240.6 and file.getNode("Camera.fps").real() == 30
    assert file.getNode("File.version").string() == "1.0" and file.getNode("RGBD.DepthMapFactor").real() == 1.0


class FakeSlam:
    """Tracks all frames but the first; notes what it was given."""

    class Sensor:
        """As in pyorbslam3."""

        RGBD = "rgbd"

    given: ClassVar[list[tuple[tuple[int, ...], np.dtype, float]]] = []

    def __init__(self, vocabulary: str, settings: str, sensor: str) -> None:
        assert Path(vocabulary).name == "vocabulary.txt" and Path(settings).name == "settings.yaml" and sensor == "rgbd"

    Slam: type

    def track_rgbd(self, gray: np.ndarray, depth: np.ndarray, stamp: float) -> object:
        """As in pyorbslam3."""
        self.given.append((gray.shape, depth.dtype, stamp))
        return type("Result", (), {"ok": len(self.given) > 1})

    def shutdown(self) -> None:
        """As in pyorbslam3."""

    def save_trajectory_tum(self, path: str) -> None:
        """As in pyorbslam3."""
        Path(path).write_text("0.1 0 0 0 0 0 0 1\n")


FakeSlam.Slam = FakeSlam


def test_the_worker_feeds_frames_in_order_and_at_their_pace(tmp_path: Path) -> None:
    for n, stamp in enumerate((5.0, 5.04, 5.12)):
        gray, depth = np.zeros((4, 6), np.uint8), np.ones((4, 6), np.float32)
        np.savez(tmp_path / f"{n:06d}.npz", stamp=stamp, gray=gray, depth=depth)
    import time

    begin = time.perf_counter()
    work(tmp_path, FakeSlam)
    assert time.perf_counter() - begin >= 0.119
    assert [given[2] for given in FakeSlam.given] == [5.0, 5.04, 5.12] and (tmp_path / "final.txt").is_file()
    with np.load(tmp_path / "frames.npz") as told:
        assert told["tracked"].tolist() == [False, True, True] and len(told["ms"]) == 3


def test_a_process_that_dies_is_told_in_one_line(tmp_path: Path) -> None:
    dies = "import os; print('loading'); print('what(): bad vocabulary', flush=True); print(); os.abort()"
    failure = run_logged([sys.executable, "-c", dies], tmp_path / "log.txt")
    assert failure == "ended with status -6: what(): bad vocabulary"
    assert run_logged(["true"], tmp_path / "log.txt") == ""


@pytest.mark.skipif(find_spec("pyorbslam3") is not None, reason="pyorbslam3 is installed")
def test_without_the_package_it_says_what_to_install() -> None:
    dataset = type("Dataset", (), {"root": Path("seq"), "chosen": lambda self, frames: range(3)})()
    with pytest.raises(UserError, match="pip install 'pyorbslam3"):
        orb_slam3.run_orb_slam3(dataset)  # type: ignore[arg-type]
