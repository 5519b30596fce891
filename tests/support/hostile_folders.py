"""Hostile folders of data sets: EuRoC, which is imported, TUM and 7-Scenes, which are read as they are."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import hostile
import numpy as np
import synthetic
import tiny
import tum_recording
from hostile_cases import (
    Base,
    Case,
    beside,
    both,
    entries_changed,
    every_image,
    imported,
    jpeg_bomb,
    linked,
    of_8_gb,
    piped,
    replaced_by,
    text_edited,
    tracked,
)

import rsgen.cli.main
from rsgen.image_codecs import encode_png
from rstrack.data.imu.recording import find_imu


def folders(folder: Path) -> Iterator[Case]:
    """EuRoC's layout, which is imported, 7-Scenes and TUM, which are read as they are."""
    folder.mkdir(parents=True, exist_ok=True)
    sequence = synthetic.make_sequence(folder / "seq", synthetic.make_config(16, 12), 3)
    assert rsgen.cli.main.main(["export", "euroc", str(sequence), "--copy", "--quiet", "--out", str(folder / "e")]) == 0
    euroc = Base("folders", folder / "e", imported)
    for inside, every in (("cam0/sensor.yaml", 2), ("cam0/data.csv", 2), ("depth0/data.csv", 2)):
        yield from euroc.damaged(f"mav0/{inside}", every)
    image = next((folder / "e/mav0/depth0/data").iterdir()).name
    listed = "mav0/depth0/data.csv"
    for new in ("../../../../beside/outside.bin", "/etc/passwd", "a\x00b", "x" * 5000, ".", "~root"):
        yield euroc.case(f"lists {new[:20]!r}", text_edited(listed, f",{image}", f",{new}"))
    yield euroc.case("an image that lies outside", both(
        beside("outside.bin", encode_png(np.ones((12, 16), np.uint16))),
        linked(f"mav0/depth0/data/{image}", "../../../../../beside/outside.bin")))  # fmt: skip
    sensor = "mav0/depth0/sensor.yaml"
    yield from entries_changed(
        euroc, sensor, {"intrinsics: [": "intrinsics: [.nan, ", "resolution: [": "resolution: [99999, "}
    )
    yield euroc.case("a depth scale of nothing", text_edited(sensor, "depth_scale: ", "depth_scale: 1e-300 #"))
    yield euroc.case("aliases of aliases", lambda path: (path / sensor).write_text(hostile.DOUBLING + "b: *a63\n"))
    yield euroc.case("a description of 8 GB", of_8_gb(sensor))
    yield euroc.case("a description that is a pipe", piped(sensor))
    tum = Base("folders", tum_recording.make_tum(folder / "tum"), tracked)
    whole = Base("folders", tum.whole, every_image)
    poses = tiny.write_trajectory(tum.whole / "groundtruth.txt", 6)
    imu = "".join(f"{1305031102175800000 + 5000000 * k},0,0,0.1,0,0,9.81\n" for k in range(40))
    (tum.whole / "imu.csv").write_text(imu)
    (tum.whole / "imu.yaml").write_text("T_imu_depth: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n")
    assert find_imu(tum.whole) is not None and poses.exists()
    first = f"{tum_recording.STAMPS[0]:.4f}"
    rgb, depth = f"rgb/{first}.png", f"depth/{first}.png"
    for inside, every in (("rgb.txt", 2), ("camera.yaml", 2), ("groundtruth.txt", 2), ("imu.csv", 2), ("imu.yaml", 3)):
        yield from tum.damaged(inside, every)
    yield from tum.damaged(depth, 2)
    for inside in ("rgb.txt", "camera.yaml", "groundtruth.txt", "imu.csv", "imu.yaml"):
        # Without samples that are a file there is no IMU.
        yield tum.case(f"{inside} is a device", linked(inside, "/dev/zero"), inside != "imu.csv")
        yield tum.case(f"{inside} is a pipe", piped(inside), inside != "imu.csv")
        yield tum.case(f"{inside} of 8 GB", of_8_gb(inside))
    for inside in (rgb, depth):
        yield whole.case(f"{inside[:3]} is a pipe", piped(inside))
        yield whole.case(f"{inside[:3]} of 8 GB", of_8_gb(inside))
        yield whole.case(f"{inside[:3]} lies outside", linked(inside, "../../../beside/secret.txt"))
        yield whole.case(f"{inside[:3]} is a device", linked(inside, "/dev/zero"))
    yield whole.case("a picture of 670 MB", replaced_by(rgb, hostile.png_bomb(False)))
    yield whole.case("a depth of 430 MB", replaced_by(depth, hostile.png_bomb(True)))
    yield whole.case("a JPEG of 3 GB", replaced_by(rgb, jpeg_bomb()))
    yield whole.case("all pictures of 670 MB", lambda path: [
        file.write_bytes(hostile.png_bomb(False)) for file in (path / "rgb").iterdir()])  # fmt: skip
    yield from _cameras(tum)
    phone = Base("folders", Path(shutil.copytree(tum.whole, folder / "phone")), tracked)
    table = "intrinsics.csv"
    (phone.whole / table).write_text("".join(f"{k}000000000,{24 + k / 9},25,15.5,11.5\n" for k in range(4)))
    yield from phone.damaged(table, 3)
    yield phone.case("intrinsics of 8 GB", of_8_gb(table))
    yield phone.case("intrinsics of a device", linked(table, "/dev/zero"))
    yield from _seven_scenes(folder)


def _cameras(tum: Base) -> Iterator[Case]:
    camera = "camera.yaml"
    for text in (
        "color: {width: 99999999, height: 9, intrinsics: [1, 1, 1, 1], readout_s: 0}",
        "color: {width: 32, height: 24, intrinsics: [.inf, 1, 1, 1], readout_s: 0}",
        "color: {width: 32, height: 24, intrinsics: [24, 25, 15, 11], readout_s: 1e300}",
        "color: {width: 32, height: 24, intrinsics: [24, 25, 15, 11], readout_s: 0, distortion: [1e9, 1e9, 0, 0]}",
        "color: !!python/object/apply:os.system ['touch hacked']",
        "color: &c {width: *c}",
        f"{hostile.DOUBLING}color: *a63",
        "color: " + "{a: " * 5000,
        "cam0: {camera_model: pinhole, intrinsics: [1, 1, 1, 1], resolution: [99999999, 9]}",
        "cam0: {camera_model: pinhole, intrinsics: [.nan, 1, 1, 1], resolution: [32, 24], line_delay: 1e300}",
        f"{hostile.DOUBLING}cam0: {{camera_model: *a63}}",
        "%YAML:1.0\n---\nK: !!opencv-matrix {rows: 99999, cols: 99999, dt: d, data: [1.]}",
        "%YAML:1.0\n---\nK: !!opencv-matrix {rows: -1, cols: 3, dt: d, data: [.nan, 1., 1.]}",
        f"%YAML:1.0\n---\n{hostile.DOUBLING}fx: *a63",
        "%YAML:1.0\n---\nfx: " + "[" * 5000,
        "%YAML:1.0\n---\n!!python/object/apply:os.system ['touch hacked']",
    ):
        yield tum.case(f"camera {text[:20]!r}...{text[-50:]!r}", replaced_by(camera, text.encode()))


def _seven_scenes(folder: Path) -> Iterator[Case]:
    root = folder / "seq-01"
    root.mkdir()
    for k in range(3):
        (root / f"frame-{k:06d}.color.png").write_bytes(encode_png(tum_recording.color_pixels(k)))
        (root / f"frame-{k:06d}.depth.png").write_bytes(encode_png(tum_recording.depth_units(k) // 20))
        (root / f"frame-{k:06d}.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    shutil.copy(folder / "tum/camera.yaml", root / "camera.yaml")
    seven = Base("folders", root, tracked)
    yield from seven.damaged("frame-000001.pose.txt", 3)
    yield seven.case("a pose of 1e308", text_edited("frame-000001.pose.txt", "1 0 0 0", "1e308 -1e308 0 0"))
    yield seven.case("a pose that lies outside", linked("frame-000001.pose.txt", "../../beside/secret.txt"))
    number = "9" * 18
    yield seven.case("frame 10^18", lambda path: (path / "frame-000002.color.png").rename(
        path / f"frame-{number}.color.png"), False)  # fmt: skip
    yield seven.case("frame 10^40", lambda path: (path / "frame-000002.depth.png").rename(
        path / f"frame-{'9' * 40}.depth.png"), False)  # fmt: skip
