"""What VSLAM-LAB runs for its baseline rstrack. Copy to VSLAM-LAB/Baselines/RSTRACK/.

python vslamlab_rstrack_rgbd.py --sequence_path SEQ --calibration_yaml SEQ/calibration.yaml --rgb_csv rgb_exp.csv \\
    --exp_folder EXP --exp_it 0

Makes a folder that rstrack reads of the experiment's images, tracks it, and writes EXP/00000_KeyFrameTrajectory.csv.
The rows' times are those of SEQ/camera.yaml, which `rsgen export vslamlab` writes; without it the shutter is global.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rsgen.sequence.format import pose_rows
from rstrack.data.estimate import Estimate, read_estimate

COLUMNS = ("ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw")


def cameras(calibration: dict[str, Any]) -> dict[str, Any]:
    """A camera.yaml of VSLAM-LAB's calibration: one camera, registered depth, a global shutter."""
    found = next(camera for camera in calibration["cameras"] if "depth_name" in camera)
    width, height = found["image_dimension"]
    kinds = {"radtan4": "radtan", "radtan5": "radtan", "equid4": "fisheye"}
    camera = {
        "width": width, "height": height, "intrinsics": [*found["focal_length"], *found["principal_point"]],
        "model": kinds[found["distortion_type"]] if "distortion_type" in found else "pinhole",
        "distortion": found.get("distortion_coefficients", []), "readout_s": 0.0,
    }  # fmt: skip
    return {"stamps": "raw", "color": camera, "depth": camera | {"depth_scale": found["depth_factor"]}}


def make_folder(sequence: Path, rgb_csv: Path, calibration: Path, folder: Path) -> None:
    """A TUM folder of the images that rgb_csv lists: links where the disk allows."""
    with rgb_csv.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for name, stream in (("rgb", "rgb_0"), ("depth", "depth_0")):
        images = {row[f"path_{stream}"]: int(row[f"ts_{stream} (ns)"]) for row in rows}
        (folder / stream).mkdir(parents=True)
        for path in images:
            try:
                os.link((sequence / path).resolve(), folder / path)
            except OSError:
                shutil.copyfile(sequence / path, folder / path)
        lines = [f"{ns / 1e9:.9f} {path}\n" for path, ns in sorted(images.items(), key=lambda item: item[1])]
        (folder / f"{name}.txt").write_text("".join(lines))
    stated = sequence / "camera.yaml"
    text = stated.read_text() if stated.is_file() else yaml.safe_dump(cameras(yaml.safe_load(calibration.read_text())))
    (folder / "camera.yaml").write_text(text)


def poses_at(estimate: Estimate, ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,), ns, and rows (n, 7) tx ty tz qx qy qz qw: at those of ns that the spline covers, else at its frames.

    rstrack's frames are stamped when their first row was read, which of warped depth is not quite colour's stamp: the
    first one may be a fraction of a millisecond before the spline.
    """
    spline = estimate.spline
    if spline is None:
        return np.rint(1e9 * estimate.stamps).astype(np.int64), pose_rows(estimate.T_world_depth)
    ns = ns[estimate.spline_covers(ns / 1e9) | estimate.spline_covers(ns / 1e9 + 1e-3)]
    return ns, pose_rows(spline.pose(np.clip(ns / 1e9, spline.t_begin, spline.t_end)))


def main(words: Sequence[str] | None = None) -> int:
    """Track, and write the poses as VSLAM-LAB reads them; returns rstrack's exit status."""
    parser = argparse.ArgumentParser()
    for name in ("sequence_path", "calibration_yaml", "rgb_csv", "exp_folder"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--exp_it", default="0")
    parser.add_argument("--method", default="rs-pg")
    given, _ = parser.parse_known_args(words)
    number = str(given.exp_it).zfill(5)
    folder, run = (given.exp_folder / f"{number}_rstrack_{what}" for what in ("images", "run"))
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(given.sequence_path, given.rgb_csv, given.calibration_yaml, folder)
    track = [sys.executable, "-m", "rstrack", "track", folder, "--method", given.method, "--out", run, "--quiet"]
    status = subprocess.run(track).returncode
    shutil.rmtree(folder)
    if status > 1:
        return status
    with given.rgb_csv.open(newline="") as file:
        asked_ns = np.array([int(row["ts_rgb_0 (ns)"]) for row in csv.DictReader(file)])
    ns, poses = poses_at(read_estimate(run), asked_ns)
    with (given.exp_folder / f"{number}_KeyFrameTrajectory.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([t, *(f"{value:.9f}" for value in pose)] for t, pose in zip(ns, poses, strict=True))
    return 0


if __name__ == "__main__":
    sys.exit(main())
