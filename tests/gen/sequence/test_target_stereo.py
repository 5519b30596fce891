"""A stereo rig before a calibration board, calibrated by OpenCV, which knows neither the rig nor the renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tiny
import yaml
from scipy.spatial.transform import Rotation
from test_target import CAMERA, TARGET, found_corners

from rsgen.cli.main import main
from rsgen.geometry import se3
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.sequence.reader import read_rig

T_BODY_RIGHT = se3.exp(np.array([0.12, 0.004, -0.01, 0.01, -0.03, 0.02]))
VIEWS = 8


def rig(folder: Path, readout_s: float) -> Path:
    """Frames of both cameras, turned all about before the board, at 1 Hz."""
    t = np.arange(VIEWS * 10) / 10.0
    p = np.stack([0.25 * np.sin(2.1 * t), 0.2 * np.sin(1.3 * t + 1), 0.2 * np.sin(1.7 * t) - 0.5], axis=-1)
    # Looks at the board from where it is, with some roll.
    to = np.array([0.0, 0.0, 0.7]) - p
    turn = np.stack([-np.arctan2(to[:, 1], to[:, 2]), np.arctan2(to[:, 0], to[:, 2]), 0.4 * np.sin(0.9 * t)], axis=-1)
    q = Rotation.from_euler("xyz", turn).as_quat()
    path = tiny.write_config(folder, 8, target=TARGET)
    np.savetxt(folder / "path.txt", np.column_stack([t, p, q]), fmt="%.9f")
    data: dict[str, Any] = yaml.safe_load(path.read_text())
    for name in ("color", "depth", "T_color_depth"):
        data.pop(name, None)
    camera = CAMERA | {"kind": "mono", "spp": 8, "rate_hz": 1.0, "readout_s": readout_s, "offset_s": 0.2}
    data["streams"] = {"left": camera, "right": camera | {"T_body_cam": T_BODY_RIGHT.tolist()}}
    data["trajectory"] = {"file": "path.txt"}
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    assert main(["render", str(path), "--out", str(folder / "seq"), "--quiet"]) == 0
    return folder / "seq"


def calibrated(root: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """K of both cameras (3, 3), T_right_left (4, 4), and the RMS reprojection error, px."""
    sequence = read_rig(root)
    p_target = AprilGrid(3, 4, 0.2, 0.3).corners().astype(np.float32)  # (tags, 4, 3)
    points: list[Any] = []
    pixels: dict[str, list[Any]] = {"left": [], "right": []}
    for k in range(len(sequence.streams["left"].paths)):
        seen = {
            name: dict(zip(*found_corners(np.repeat(sequence.picture(name, k)[..., None], 3, -1)), strict=True))
            for name in pixels
        }
        tags = sorted(set(seen["left"]) & set(seen["right"]))
        if len(tags) >= 4:
            points.append(np.concatenate([p_target[tag] for tag in tags]))
            for name in pixels:
                pixels[name].append(np.concatenate([seen[name][tag] for tag in tags]).astype(np.float32))
    size = (320, 240)
    flat = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    K = [cv2.calibrateCamera(points, pixels[name], size, None, None, flags=flat)[1] for name in pixels]
    none = np.zeros(5)
    # What the two lenses' errors have in common would go into the distance between them along the view.
    stated = sequence.streams["left"].camera.K
    rms, *_, R, t, _, _ = cv2.stereoCalibrate(
        points, *pixels.values(), stated, none, stated, none, size, flags=cv2.CALIB_FIX_INTRINSIC
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t.ravel()
    return K[0], K[1], T, float(rms)


def test_opencv_finds_the_rig_at_zero_readout_and_not_with_a_rolling_shutter(tmp_path: Path) -> None:
    K1, K2, T_right_left, rms = calibrated(rig(tmp_path / "global", 0.0))
    assert rms < 0.5  # corners of oblique tags
    for K in (K1, K2):
        np.testing.assert_allclose([K[0, 0], K[1, 1]], 240.0, rtol=0.03)
        np.testing.assert_allclose([K[0, 2], K[1, 2]], [159.5, 119.5], atol=5.0)
    off = se3.log(T_right_left @ T_BODY_RIGHT)
    assert np.linalg.norm(off[:3]) < 0.0015 and np.rad2deg(np.linalg.norm(off[3:])) < 0.1
    *_, bent = calibrated(rig(tmp_path / "rolling", 0.1))
    assert bent > 1.5 * rms
