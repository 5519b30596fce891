"""A config, a scene and a trajectory of a few seconds' work, for tests of the whole generator and its commands.

config = write_config(tmp_path, color={"spp": 8})
status = main(["render", str(config), "--out", str(tmp_path / "seq"), "--quiet"])
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from rsgen.config.config import Config
from rsgen.produce.generate import RenderJob
from rsgen.produce.parts import engine_versions, input_hashes, load_motion, sequence_stamps
from rsgen.produce.writer import SequenceWriter
from rsgen.sensors.color import Setting

SCENE = """\
<scene version="3.0.0">
  <bsdf type="twosided" id="paper">
    <bsdf type="diffuse">
      <texture name="reflectance" type="bitmap"><string name="filename" value="paper.png"/></texture>
    </bsdf>
  </bsdf>
  <shape type="cube">
    <transform name="to_world"><scale x="2" y="1.5" z="2.5"/></transform>
    <ref id="paper"/>
  </shape>
  <shape type="sphere">
    <point name="center" x="0.3" y="0.4" z="1.6"/><float name="radius" value="0.5"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.3, 0.2"/></bsdf>
  </shape>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="0.8"/><rotate x="1" angle="-90"/><translate y="-1.4"/>
    </transform>
    <bsdf type="diffuse"/>
    <emitter type="area"><rgb name="radiance" value="4"/></emitter>
  </shape>
</scene>
"""
WIDTH, HEIGHT = 48, 36
CAMERA = {"width": WIDTH, "height": HEIGHT, "intrinsics": [36.0, 36.0, 23.5, 17.5]}
QUICK_LIGHT = {"texel_m": 0.25, "direct_samples": 8, "gather_rays": 16, "bounces": 1}


def write_scene(folder: Path) -> Path:
    """scene.xml (a papered room, a ball, a lamp; y points down) and its texture paper.png."""
    folder.mkdir(parents=True, exist_ok=True)
    pattern = np.random.default_rng(3).integers(60, 230, (8, 8, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "paper.png"), pattern)
    (folder / "scene.xml").write_text(SCENE)
    return folder / "scene.xml"


def poses(count: int, rate_hz: float = 30.0, first_s: float = 0.0) -> np.ndarray:
    """Rows (count, 8) 'stamp tx ty tz qx qy qz qw': 0.3 m/s and 0.3 rad/s, with changing directions."""
    t = np.arange(count) / rate_hz
    p = np.stack([0.2 * np.sin(1.4 * t), 0.1 * np.sin(1.1 * t + 1), 0.15 * np.sin(1.7 * t) - 0.5], axis=-1)
    q = Rotation.from_rotvec(
        np.stack([0.1 * np.sin(2 * t), 0.25 * np.sin(t), 0.1 * np.sin(1.3 * t)], axis=-1)
    ).as_quat()
    return np.column_stack([t + first_s, p, q])


def write_trajectory(path: Path, count: int = 6, **how: Any) -> Path:
    """A TUM file of `poses(count, ...)`."""
    lines = [f"{row[0]:.9f} " + " ".join(f"{value:.9f}" for value in row[1:]) for row in poses(count, **how)]
    path.write_text("\n".join(["# stamp tx ty tz qx qy qz qw", *lines, ""]))
    return path


def write_config(folder: Path, frames: int = 6, name: str = "tiny", **sections: Any) -> Path:
    """NAME.yaml in `folder` with the scene and the trajectory beside it; `sections` override its entries."""
    if not (folder / "scene.xml").exists():
        write_scene(folder)
    write_trajectory(folder / "motion.txt", frames)
    config: dict[str, Any] = {
        "name": name,
        "trajectory": {"file": "motion.txt"},
        "scene": {"file": "scene.xml"},
        "light": QUICK_LIGHT,
        "color": CAMERA | {"spp": 4},
        "depth": CAMERA,
    }
    for section, values in sections.items():
        config[section] = config[section] | values if isinstance(config.get(section), dict) else values
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a sequence by its name, except origin.yaml, which is not part of it."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "origin.yaml"]
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def render_job(config: Config, out: Path, *shots: tuple[int, str], **settings: list[Setting]) -> RenderJob:
    """A worker's job of images (frame, stream) of the config's sequence. settings: of automatic cameras."""
    motion, identity = load_motion(config), (engine_versions(config.backend), input_hashes(config))
    writer = SequenceWriter.open(out, config, motion.spline, sequence_stamps(config, motion), *identity)
    for name, of_camera in settings.items():
        writer = writer.adapted(name, of_camera)
    return RenderJob(writer, *identity, shots, key=str(out))
