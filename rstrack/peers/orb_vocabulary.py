"""A vocabulary of ORB features in DBoW2's text format, learnt from a recording's own images.

write_vocabulary(Path("vocabulary.txt"), train_vocabulary(descriptors, branches=10, levels=3, seed=0))

ORB-SLAM3's own comes with its sources, not with the package. It needs one for loops and for finding its place again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import ByteArray
from rsgen.files import atomic_write

BYTES = 32
"""Of a descriptor: 256 bits."""
_ROUNDS = 8
_FEATURES = 500


@dataclass(frozen=True)
class Vocabulary:
    """A tree of words. Nodes (n,) in an order in which a parent comes before its children, the root left out.

    parent: 0 the root, else 1 + the parent's index. is_word: whether it has no children. descriptor (n, 32) bytes.
    weight: inverse document frequency of words, 0 of others.
    """

    branches: int
    levels: int
    parent: NDArray[np.int64]
    is_word: NDArray[np.bool_]
    descriptor: NDArray[np.uint8]
    weight: NDArray[np.float64]


def orb_descriptors(images: Iterable[ByteArray], features: int = _FEATURES) -> list[NDArray[np.uint8]]:
    """Of each RGB image (h, w, 3) its ORB descriptors (n, 32); n may be 0."""
    orb = cv2.ORB.create(features)
    found = (orb.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)[1] for image in images)
    return [np.zeros((0, BYTES), np.uint8) if d is None else np.asarray(d, np.uint8) for d in found]


def train_vocabulary(images: list[NDArray[np.uint8]], branches: int = 10, levels: int = 3, seed: int = 0) -> Vocabulary:
    """k-medians of bits, again within each cluster, `levels` deep; images: descriptors (n_i, 32) of each image.

    As DBoW2 learns it (Gálvez-López, Tardós, T-RO 2012): a word weighs log(images / images that show it).
    Raises ValueError without any descriptor.
    """
    everything = np.concatenate([*images, np.zeros((0, BYTES), np.uint8)])
    if not len(everything):
        raise ValueError("no descriptors")
    image_of = np.repeat(np.arange(len(images)), [len(d) for d in images])
    bits = np.unpackbits(everything, axis=1).astype(np.float32)
    rng = np.random.default_rng(seed)
    parents: list[int] = []
    words: list[bool] = []
    centres: list[NDArray[np.uint8]] = []
    weights: list[float] = []
    todo: list[tuple[int, int, NDArray[np.int64]]] = [(0, 0, np.arange(len(bits)))]
    while todo:
        node, level, members = todo.pop(0)
        for centre, own in _clusters(bits, members, branches, rng):
            is_word = level + 1 == levels or len(own) <= 1
            parents.append(node)
            words.append(is_word)
            centres.append(np.packbits(centre))
            weights.append(math.log(len(images) / len(np.unique(image_of[own]))) if is_word else 0.0)
            if not is_word:
                todo.append((len(parents), level + 1, own))
    tree = np.array(parents), np.array(words), np.array(centres, np.uint8), np.array(weights)
    return Vocabulary(branches, levels, *tree)


def write_vocabulary(path: Path, vocabulary: Vocabulary) -> None:
    """As text: 'k L scoring weighting' (L1 norm, TF-IDF), then 'parent is-word 32-bytes weight' a node.

    Raises UserError if it cannot be written.
    """
    v = vocabulary
    lines = [f"{v.branches} {v.levels} 0 0"]
    for parent, is_word, descriptor, weight in zip(v.parent, v.is_word, v.descriptor, v.weight, strict=True):
        lines.append(f"{parent} {int(is_word)} {' '.join(map(str, descriptor.tolist()))} {weight:.9g}")
    # DBoW2 takes an empty last line for one more node.
    atomic_write(path, "\n".join(lines).encode())


def _clusters(
    bits: NDArray[np.float32], members: NDArray[np.int64], count: int, rng: np.random.Generator
) -> list[tuple[NDArray[np.uint8], NDArray[np.int64]]]:
    """At most `count` clusters of members: the majority of each of its bits, and which members are in it."""
    own = bits[members]
    if len(members) <= count:
        return [(row.astype(np.uint8), members[k : k + 1]) for k, row in enumerate(own)]
    centres = _first_centres(own, count, rng)
    nearest = _distances(own, centres).argmin(axis=1)
    for _ in range(_ROUNDS):
        sizes = np.bincount(nearest, minlength=len(centres))
        sums = np.stack([own[nearest == k].sum(axis=0) for k in range(len(centres))])
        centres = np.where(sizes[:, None] > 0, 2.0 * sums >= sizes[:, None], centres).astype(np.float32)
        before, nearest = nearest, _distances(own, centres).argmin(axis=1)
        if np.array_equal(before, nearest):
            break
    kept = [k for k in range(len(centres)) if (nearest == k).any()]
    return [(centres[k].astype(np.uint8), members[nearest == k]) for k in kept]


def _first_centres(own: NDArray[np.float32], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """k-means++: far from each other, at random."""
    centres = own[rng.integers(len(own))][None]
    for _ in range(1, count):
        far = _distances(own, centres).min(axis=1)
        if not far.any():
            break
        centres = np.concatenate([centres, own[rng.choice(len(own), p=far / far.sum())][None]])
    return centres


def _distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Hamming distances (n, m) of bits a (n, 256) and b (m, 256)."""
    return np.asarray(a.sum(axis=1)[:, None] + b.sum(axis=1)[None] - 2.0 * a @ b.T, np.float64)
