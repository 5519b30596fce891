"""A TUM folder of four small images, and a calibration as OpenCV writes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

WIDTH, HEIGHT = 32, 24
STAMPS = (1305031102.1758, 1305031102.2091, 1305031102.2424, 1305031102.2757)
INTRINSICS = [24.0, 25.0, 15.5, 11.5]
COLOR = {"width": WIDTH, "height": HEIGHT, "intrinsics": INTRINSICS, "readout_s": 0.028}


def color_pixels(k: int) -> np.ndarray:
    return np.random.default_rng([1, k]).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth_units(k: int) -> np.ndarray:
    return np.random.default_rng([2, k]).integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)


def write_listing(path: Path, lines: list[str]) -> None:
    path.write_text("# a comment\n\n" + "\n".join(lines) + "\n")


def make_tum(root: Path, camera: dict[str, Any] | None = None) -> Path:
    """A TUM folder of four depth and four colour images."""
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    for k, stamp in enumerate(STAMPS):
        cv2.imwrite(str(root / f"rgb/{stamp:.4f}.png"), color_pixels(k)[..., ::-1])
        cv2.imwrite(str(root / f"depth/{stamp:.4f}.png"), depth_units(k))
    write_listing(root / "rgb.txt", [f"{t:.4f} rgb/{t:.4f}.png" for t in STAMPS])
    write_listing(root / "depth.txt", [f"{t:.4f} depth/{t:.4f}.png" for t in STAMPS])
    write_camera(root, {"color": COLOR} if camera is None else camera)
    return root


def write_camera(root: Path, camera: dict[str, Any]) -> None:
    (root / "camera.yaml").write_text(yaml.safe_dump(camera))


def write_opencv(root: Path, header: str = "%YAML:1.0", **entries: Any) -> Path:
    """calibration.yaml as OpenCV itself writes it, matrices and all; the header by default that of versions 2 to 4."""
    path = root / "calibration.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, np.atleast_2d(value).astype(float) if isinstance(value, list) else value)
    storage.release()
    first, _, rest = path.read_text().partition("\n")
    assert first.startswith("%YAML")
    path.write_text(f"{header}\n{rest}")
    (root / "camera.yaml").unlink(missing_ok=True)
    return path


K = [[24.0, 0, 15.5], [0, 25.0, 11.5], [0, 0, 1]]
