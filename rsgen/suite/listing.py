"""What a suite's sequences are and would take, said before anything is rendered."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from rsgen.config.cameras import ColorConfig
from rsgen.config.config import Config
from rsgen.console.tables import Table
from rsgen.sequence.trajectory import read_trajectory
from rsgen.suite.definition import Definition, Entry

# Seconds on two slow cores, everything written, of a sample, a depth, an image and a sequence: lr_kt2, 120 frames at
# 320x240 and 640x480 in 36 and 71 s.
_S_PER_SAMPLE, _S_PER_DEPTH, _S_PER_IMAGE, _S_PER_SEQUENCE = 1.2e-7, 3e-7, 0.05, 3.0
# A pixel's bytes, of colour and of depth with its exact image; of the poses of a line; of the scene's surface.
_BYTES_PER_COLOR, _BYTES_PER_DEPTH, _BYTES_PER_LINE, _BYTES_OF_SCENE = 1.7, 4.1, 56.0, 7.1e6


@dataclass(frozen=True)
class Estimate:
    """What sequences take: frames of all cameras, s of rendering on two cores, bytes; bakes of light come on top."""

    frames: int
    seconds: float
    bytes: float
    bakes: int

    def text(self) -> str:
        """In one line."""
        hours, gigabytes = self.seconds / 3600, self.bytes / 1e9
        took = f"{hours:.1f} h" if hours >= 1 else f"{self.seconds / 60:.0f} min"
        light = f"{self.bakes} bakes of light, minutes each" if self.bakes != 1 else "a bake of light, minutes"
        return f"{self.frames} images, about {gigabytes:.2g} GB and {took} of rendering, and {light}"


def estimate(configs: Iterable[Config]) -> Estimate:
    """By numbers of images, pixels and samples alone: other scenes and machines differ by a factor of two or three."""
    frames, seconds, size, baked = 0, 0.0, 0.0, set()
    for config in configs:
        lasts, size, seconds = _duration(config), size + _BYTES_OF_SCENE, seconds + _S_PER_SEQUENCE
        baked.add(f"{config.scene} {config.light}")
        for camera in config.cameras.values():
            count, pixels = int((lasts - camera.offset_s) * camera.rate_hz + 1e-6) + 1, camera.width * camera.height
            frames, size = frames + count, size + count * camera.height * _BYTES_PER_LINE
            if isinstance(camera, ColorConfig):
                images = 1 + len(config.truth.images)
                seconds += count * images * (_S_PER_IMAGE + pixels * camera.spp * _S_PER_SAMPLE)
                size += count * images * pixels * _BYTES_PER_COLOR
            else:
                seconds += count * (_S_PER_IMAGE + pixels * _S_PER_DEPTH)
                size += count * pixels * _BYTES_PER_DEPTH
    return Estimate(frames, seconds, size, len(baked))


def _duration(config: Config) -> float:
    """Of a sequence, s, without making its motion."""
    if config.stretch is not None:
        return config.stretch.duration_s
    if config.motion is not None:
        return config.motion.length_m / config.motion.mean_speed_m_s
    assert config.trajectory.file is not None  # or there were a motion
    stamps = read_trajectory(config.trajectory.file, config.trajectory.format, config.trajectory.icl_start).stamps
    return float(stamps[-1] - stamps[0])


def describe_suite(suite: Definition) -> str:
    """Its sequences by tier, and what those that need no --data would take. Raises UserError."""
    blocks = [f"{suite.name} {suite.version} ({suite.license}): {suite.about}"]
    for tier in suite.tiers:
        entries = suite.chosen(tier, ())
        rows = tuple((entry.name, entry.role, entry.group, entry.config, _length(entry)) for entry in entries)
        blocks.append(Table((f"tier {tier}", "role", "group", "config", "length"), rows, words=(0, 1, 2, 3, 4)).text())
        planned, skipped = suite.planned(tier, (), None, None)
        without = f", without {len(skipped)} that need --data" if skipped else ""
        blocks.append(f"{len(planned)} sequences: {estimate(p.config for p in planned).text()}{without}")
    return "\n".join(blocks)


def _length(entry: Entry) -> str:
    several = f"{entry.draw.count} of " if entry.draw else ""
    needs = f", needs {', '.join(entry.data.values())}" if entry.data else ""
    return several + ("the whole motion" if entry.frames is None else f"{entry.frames} frames") + needs
