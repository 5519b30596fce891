"""Datasets: one line for each fault."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tum_recording import (
    COLOR,
    STAMPS,
    K,
    color_pixels,
    depth_units,
    make_tum,
    write_camera,
    write_opencv,
)

from rsgen.errors import UserError
from rstrack.data.dataset import open_dataset

COLOR_0, DEPTH_0 = f"rgb/{STAMPS[0]:.4f}.png", f"depth/{STAMPS[0]:.4f}.png"
Fault = Callable[[Path], object]


def listing(name: str, *lines: str) -> Fault:
    return lambda root: (root / name).write_text("\n".join(lines))


def remove(*names: str) -> Fault:
    return lambda root: list(map(Path.unlink, map(root.joinpath, names)))


def camera(**changes: Any) -> Fault:
    return lambda root: write_camera(root, {"color": COLOR | changes})


def rewrite(name: str, change: Callable[[bytes], bytes]) -> Fault:
    return lambda root: (root / name).write_bytes(change((root / name).read_bytes()))


def opencv(**entries: Any) -> Fault:
    return lambda root: write_opencv(root, **entries)


def flip(data: bytes) -> bytes:
    return data[:70] + bytes([data[70] ^ 4]) + data[71:]


def jpeg_start(_: bytes) -> bytes:
    return cv2.imencode(".jpg", color_pixels(0))[1].tobytes()[:-300]


def image(name: str, pixels: np.ndarray) -> Fault:
    return lambda root: cv2.imwrite(str(root / name), pixels)


def outside(root: Path) -> None:
    (root.parent / "secret.png").write_bytes((root / DEPTH_0).read_bytes())
    (root / DEPTH_0).unlink()
    (root / DEPTH_0).symlink_to(root.parent / "secret.png")


FAULTS: dict[str, tuple[Fault, str]] = {
    "no listings": (remove("rgb.txt", "depth.txt"), "nothing that can be tracked: give an rsgen sequence"),
    "no colour listing": (remove("rgb.txt"), r"rgb\.txt: cannot be read"),
    "empty listing": (listing("depth.txt", ""), r"depth\.txt: is empty"),
    "comments only": (listing("depth.txt", "# nothing", ""), r"depth\.txt: lists no image"),
    "binary listing": (lambda root: (root / "rgb.txt").write_bytes(b"\xff\xfe\x00"), r"rgb\.txt: is not a text file"),
    "three columns": (listing("depth.txt", f"0.0 {DEPTH_0} x"), r"depth\.txt line 1: expected 'stamp path"),
    "no number": (listing("depth.txt", f"zero {DEPTH_0}"), r"depth\.txt line 1: 'zero' is not a time"),
    "nan stamp": (listing("rgb.txt", f"nan {COLOR_0}"), r"rgb\.txt line 1: 'nan' is not a time"),
    "nanoseconds": (listing("rgb.txt", f"1305031102175800000 {COLOR_0}"), r"line 1: stamp .* divide"),
    "back in time": (listing("depth.txt", f"0.5 {DEPTH_0}", f"0.4 {DEPTH_0}"), r"depth\.txt line 2: .*does not come"),
    "repeated stamp": (listing("depth.txt", "#", f"0.5 {DEPTH_0}", f"0.5 {DEPTH_0}"), "line 3: repeats the stamp 0.5"),
    "two colours at once": (listing("rgb.txt", f"0.5 {COLOR_0}", f"0.5 {DEPTH_0}"), r"rgb\.txt line 2: repeats"),
    "missing image": (listing("depth.txt", f"0.1 {DEPTH_0}", "0.2 depth/x.png"), r"line 2: .*depth/x\.png is missing"),
    "absolute path": (listing("depth.txt", "0.1 /etc/hostname"), "line 1: path '/etc/hostname' leaves"),
    "parent path": (listing("depth.txt", "0.1 ../secret.png"), r"line 1: path '\.\./secret\.png' leaves"),
    "link out": (outside, r"depth\.txt line 3: .*leaves the folder"),
    "nul in path": (listing("depth.txt", "0.1 depth/\0.png"), "line 1: .*not a usable path"),
    "truncated depth": (rewrite(DEPTH_0, lambda data: data[:-30]), rf"{DEPTH_0}: .*truncated"),
    "flipped bit": (rewrite(DEPTH_0, flip), rf"{DEPTH_0}: .*checksum"),
    "truncated jpeg": (rewrite(COLOR_0, jpeg_start), rf"{COLOR_0}: .*truncated"),
    "empty image": (rewrite(COLOR_0, lambda _: b""), rf"{COLOR_0}: is empty"),
    "no image": (rewrite(COLOR_0, lambda _: b"hello"), rf"{COLOR_0}: .*neither PNG nor JPEG"),
    "small depth": (image(DEPTH_0, depth_units(0)[:-1]), rf"{DEPTH_0}: is 32x23, but the camera is 32x24"),
    "small colour": (image(COLOR_0, color_pixels(0)[:, :-2]), rf"{COLOR_0}: is 30x24, but the camera is 32x24"),
    "8-bit depth": (image(DEPTH_0, color_pixels(0)[..., 0]), rf"{DEPTH_0}: is a 8-bit grey image"),
    "16-bit colour": (image(COLOR_0, depth_units(0)), rf"{COLOR_0}: is a 16-bit grey image"),
    "no cameras": (remove("camera.yaml"), r"nothing states the cameras: write .*camera\.yaml.*fx"),
    "broken yaml": (lambda root: (root / "camera.yaml").write_text("a: [\nb"), r"camera\.yaml: line 2 is not valid"),
    "empty camera": (lambda root: write_camera(root, {}), r"color: Field required; write e\.g\. 'color: \{width"),
    "unknown entry": (camera(redout_s=0.0), r"color\.redout_s: no such entry"),
    "no readout": (lambda root: write_camera(root, {"color": {"width": 32}}), "Field required; write"),
    "three intrinsics": (camera(intrinsics=[1, 2, 3]), r"color\.intrinsics\.3"),
    "y-up camera": (camera(intrinsics=[481.2, -480.0, 319.5, 239.5]), r"color\.intrinsics: fy = -480 .*write 480"),
    "no focal length": (camera(intrinsics=[0, 1, 2, 3]), r"camera\.yaml: color: camera: fx = 0"),
    "bad distortion": (camera(model="radtan", distortion=[1.0]), "radtan takes 4 or 5"),
    "skewed extrinsics": (
        lambda root: write_camera(root, {"color": COLOR, "T_color_depth": (2 * np.eye(4)).tolist()}),
        "T_color_depth: not a rigid transform",
    ),
    "opencv, empty": (opencv(), "no camera matrix for color: add .*keys that are there: none"),
    "opencv, no readout": (opencv(K=K, foo=1.0), "no readout time for color: add 'readout_s.*are there: k, foo"),
    "opencv, no matrix": (opencv(readout=28.0), "no camera matrix for color: .*are there: readout"),
    "opencv, 2x2 matrix": (opencv(K=[[1.0, 0], [0, 1]], readout=28.0), "camera matrix of color is neither"),
    "opencv, y-up": (opencv(K=[24.0, -25, 15, 11], readout=28.0), "fy = -25 .*write 25"),
    "opencv, negative readout": (opencv(K=K, readout=-1.0), r"color\.readout_s: Input should be greater"),
    "opencv, word for readout": (opencv(K=K, readout="soon"), r"color\.readout_s: Input should be a finite"),
    "opencv, odd width": (opencv(K=K, readout=0.0, width=31.5), r"color\.width: Input should be a valid integer"),
    "opencv, metres per unit": (opencv(K=K, readout=0.0, depth_scale=0.001), "depth_scale: .*per metre, such as 5000"),
    "opencv, damaged": (
        lambda root: write_opencv(root, K=K).write_text("%YAML:1.0\nK: !!opencv-matrix\n  rows: 3\n"),
        r"calibration\.yaml: line 2 is not valid OpenCV YAML",
    ),
    "associations of one kind": (
        lambda root: [
            remove("rgb.txt")(root),
            listing("associations.txt", f"0.1 {DEPTH_0} 0.1 {DEPTH_0}")(root),
        ],
        r"associations\.txt line 1: has two depth images",
    ),
    "truth damaged": (listing("groundtruth.txt", "1 2 3"), r"groundtruth\.txt holds 1 poses"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_one_line_that_says_where(fault: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    damage, message = FAULTS[fault]
    root = make_tum(tmp_path / "tum")
    damage(root)
    with pytest.raises(UserError, match=message) as error:
        open_dataset(root).frame(0)
    assert "\n" not in str(error.value) and len(str(error.value)) < 700
    assert capfd.readouterr() == ("", ""), "a decoder complained"


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        open_dataset(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"lost\.yaml: cannot be read"):
        open_dataset(make_tum(tmp_path / "tum"), tmp_path / "lost.yaml")
