"""Folders in the layout of TUM RGB-D, among them Kerl et al.'s rolling-shutter sets, and of ICL-NUIM.

    rgb.txt, depth.txt    'stamp path' lines; or associations.txt with 'stamp path stamp path', depth or colour first
    intrinsics.csv        optional: of each image; see `rstrack.data.registration`
    camera.yaml           the cameras: see `camera_file`; or an OpenCV calibration.yaml: see `foreign_camera_files`
    groundtruth.txt       optional: poses of the colour camera; ICL-NUIM's NAME.gt.freiburg also

Stamps without any decimal point are frame numbers at 30 Hz, as in ICL-NUIM. Colour images are 8-bit PNG or JPEG, depth
images 16-bit grey PNG. One that is the one before again is left out: it was not taken at its stamp.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import listed_file, read_text
from rsgen.sequence.trajectory import ICL_RATE_HZ, MAX_STAMP_S, Trajectory, read_trajectory
from rstrack.data.camera_file import CAMERA_FILES, EXAMPLE, RigFile, find_camera_file, read_rig
from rstrack.data.dataset import Dataset, recorded_dataset
from rstrack.data.image_files import (
    ImageFiles,
    decode_color,
    decode_depth,
    decode_image,
    first_size,
    repeated,
    repeats_note,
)
from rstrack.data.registration import OwnIntrinsics, SharedImages, read_own_intrinsics
from rstrack.data.rig import Rig

_ASSOCIATIONS = ("associations.txt", "associate.txt", "association.txt")
ESTIMATED = "# estimated, not measured: "
"""Begins the first line of a groundtruth.txt whose poses are another estimate from the same images."""


def matches(root: Path) -> bool:
    """Whether a folder has listings."""
    return any((root / name).exists() for name in ("rgb.txt", "depth.txt", *_ASSOCIATIONS))


def read(root: Path, camera_file: Path | None) -> Dataset:
    """Read cameras, listings and ground truth; images are decoded when asked for, but all have to be there.

    camera_file: default camera.yaml, calibration.yaml or Kalibr's camchain-imucam.yaml or camchain.yaml in the folder.
    Raises UserError, one line.
    """
    depth, color = _listings(root)
    (depth, depth_note), (color, color_note) = (
        listing.without_repeats(name) for name, listing in (("depth", depth), ("colour", color.sorted()))
    )
    file = _rig_file(root, camera_file, color.paths, depth.paths)
    files = ImageFiles(file.rig, file.depth_scale, color.paths, depth.paths)
    rate = ICL_RATE_HZ if depth.has_frame_numbers and color.has_frame_numbers else 1.0
    stamps = depth.stamps / rate, color.stamps / rate
    own_color = read_own_intrinsics(root, "color", stamps[1], file.rig.color_camera)
    own_depth = read_own_intrinsics(root, "depth", stamps[0], file.rig.depth_camera)
    images = files if own_color is own_depth is None else SharedImages(files, own_color, own_depth)
    notes = (*depth_note, *color_note, *_own_notes(own_color, own_depth), *_truth_note(root))
    return recorded_dataset(root, file, *stamps, images, _truth(root, file.rig), notes)


# --- listings --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Entry:
    """One image of a listing: number of its line, stamp and path as written."""

    line: int
    stamp: str
    path: str


@dataclass(frozen=True)
class _Listing:
    """One stream's images as listed, in the order of the file."""

    root: Path
    file: Path
    entries: tuple[_Entry, ...]

    @cached_property
    def stamps(self) -> FloatArray:
        """Stamps (n,) as listed: seconds, or frame numbers. Raises UserError naming the line."""
        return np.array([self._seconds(entry) for entry in self.entries])

    @property
    def has_frame_numbers(self) -> bool:
        """Whether it is numbered instead of stamped."""
        return all(entry.stamp.isdigit() for entry in self.entries)

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        """The images' files, all of which exist inside the folder. Raises UserError naming the line."""
        real_root = self.root.resolve()
        return tuple(self._path(entry, real_root) for entry in self.entries)

    def sorted(self) -> _Listing:
        """By stamp, what is listed twice (an image that goes with two depth images) once."""
        once = dict(zip(((e.stamp, e.path) for e in reversed(self.entries)), reversed(self.entries), strict=True))
        entries = sorted(once.values(), key=lambda entry: (self._seconds(entry), entry.line))
        return _Listing(self.root, self.file, tuple(entries))

    def checked(self) -> _Listing:
        """Itself. Raises UserError naming the first line whose stamp does not come after the one before."""
        stamps = self.stamps
        for k in np.flatnonzero(np.diff(stamps) <= 0)[:1] + 1:
            entry, before = self.entries[k], self.entries[k - 1]
            if stamps[k] == stamps[k - 1]:
                raise UserError(
                    f"{self._where(entry)}: repeats the stamp {entry.stamp} of line {before.line}: remove one"
                )
            raise UserError(
                f"{self._where(entry)}: stamp {entry.stamp} does not come after {before.stamp}: sort the file by time"
            )
        return self

    def without_repeats(self, name: str) -> tuple[_Listing, tuple[str, ...]]:
        """Without images that are the one before again, and what there is to say of that. Raises UserError: see
        `checked`."""
        again = repeated(self.checked().paths)
        if not again.any():
            return self, ()
        new = tuple(entry for entry, is_repeat in zip(self.entries, again, strict=True) if not is_repeat)
        return _Listing(self.root, self.file, new), repeats_note(name, again)

    def _where(self, entry: _Entry) -> str:
        return f"{self.file} line {entry.line}"

    def _seconds(self, entry: _Entry) -> float:
        try:
            seconds = float(entry.stamp)
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds):
            raise UserError(f"{self._where(entry)}: {entry.stamp[:40]!r} is not a time in seconds")
        if abs(seconds) > MAX_STAMP_S:
            raise UserError(
                f"{self._where(entry)}: stamp {entry.stamp[:40]} is absurd in seconds: divide nanoseconds by 1e9"
            )
        return seconds

    def _path(self, entry: _Entry, real_root: Path) -> Path:
        missing = "unpack the dataset again or remove the line"
        return listed_file(self.root, real_root, entry.path, self._where(entry), missing)


def _own_notes(*each: OwnIntrinsics | None) -> tuple[str, ...]:
    """What there is to say of images that are taken to one camera, colour's and depth's."""
    return tuple(
        f"{name} images have intrinsics of their own, fx {own.own[:, 0].min():.1f} to {own.own[:, 0].max():.1f}: each "
        f"is taken to fx {own.shared[0]:.1f}"
        for name, own in zip(("colour", "depth"), each, strict=True)
        if own is not None
    )


def _listings(root: Path) -> tuple[_Listing, _Listing]:
    """Depth and colour images that the folder lists. Raises UserError."""
    depth_file, color_file = root / "depth.txt", root / "rgb.txt"
    associations = next((root / name for name in _ASSOCIATIONS if (root / name).exists()), None)
    if associations is None or (depth_file.exists() and color_file.exists()):
        return (
            _Listing(root, depth_file, tuple(entry for (entry,) in _entries(depth_file, 1))),
            _Listing(root, color_file, tuple(entry for (entry,) in _entries(color_file, 1))),
        )
    left, right = (_Listing(root, associations, entries) for entries in zip(*_entries(associations, 2), strict=True))
    return (left, right) if _is_depth_first(left, right) else (right, left)


def _entries(file: Path, images: int) -> list[tuple[_Entry, ...]]:
    """The images of each line of a listing, of which there are `images`. Raises UserError."""
    found = []
    for number, line in enumerate(read_text(file).removeprefix("\ufeff").splitlines(), 1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        if len(fields) != 2 * images:
            raise UserError(f"{file} line {number}: expected '{'stamp path ' * images}', found {line[:60]!r}")
        found.append(tuple(_Entry(number, *fields[i : i + 2]) for i in range(0, len(fields), 2)))
    if not found:
        raise UserError(f"{file}: lists no image: expected lines of 'stamp path'")
    return found


def _is_depth_first(left: _Listing, right: _Listing) -> bool:
    """By what the first two files hold: published lists come both ways round."""
    kinds = [decode_image(listing.paths[0]).dtype == np.uint16 for listing in (left, right)]
    if kinds[0] == kinds[1]:
        what = "two depth images" if kinds[0] else "no 16-bit depth image"
        raise UserError(f"{left._where(left.entries[0])}: has {what}: give one colour and one depth image a line")
    return kinds[0]


# --- cameras and truth -----------------------------------------------------------------------------------------------


def _rig_file(root: Path, camera_file: Path | None, color: Sequence[Path], depth: Sequence[Path]) -> RigFile:
    file = find_camera_file(root, camera_file)
    if file is None:
        raise UserError(
            f"{root}: nothing states the cameras: write {root / CAMERA_FILES[0]} (or give a camera file) with "
            f"'{EXAMPLE}' and, unless depth is registered to colour, 'depth: {{...}}' likewise"
        )
    return read_rig(file, first_size(color, decode_color), first_size(depth, decode_depth))


def _truth(root: Path, rig: Rig) -> Trajectory | None:
    """T_world_depth at its stamps, from a file that holds the poses of the colour camera, as TUM defines it."""
    files: Iterable[Path] = (root / "groundtruth.txt", *sorted(root.glob("*.gt.freiburg")))
    file = next((file for file in files if file.exists()), None)
    if file is None:
        return None
    # Motion capture loses the camera now and then; what an evaluation interpolates over is its own business.
    return read_trajectory(file, max_gap_s=math.inf).moved(T_body_cam=rig.T_color_depth)


def _truth_note(root: Path) -> tuple[str, ...]:
    """A note on a truth that is itself an estimate, by its first line."""
    file = root / "groundtruth.txt"
    if not file.is_file():
        return ()
    with file.open("rb") as opened:
        first = opened.readline(200).decode("utf-8", "replace").strip()
    if not first.startswith(ESTIMATED):
        return ()
    return (
        f"{file.name} is estimated, not measured: {first.removeprefix(ESTIMATED)}; errors against it are differences",
    )
