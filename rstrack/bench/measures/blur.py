"""The measure `blur`: what `track` measures, and how good keyframes are that are fused with blur-aware weights.

Figures are named by the path that frames are fused along ('true' or 'estimated'), those of colour also by the weights:
psnr_db_true_sigma1, psnr_db_estimated_constant. The setting `sigmas_px` has the σ of equation (13) that are tried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rsgen.array_types import BoolArray, ByteArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError, validated
from rsgen.files import atomic_write, read_text
from rsgen.geometry.spline import Spline
from rsgen.image_codecs import encode_png, read_png
from rstrack.bench.measures.track import accuracy, estimated
from rstrack.bench.record import Figures
from rstrack.bench.task import Task
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate
from rstrack.mapping.keyframes import BlurSigma, FusedKeyframe, depth_errors, fused_keyframes
from rstrack.options import Options

POSES = ("true", "estimated")
PANELS = ("registered", "weights", "constant", "blur_aware", "sharp_view")
"""Pictures of one keyframe, in the order of the paper's Figure 2: files in the folder panels/ beside the record."""

# Seconds within which a keyframe and the sharp truth are of the same instant.
_SAME_INSTANT_S = 1e-4
_TRUTH = "global_middle"
_WINDOW = 11


def blur_cell(task: Task, progress: Progress) -> Figures:
    """Track the case and fuse its keyframes along both paths; see the module. Writes panels/. Raises UserError."""
    dataset = task.dataset
    check_comparable(dataset)
    sigmas = tuple(float(sigma) for sigma in task.settings["sigmas_px"])
    estimate, figures = estimated(task, progress)
    figures = accuracy(task, estimate) | figures
    for poses, spline, covers in _paths(dataset, estimate):
        progress("fusing", 1.0, f"along the {poses} path")
        keyframes = list(fused_keyframes(dataset, spline, (None, *sigmas), task.options, covers))
        figures |= _color(keyframes, dataset, poses) | _depth(keyframes, dataset, task.options, poses)
        if poses == "true" and keyframes and sigmas:
            _write_panels(keyframes, dataset, min(sigmas, key=lambda s: abs(s - 1.0)), task.out / "panels")
    return figures


def weights_key(sigma_px: float | None) -> str:
    """What figures call the weights of a σ; None: constant ones."""
    return "constant" if sigma_px is None else f"sigma{sigma_px:g}"


def check_comparable(dataset: Dataset) -> None:
    """Raises UserError unless a frame's global-shutter truth is the view of the keyframe that it makes."""
    rig, root = dataset.rig, dataset.root
    if dataset.sequence is None or _TRUTH not in dataset.sequence.truth_images:
        raise UserError(f"{root}: has no truth/{_TRUTH}: render it with --truth.global_shutter '[middle]'")
    if rig.depth_camera != rig.color_camera or rig.depth_camera.model != "pinhole":
        raise UserError(f"{root}: blur is measured from the depth camera's view: give both cameras the same pinhole")
    if not np.allclose(rig.T_color_depth, np.eye(4), atol=1e-9):
        raise UserError(f"{root}: blur is measured from the depth camera's view: leave T_color_depth out")
    if rig.depth_shutter.readout_s != rig.color_shutter.readout_s:
        raise UserError(f"{root}: blur is measured with the same readout_s for colour and depth")


class Panels(BaseModel):
    """The paper's Figure 2 for one keyframe. white: the weight that is white in the picture."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    keyframe: int = Field(ge=0)
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    white: float = Field(ge=0.0, allow_inf_nan=False)

    def images(self, folder: Path) -> dict[str, npt.NDArray[np.uint8]]:
        """The pictures (h, w, 3) by their names in `PANELS`. Raises UserError."""
        return {name: read_png(folder / f"{name}.png", (self.height, self.width, 3), np.uint8) for name in PANELS}


def read_panels(folder: Path) -> Panels | None:
    """What is in a folder panels/; None if it is not there. Raises UserError."""
    if not folder.is_dir():
        return None
    path = folder / "panels.json"
    return validated(Panels.model_validate_json, read_text(path), path)


# ---------------------------------------------------------------------------------------------------------------------


def _paths(dataset: Dataset, estimate: Estimate) -> Iterator[tuple[str, Spline, Callable[[float], bool]]]:
    assert dataset.truth is not None
    true, found = dataset.truth, estimate.spline
    yield POSES[0], true, lambda t: true.t_begin <= t <= true.t_end
    if found is not None and len(estimate.stamps) > 2:
        yield POSES[1], found, lambda t: bool(estimate.spline_covers(t))


def _sharp_view(truth: Dataset, done: FusedKeyframe) -> Any:
    """The sharp image (h, w, 3) from the keyframe's pose. Raises UserError."""
    assert truth.sequence is not None
    rig = truth.rig
    stamps = truth.color_stamps - 0.5 * rig.color_shutter.exposure_s
    wanted = done.reference.stamp - 0.5 * rig.depth_shutter.exposure_s
    k = int(np.argmin(np.abs(stamps - wanted)))
    if abs(stamps[k] - wanted) > _SAME_INSTANT_S:
        raise UserError(
            f"{truth.root}: no colour image of the time {wanted:.4f} s, of which there is a depth image: give both "
            "streams the same rate_hz, and render all frames"
        )
    return truth.sequence.truth(_TRUTH, k)


def _color(keyframes: Sequence[FusedKeyframe], truth: Dataset, poses: str) -> Figures:
    """Means over the keyframes by the weights. gradient: its energy over that of the sharp view."""
    sums: dict[BlurSigma, list[tuple[float, float, float]]] = {}
    for done in keyframes:
        sharp = _sharp_view(truth, done)
        known = np.logical_and.reduce([weight > 0 for _, weight in done.colors.values()])
        energy = gradient_energy(sharp, known)
        for sigma, (image, _) in done.colors.items():
            ratio = gradient_energy(image, known) / energy
            sums.setdefault(sigma, []).append((psnr_db(image, sharp, known), ssim(image, sharp, known), ratio))
    figures: Figures = {f"keyframes_{poses}": len(keyframes)}
    for sigma, values in sums.items():
        psnr, likeness, ratio = np.mean(values, axis=0).tolist()
        least = min(value[0] for value in values)
        scores = {"psnr_db": psnr, "psnr_db_least": least, "ssim": likeness, "gradient": ratio}
        figures |= {f"{name}_{poses}_{weights_key(sigma)}": value for name, value in scores.items()}
    return figures


def _depth(keyframes: Sequence[FusedKeyframe], dataset: Dataset, options: Options, poses: str) -> Figures:
    """RMSE of one frame's depth and of the keyframes', of more than one frame: there is nothing fused in the others."""
    errors = [depth_errors(dataset, done, options) for done in keyframes if done.frames > 1]
    if not errors:
        return {}
    single, fused, pixels = np.array(errors).T
    rms = [1e3 * float(np.sqrt(np.average(values**2, weights=pixels))) for values in (single, fused)]
    return {f"single_mm_{poses}": rms[0], f"fused_mm_{poses}": rms[1], f"pixels_{poses}": float(pixels.sum())}


def _write_panels(keyframes: Sequence[FusedKeyframe], truth: Dataset, sigma: float, folder: Path) -> None:
    """Of the keyframe where blur-aware weights are worth most."""

    def gain(done: FusedKeyframe) -> float:
        sharp, known = _sharp_view(truth, done), done.colors[None][1] > 0
        return psnr_db(done.colors[sigma][0], sharp, known) - psnr_db(done.colors[None][0], sharp, known)

    best = max(keyframes, key=gain)
    blurred, weights = best.most_blurred
    white = max(float(weights.max()), 1e-6)
    shade = np.repeat(np.rint(255.0 / white * weights).astype(np.uint8)[..., None], 3, axis=-1)
    images = (blurred, shade, best.colors[None][0], best.colors[sigma][0], _sharp_view(truth, best))
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(PANELS, images, strict=True):
        atomic_write(folder / f"{name}.png", encode_png(np.ascontiguousarray(image)))
    height, width = weights.shape
    about = Panels(keyframe=best.index, width=width, height=height, white=white)
    atomic_write(folder / "panels.json", (about.model_dump_json(indent=1) + "\n").encode())


def psnr_db(image: ByteArray, truth: ByteArray, known: BoolArray) -> float:
    """Peak signal-to-noise ratio in dB of sRGB code values (h, w, 3) over the known pixels (h, w); inf if equal."""
    if not known.any() or (image[known] == truth[known]).all():
        return math.inf if known.any() else math.nan
    return float(peak_signal_noise_ratio(truth[known], image[known]))


def ssim(image: ByteArray, truth: ByteArray, known: BoolArray) -> float:
    """Mean structural similarity of the grey images over pixels whose whole window is known; NaN if there are none.

    Wang, Bovik, Sheikh, Simoncelli, IEEE TIP 13(4), 2004: window of 11 px with σ = 1.5 px, constants for 8 bit.
    """
    _, likeness = structural_similarity(
        _grey(image), _grey(truth), gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255.0,
        full=True,
    )  # fmt: skip
    return _mean(likeness, _eroded(known, _WINDOW // 2))


def gradient_energy(image: ByteArray, known: BoolArray) -> float:
    """Mean squared gradient of the grey image, (code values / px)², where both neighbours on each axis are known."""
    grey = _grey(image)
    energy = np.zeros_like(grey)
    energy[:, 1:-1] += (0.5 * (grey[:, 2:] - grey[:, :-2])) ** 2
    energy[1:-1] += (0.5 * (grey[2:] - grey[:-2])) ** 2
    return _mean(energy, _eroded(known, 1))


def _grey(image: ByteArray) -> npt.NDArray[np.float64]:
    return np.asarray(image.astype(np.float64) @ (0.299, 0.587, 0.114))


def _eroded(known: BoolArray, reach: int) -> BoolArray:
    """Pixels (h, w) whose square neighbourhood lies within the image and is known."""
    padded = cv2.copyMakeBorder(known.astype(np.uint8), *(reach,) * 4, cv2.BORDER_CONSTANT, value=0)
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.erode(padded, kernel)[reach:-reach, reach:-reach] > 0)


def _mean(values: npt.NDArray[np.float64], where: BoolArray) -> float:
    return float(values[where].mean()) if where.any() else math.nan
