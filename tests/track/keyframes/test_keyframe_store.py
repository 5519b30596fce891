"""The keyframes that are remembered: how many, which is returned to, which is the anchor, when frames are fused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsgen.geometry import se3
from rstrack.keyframes import store
from rstrack.keyframes.maker import at_once
from rstrack.keyframes.store import KeyframeStore
from rstrack.options import Options

# 0.3 m and 20 degrees are where a keyframe is left; 70 % of that brings an older one back, twice that is the anchor's.
NEAR_M, NEAR_DEG, ANCHOR_M = 0.21, 14.0, 0.6
BRIGHTNESS = np.array([0.1, -0.02])


def at(x: float, degrees: float = 0.0) -> np.ndarray:
    return se3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])) @ se3.exp(np.radians([0, 0, 0, 0, degrees, 0]))


def frame(index: int) -> Any:
    return SimpleNamespace(index=index, depth=f"depth {index}", colors=())


@dataclass(frozen=True, eq=False)
class Stub:
    """A keyframe that knows only its frame, its pose, what it inherited and what was fused into it."""

    index: int
    T_world_base: np.ndarray
    depth: str
    older: Any
    made_by: str
    brightness: Any = None
    device_bytes: int = 1


class Maker:
    """Makes them."""

    def rectified(
        self, index: int, depth: str, colors: Any, pose: np.ndarray, older: Any, as_now: tuple[float, float]
    ) -> Any:
        return Stub(index, pose, depth, older, "maker")

    def rectifying(self, *made_of: Any) -> Iterator[None]:
        yield
        return self.rectified(*made_of)

    def fused(self, ref: Any, depth: str, pose: np.ndarray) -> Any:
        return replace(ref, depth=f"{ref.depth}, {depth}")


class Model:
    """In place of the volume: which frames it has."""

    def __init__(self, maker: Maker, voxel_m: float, _bytes: float) -> None:
        self.maker, self.added = maker, []

    def add(self, depth: str, pose: np.ndarray) -> None:
        self.added.append(depth)

    def keyframe(self, *made_of: Any) -> Any:
        assert made_of[1] not in self.added, "a keyframe would be averaged with its own depth"
        return replace(self.maker.rectified(*made_of), made_by="model")


class Shelf:
    """In place of the archive: which keyframes it has."""

    def __init__(self, maker: Maker, most_bytes: float) -> None:
        self.kept: dict[int, Any] = {}

    def add(self, ref: Any) -> None:
        self.kept[ref.index] = ref

    def get(self, index: int) -> Any:
        return self.kept[index]

    @property
    def indices(self) -> list[int]:
        return list(self.kept)

    def pose(self, index: int) -> np.ndarray:
        return np.asarray(self.kept[index].T_world_base)

    def alike(self, frame: Any, without: set[int]) -> list[int]:
        return [k for k in self.kept if k not in without]


@pytest.fixture(autouse=True)
def shelves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "Archive", Shelf)


@pytest.fixture
def models(monkeypatch: pytest.MonkeyPatch) -> list[Model]:
    """The models that were made."""
    made: list[Model] = []
    monkeypatch.setattr(store, "SurfaceModel", lambda *of: made.append(Model(*of)) or made[-1])
    return made


def keyframes(**options: Any) -> KeyframeStore:
    return KeyframeStore(Maker(), Options(**options))  # type: ignore[arg-type]


def make(kept: KeyframeStore, index: int, pose: np.ndarray, older: Any = None) -> Any:
    made = at_once(kept.making(frame(index), pose, older, BRIGHTNESS))  # type: ignore[arg-type]
    return kept.add(made, frame(index), pose)  # type: ignore[arg-type]


def recent(kept: KeyframeStore) -> list[Any]:
    """The last eight, newest first."""
    return list(kept._recent)[:-9:-1]


def test_without_a_model_the_last_eight_are_kept_and_none_is_returned_to() -> None:
    kept = keyframes()
    assert len(kept) == 0 and recent(kept) == []
    refs = []
    for k in range(11):
        refs.append(make(kept, k, np.eye(4), refs[-1] if refs else None))
        assert kept.newest is refs[-1] and kept.made == k + 1 and len(kept) == min(k + 1, 8)
        assert refs[-1].older is (refs[-2] if k else None)
    assert recent(kept) == refs[:2:-1]
    assert kept.return_to(np.eye(4), refs[-1]) is None and kept.anchor is None


def test_near_a_camera_are_those_it_has_not_left_far_behind_the_nearest_first() -> None:
    """A keyframe is left after 0.3 m or 20 degrees; the newest is asked for by itself."""
    kept = keyframes()
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(28.0), 0.0]))
    away = [se3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])) for x in (3.0, 0.4, 0.1, 0.2, 0.5)]
    for k, pose in enumerate([*away, turned, np.eye(4), *[away[0]] * 9, np.eye(4)]):
        make(kept, k, pose)
    assert [ref.index for ref in kept.near(np.eye(4), 9)] == [6, 2, 3, 1, 5]
    assert [ref.index for ref in kept.near(np.eye(4), 2)] == [6, 2]
    assert kept.near(away[0] @ away[0], 2) == []


def test_any_keyframe_can_be_found_again_in_turn() -> None:
    kept = keyframes()
    refs = [make(kept, k, np.eye(4)) for k in range(12)]
    assert all(ref.brightness is BRIGHTNESS for ref in refs)
    # All but the newest, round and round, and what is still at hand is not taken from the archive.
    for skip, found in ((0, [0, 1]), (4, [4, 5]), (10, [10, 0])):
        assert [ref.index for ref in kept.candidates(frame(20), skip, 2)] == found
    assert kept.candidates(frame(20), 6, 1)[0] is refs[6]
    kept.use(refs[2])
    assert kept.newest is refs[2] and recent(kept)[1] is refs[11] and kept.made == 12


class ByDistance(Options):
    """Quicker to compare by."""

    def remoteness(self, T_base_cam: np.ndarray) -> float:
        return abs(float(T_base_cam[0, 3])) / self.keyframe_distance


@pytest.mark.parametrize(
    ("pose", "is_near"),
    [
        (at(0.99 * NEAR_M), True), (at(1.01 * NEAR_M), False), (at(0.0, 0.99 * NEAR_DEG), True),
        (at(0.0, 1.01 * NEAR_DEG), False), (at(0.9 * NEAR_M, 0.9 * NEAR_DEG), True),
    ],
)  # fmt: skip
def test_a_keyframe_is_returned_to_at_70_percent_of_where_it_is_left(
    pose: np.ndarray, is_near: bool, models: list[Model]
) -> None:
    kept = keyframes(reference="model")
    first, last = make(kept, 0, np.eye(4)), make(kept, 9, at(5.0))
    assert (kept.return_to(pose, last) is first) == is_near
    # The one that is returned to is the newest, and no other is lost.
    assert recent(kept) == ([first, last] if is_near else [last, first])
    assert len(kept) == 2 and kept.made == 2


def test_the_oldest_that_is_near_is_returned_to_but_not_the_one_that_was_left(models: list[Model]) -> None:
    kept = keyframes(reference="model")
    refs = [make(kept, k, at(x)) for k, x in enumerate((0.0, 0.1, 5.0, 0.05))]
    assert kept.return_to(at(0.02), refs[3]) is refs[0]
    assert recent(kept) == [refs[k] for k in (0, 3, 2, 1)]
    # Oldest by its frame, not by its last use.
    assert kept.return_to(at(0.02), refs[0]) is refs[1] and kept.return_to(at(0.02), refs[1]) is refs[0]
    assert kept.return_to(at(5.0), refs[2]) is None
    assert kept.made == 4


def test_the_anchor_is_the_oldest_within_twice_where_a_keyframe_is_left(models: list[Model]) -> None:
    kept = keyframes(reference="model")
    first = make(kept, 0, np.eye(4))
    assert kept.anchor is None  # the newest itself is the oldest
    make(kept, 1, at(0.5 * ANCHOR_M))
    assert kept.anchor is first
    second = make(kept, 2, at(0.99 * ANCHOR_M))
    assert kept.anchor is first
    third = make(kept, 3, at(1.01 * ANCHOR_M))
    assert kept.anchor is recent(kept)[2] and kept.anchor.index == 1
    make(kept, 4, at(5.0))
    assert kept.anchor is None
    # A return has its own.
    assert kept.return_to(at(0.99 * ANCHOR_M + 0.9 * NEAR_M), third) is second and kept.anchor is first
    assert kept.return_to(np.eye(4), second) is first and kept.anchor is None


@pytest.mark.parametrize("reference", ["keyframe", "model"])
@pytest.mark.parametrize("fuse", [True, False])
def test_later_frames_are_fused_as_the_options_want(reference: str, fuse: bool, models: list[Model]) -> None:
    kept = keyframes(reference=reference, fuse=fuse)
    make(kept, 2, at(9.0))
    ref = make(kept, 3, np.eye(4))
    for index in (1, 3):  # the keyframe's own frame and earlier ones are in it already, or belong to another
        assert kept.fuse(frame(index), np.eye(4)) is kept.newest is ref
    after = kept.fuse(frame(4), np.eye(4))
    assert after is kept.newest and (after is ref) != fuse
    assert after.depth == ("depth 3, depth 4" if fuse else "depth 3")
    assert len(kept) == 2 and recent(kept)[1].depth == "depth 2" and kept.made == 2
    # A model has every frame once.
    assert [model.added for model in models] == ([["depth 2", "depth 3", "depth 4"]] if reference == "model" else [])
