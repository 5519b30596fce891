"""A preview video: two renderings side by side, such as global and rolling shutter."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from rsgen.array_types import ByteArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import whole_file
from rsgen.formats.export.shared import DEFAULTS, ExportOptions, new_file
from rsgen.sequence.images import Sequence

# Encoders that OpenCV's own wheels bring along.
_CODECS = {".mp4": "mp4v", ".avi": "MJPG"}
_LABELS = ("global shutter", "rolling shutter")
_GAP = 4  # black columns between the two images
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def export_video(
    sequence: Sequence, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress
) -> str:
    """Write the video `out`: the sequence rendered with a global shutter, beside its own images. Raises UserError.

    options.scene: the scene's file, if it has moved since the sequence was rendered.
    """
    from rsgen.pictures.frames import config_of
    from rsgen.produce.camera_sources import setting_of
    from rsgen.produce.parts import open_frames

    sequence = sequence.as_taken
    stream = sequence.streams["color"]
    config = config_of(sequence.root, sequence.meta, options.scene)
    source = open_frames(config, progress, global_shutter=True, objects=[thing.spline for thing in sequence.objects])
    # All rows at the middle row's time.
    middle = 0.5 * (stream.line_count - 1) * stream.shutter.line_delay(stream.camera)
    frames = range(len(stream.paths))
    left = (
        source.color.picture(sequence.spline, stamp + middle, int(k), setting_of(config.color, stream.table, i))
        for i, (stamp, k) in enumerate(zip(stream.stamps, stream.indices, strict=True))
    )
    right = (sequence.color(k) for k in frames)
    return write_video(out, left, right, stream.rate_hz, count=len(frames), progress=progress)


def write_video(
    path: Path, left: Iterable[ByteArray], right: Iterable[ByteArray], fps: float, count: int = 0,
    progress: Progress = no_progress,
) -> str:  # fmt: skip
    """Write two equally long runs of sRGB images (h, w, 3) uint8, all of one size, side by side; returns one line.

    path: .mp4 (MPEG-4) or .avi (Motion JPEG). fps: frames per second. count: number of frames, for the progress. The
    file is there whole or not at all. Raises UserError if it is there already, has another suffix, or cannot be
    written; ValueError for images of different sizes and unequal runs.
    """
    path = new_file(path, "a video", tuple(_CODECS))
    with whole_file(path) as temporary:
        written = _write(
            temporary, path, (side_by_side(*pair) for pair in zip(left, right, strict=True)), fps, count, progress
        )
        # The encoder does not report a full disk.
        reader = cv2.VideoCapture(str(temporary))
        stored = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
        reader.release()
        if stored != written:
            fault = f"only {stored} of {written} frames could be written"
            raise UserError(f"{path}: {fault}: free space or choose another --out")
    return f"{path}: {written} frames at {fps:g} Hz, {_LABELS[0]} left and {_LABELS[1]} right"


def side_by_side(left: ByteArray, right: ByteArray) -> ByteArray:
    """Both images (h, w, 3) with their labels, even in size as encoders ask. Raises ValueError if sizes differ."""
    if left.shape != right.shape or left.ndim != 3 or left.shape[2] != 3 or not left.dtype == right.dtype == np.uint8:
        raise ValueError(f"expected two equal (h, w, 3) uint8 images, not {left.shape} and {right.shape}")
    height, width = left.shape[:2]
    both = np.zeros((height + height % 2, 2 * width + _GAP, 3), np.uint8)
    both[:height, :width], both[:height, width + _GAP :] = left, right
    scale = max(height / 480.0, 0.3)
    for label, x in zip(_LABELS, (0, width + _GAP), strict=True):
        place = (x + round(12 * scale), height - round(14 * scale))
        for color, thickness in (((0, 0, 0), 4), ((255, 255, 255), 1)):
            cv2.putText(both, label, place, _FONT, 0.7 * scale, color, max(1, round(thickness * scale)), cv2.LINE_AA)
    return both


def _write(temporary: Path, path: Path, images: Iterable[ByteArray], fps: float, count: int, progress: Progress) -> int:
    """Write the images and return how many there were."""
    writer, shape, written = None, None, 0
    try:
        for image in images:
            if writer is None:
                shape = image.shape
                codec = cv2.VideoWriter.fourcc(*_CODECS[path.suffix.lower()])
                writer = cv2.VideoWriter(str(temporary), codec, fps, (shape[1], shape[0]))
                if not writer.isOpened():
                    raise UserError(f"{path}: OpenCV cannot write this video at {fps:g} Hz: try .avi or another --out")
            if image.shape != shape:
                raise ValueError(f"image {written} is {image.shape}, the first was {shape}")
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
            written += 1
            progress("export", min(1.0, written / count) if count else 0.0, f"frame {written - 1}")
    finally:
        if writer is not None:
            writer.release()
    if not written:
        raise UserError(f"{path}: there is no frame to show: choose other --frames")
    return written
