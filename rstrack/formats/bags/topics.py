"""Which topics of a bag hold what: named, or found by their types and names."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from rsgen.errors import UserError, first_few
from rstrack.formats.bags.bag import BagReader

IMAGE, COMPRESSED, INFO, IMU = (
    "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/CameraInfo", "sensor_msgs/Imu",
)  # fmt: skip
_TRANSPORTS = ("/compressedDepth", "/compressed")
_NOT_COLOR = ("depth", "infra", "/ir", "confidence", "disparity", "left", "right", "mono", "fisheye", "mask")
_REGISTERED = ("aligned_depth", "depth_registered", "depth_to_rgb", "depth_to_color", "registered")
_MOST_NAMED = 12


def base_of(topic: str) -> str:
    """The image's topic without the transport's part of the name."""
    return next((topic.removesuffix(ending) for ending in _TRANSPORTS if topic.endswith(ending)), topic)


def is_registered(topic: str) -> bool:
    """Whether depth of this topic was warped into the colour camera, by its name."""
    return any(word in topic.lower() for word in _REGISTERED)


def is_rectified(topic: str) -> bool:
    """Whether images of this topic are undistorted: their camera is P of camera_info, without distortion."""
    return "rect" in base_of(topic).rpartition("/")[2].lower()


def find_color(bag: BagReader, named: str | None) -> str:
    """The topic of the colour images. Raises UserError."""

    def rank(topic: str) -> tuple[bool, ...]:
        name = topic.lower()
        return "color" not in name and "rgb" not in name, is_rectified(topic), "raw" not in name

    return _chosen(bag, named, "--color", "colour", _is_color, rank)


def find_depth(bag: BagReader, named: str | None) -> list[str]:
    """Topics of depth images: the sensor's own, or one warped into the colour camera, or both in this order.

    Raises UserError.
    """
    if named is not None:
        return [_chosen(bag, named, "--depth", "depth", _is_depth, lambda _: ())]
    found = [topic for topic in bag.of_kind(IMAGE, COMPRESSED) if _is_depth(topic)]
    kinds = [[t for t in found if is_registered(t) == registered] for registered in (False, True)]
    if not found:
        raise UserError(f"{bag.path}: has no depth images: name their topic with --depth; {listed(bag)}")
    return [
        _only(bag, topics, "--depth", "depth", lambda topic: ("image" not in topic.rpartition("/")[2],))
        for topics in kinds
        if topics
    ]


def find_info(bag: BagReader, image: str, named: str | None, option: str) -> str:
    """The topic of the camera_info that goes with an image's. Raises UserError."""
    known = bag.of_kind(INFO)
    if named is not None:
        if named not in known:
            raise UserError(f"{bag.path}: {option} {named}: no such camera_info; {_some(known)}")
        return named
    base = base_of(image)
    parent = base.rpartition("/")[0]
    for place in (parent, base, parent.rpartition("/")[0]):
        if f"{place}/camera_info" in known:
            return f"{place}/camera_info"
    raise UserError(
        f"{bag.path}: nothing states the camera of {image}: name its camera_info with {option}; {_some(known)}"
    )


def find_imu(bag: BagReader) -> tuple[str, ...]:
    """Topics of the IMU: one that has both, or those of gyro and accelerometer; none where there is no IMU."""
    topics = bag.of_kind(IMU)
    pair = [next((t for t in topics if word in t.lower()), None) for word in ("gyro", "accel")]
    whole = [t for t in topics if not re.search("gyro|accel", t.lower())]
    if whole:
        return (min(whole, key=lambda t: ("camera" not in t.lower(), len(t), t)),)
    return tuple(t for t in pair if t is not None)


def listed(bag: BagReader) -> str:
    """The image topics there are, or all topics where there are none."""
    return _some(bag.of_kind(IMAGE, COMPRESSED) or list(bag.topics))


def _is_depth(topic: str) -> bool:
    return "depth" in topic.lower() and "confidence" not in topic.lower()


def _is_color(topic: str) -> bool:
    name = topic.lower()
    return not any(word in name for word in _NOT_COLOR) and not topic.endswith(_TRANSPORTS[0])


def _chosen(
    bag: BagReader, named: str | None, option: str, what: str, fits: Callable[[str], bool],
    rank: Callable[[str], tuple[bool, ...]],
) -> str:  # fmt: skip
    images = bag.of_kind(IMAGE, COMPRESSED)
    if named is not None:
        if named not in images:
            raise UserError(f"{bag.path}: {option} {named}: no such image topic; {listed(bag)}")
        return named
    found = [topic for topic in images if fits(topic)]
    if not found:
        raise UserError(f"{bag.path}: has no {what} images: name their topic with {option}; {listed(bag)}")
    return _only(bag, found, option, what, rank)


def _only(
    bag: BagReader, found: Sequence[str], option: str, what: str, rank: Callable[[str], tuple[bool, ...]]
) -> str:  # fmt: skip
    """The first by rank, of several transports of the same images the plainest. Raises UserError where two tie."""

    def full(topic: str) -> tuple[tuple[bool, ...], int]:
        transport = next((k for k, ending in enumerate(_TRANSPORTS, 1) if topic.endswith(ending)), 0)
        return rank(topic), transport

    first, *others = sorted(found, key=full)
    same = [topic for topic in others if full(topic)[0] == full(first)[0] and base_of(topic) != base_of(first)]
    if same:
        raise UserError(f"{bag.path}: several topics may be {what}: name one with {option}; {_some([first, *same])}")
    return first


def _some(topics: Sequence[str]) -> str:
    return f"there are {first_few(topics, _MOST_NAMED)}" if topics else "there is none"
