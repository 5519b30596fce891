"""ORB-SLAM3 (Campos et al., T-RO 2021) with depth and colour, from the package pyorbslam3 (GPL, not one of ours).

estimate = run_orb_slam3(open_dataset(Path("out/table1")), slice(0, 300))

It runs in a process of its own (`orb_slam3_worker`), at the pace of the recording as with a camera; its threads make
no two runs alike. Settings are those of its own example for a RealSense D435i; 500 to 2000 features, points kept to
200 baselines and a quarter of the pace were tried once and changed nothing beyond that. Its vocabulary is learnt from
the frames' own features, unless RSTRACK_ORB_VOCABULARY names a file, such as the ORBvoc.txt of its sources.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import ByteArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError, how_to_install
from rsgen.files import atomic_write
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rstrack.data.dataset import Dataset, registered_image
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.data.image_files import prefetched
from rstrack.data.registration import RegisteredImage, Registrar
from rstrack.options import Options
from rstrack.peers.peer import readout_s, run_info, run_logged

NAME = "orb-slam3"
VOCABULARY = "RSTRACK_ORB_VOCABULARY"
SETTINGS = {"features": 1250, "scale_factor": 1.2, "levels": 8, "ini_fast": 20, "min_fast": 7, "far_baselines": 40.0}
_BASELINE_M = 0.0745
# Of the images that the vocabulary is learnt from.
_MOST_IMAGES = 120
_WORKER = "rstrack.peers.orb_slam3_worker"
BYTES = 32
"""Of a descriptor: 256 bits."""
_ROUNDS = 8
_FEATURES = 500


def run_orb_slam3(
    dataset: Dataset, frames: slice = slice(None), progress: Progress = no_progress, seed: int = 0
) -> Estimate:
    """Track frames of a dataset; poses at the depth frames' stamps, of its final trajectory.

    Its input is registered by `rstrack.data.registration`. As of our baseline, a pose is taken for that of mid
    readout, and interpolated to the stamp. seed: of the vocabulary. Raises UserError: it is not installed, no such
    frames, an image cannot be read, its process fails, nothing was tracked.
    """
    chosen = dataset.chosen(frames)
    if find_spec("pyorbslam3") is None:
        raise UserError(f"the peer needs pyorbslam3 (GPL): {how_to_install('orbslam3')}")
    registrar = Registrar(dataset.rig)
    begin = time.perf_counter()
    with TemporaryDirectory(prefix="rstrack-orb-") as name:
        folder = Path(name)
        images = prefetched(lambda k: registered_image(dataset, registrar, k), chosen, 2)
        _write_frames(folder, dataset, chosen, images, seed)
        rate_hz = 1.0 / (dataset.interval_s(chosen) or 1.0 / 30.0)
        (folder / "settings.yaml").write_text(settings_text(registrar.camera, rate_hz))
        progress("tracking", 0.0, f"{NAME} runs")
        failure = run_logged([sys.executable, "-m", _WORKER, str(folder)], folder / "log.txt")
        if failure or not (folder / "frames.npz").is_file():
            raise UserError(f"{dataset.root}: {NAME} {failure or 'wrote no times of its frames'}")
        with np.load(folder / "frames.npz") as times:
            ms, tracked = times["ms"], times["tracked"]
        if not (folder / "final.txt").is_file():
            raise UserError(f"{dataset.root}: {NAME} tracked no frame: too few features in the images")
        found = read_estimate(folder / "final.txt")
    nearest = np.abs(dataset.stamps[chosen][None] - found.stamps[:, None]).argmin(axis=1)
    # Its file has microseconds only.
    stamps, first = np.unique(dataset.stamps[chosen][nearest], return_index=True)
    T_world_depth = se3.interpolated(stamps + readout_s(dataset, 0.5), found.T_world_depth[first], stamps)
    info = run_info(NAME, {"pyorbslam3": version("pyorbslam3")}, "on the CPU", dataset, chosen, begin, 1e-3 * ms)
    info |= {"settings": SETTINGS, "keyframes": 0, "lost": int((~tracked).sum())}
    return Estimate(stamps, se3.orthonormalise(T_world_depth), info=info)


def settings_text(camera: Camera, rate_hz: float) -> str:
    """ORB-SLAM3's settings for a pinhole and depth in metres; of the viewer too, which it insists on."""
    s = SETTINGS
    values = {
        "File.version": '"1.0"', "Camera.type": '"PinHole"',
        "Camera1.fx": camera.fx, "Camera1.fy": camera.fy, "Camera1.cx": camera.cx, "Camera1.cy": camera.cy,
        "Camera1.k1": 0.0, "Camera1.k2": 0.0, "Camera1.p1": 0.0, "Camera1.p2": 0.0,
        "Camera.width": camera.width, "Camera.height": camera.height, "Camera.fps": max(1, round(rate_hz)),
        "Camera.RGB": 1, "Stereo.ThDepth": s["far_baselines"], "Stereo.b": _BASELINE_M, "RGBD.DepthMapFactor": 1.0,
        "ORBextractor.nFeatures": s["features"], "ORBextractor.scaleFactor": s["scale_factor"],
        "ORBextractor.nLevels": s["levels"], "ORBextractor.iniThFAST": s["ini_fast"],
        "ORBextractor.minThFAST": s["min_fast"],
        "Viewer.KeyFrameSize": 0.05, "Viewer.KeyFrameLineWidth": 1.0, "Viewer.GraphLineWidth": 0.9,
        "Viewer.PointSize": 2.0, "Viewer.CameraSize": 0.08, "Viewer.CameraLineWidth": 3.0, "Viewer.ViewpointX": 0.0,
        "Viewer.ViewpointY": -0.7, "Viewer.ViewpointZ": -1.8, "Viewer.ViewpointF": 500.0,
    }  # fmt: skip
    return "\n".join(["%YAML:1.0", *(f"{name}: {value}" for name, value in values.items())]) + "\n"


def _write_frames(folder: Path, dataset: Dataset, chosen: range, images: Iterable[RegisteredImage], seed: int) -> None:
    """What the worker reads: frames and vocabulary. Raises UserError."""
    step = max(1, -(-len(chosen) // _MOST_IMAGES))
    learnt_from, given = [], os.environ.get(VOCABULARY)
    for n, (k, image) in enumerate(zip(chosen, images, strict=True)):
        gray = cv2.cvtColor(image.color, cv2.COLOR_RGB2GRAY)
        depth = np.where(image.depth < Options().max_depth, image.depth, np.float32(0))
        np.savez(folder / f"{n:06d}.npz", stamp=dataset.stamps[k], gray=gray, depth=depth)
        if n % step == 0 and not given:
            learnt_from += orb_descriptors([image.color])
    if given:
        if not Path(given).is_file():
            raise UserError(f"{VOCABULARY}={given}: is no file: name ORB-SLAM3's ORBvoc.txt, or leave it out")
        (folder / "vocabulary.txt").symlink_to(Path(given).resolve())
    elif not sum(map(len, learnt_from)):
        raise UserError(f"{dataset.root}: {NAME} finds no feature in the images")
    else:
        write_vocabulary(folder / "vocabulary.txt", train_vocabulary(learnt_from, seed=seed))


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
