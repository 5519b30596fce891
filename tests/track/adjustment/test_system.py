"""Systems of blocks against dense algebra, and older keyframes against a plain look at each pair."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.adjustment.loops import AGREE, KeyframeTrack, candidates
from rstrack.adjustment.system import _HELD, BlockSystem, Layout
from rstrack.options import Options

# Block 5 is tied to all, as a keyframe is; several blocks lie at some places.
PLACES = [(n, n) for n in range(6)] * 2 + [(n, n + 1) for n in range(5)] * 2 + [(n, 5) for n in range(4)]


def filled(
    rng: np.random.Generator, places: list[tuple[int, int]], layouts: list[Layout]
) -> tuple[BlockSystem, FloatArray]:
    """A system, and its H."""
    system, H = BlockSystem(6, layouts), np.zeros((36, 36))
    for r, c in places:
        block = rng.normal(size=(6, 6))
        block = 40.0 * np.eye(6) + block + block.T if r == c else block
        system.put(np.array([r]), np.array([c]), block[None])
        H[6 * r : 6 * r + 6, 6 * c : 6 * c + 6] += block
        if r != c:
            H[6 * c : 6 * c + 6, 6 * r : 6 * r + 6] += block.T
    H[:6, :6] += _HELD * np.eye(6)
    system.g[:] = rng.normal(size=(6, 6))
    return system, H


def test_a_system_is_solved_as_a_dense_one_and_so_is_the_next_of_its_layout() -> None:
    rng, layouts = np.random.default_rng(1), list[Layout]()
    for places, is_new in ((PLACES, True), (PLACES, False), (PLACES[:-1], True), (PLACES, True)):
        before = layouts[:]
        system, H = filled(rng, places, layouts)
        np.testing.assert_allclose(
            system.solved().ravel(), -np.linalg.solve(H, system.g.ravel()), rtol=1e-9, atol=1e-12
        )
        assert len(layouts) == 1 and (not before or layouts[0] is not before[0]) == is_new


def test_covariances_are_those_of_the_dense_inverse() -> None:
    system, H = filled(np.random.default_rng(2), PLACES, [])
    numbers = np.array([7, 20, -1])
    np.testing.assert_allclose(system.covariance()(numbers), np.linalg.inv(H)[np.ix_(numbers, numbers)], rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_older_keyframes_are_those_that_a_look_at_each_pair_finds(seed: int) -> None:
    rng, options = np.random.default_rng(seed), Options()
    # To and fro over a metre and a half.
    at = np.concatenate([np.linspace(0.0, 1.5, 8), np.linspace(1.4, 0.1, 7)])
    T = se3.exp(np.column_stack([at, rng.normal(scale=0.05, size=(15, 5))]))
    spread = np.cumsum(rng.uniform(0.0, 2e-4, 15))[:, None, None] * np.eye(6)
    order = [3 * n for n in range(15)]
    track = KeyframeTrack(order, T, spread)
    for n in range(15):
        alike = [int(k) for k in rng.permutation(track.older(n))[:8]]
        steps = [np.linalg.norm(se3.log(se3.inverse(a) @ b).reshape(2, 3), axis=1) for a, b in pairwise(T)]
        rated = []
        for m in range(n - 2):
            T_rel = se3.inverse(T[m]) @ T[n]
            Ad = se3.adjoint(se3.inverse(T[n]))
            own = Ad @ (spread[n] - spread[m]) @ Ad.T
            sigma = np.sqrt([np.trace(own[:3, :3]), np.trace(own[3:, 3:])])
            allowed = 6.0 * sigma + 0.02 * np.sum(steps[m:n], axis=0) + AGREE
            hidden = max(allowed[0] / 0.3, np.degrees(min(allowed[1], 1.0)) / 20.0)
            remote = options.remoteness(T_rel)
            first = order[m] in alike[:3] and remote < 1.2 + hidden
            if order[m] in alike and (remote < 1.2 or first):
                rated.append((remote, m, T_rel, allowed))
        expected: list[tuple[int, FloatArray, FloatArray]] = []
        for _, m, T_rel, allowed in sorted(rated, key=lambda one: one[0]):
            if len(expected) < 3 and all(abs(order[m] - k) >= 6 for k, _, _ in expected):
                expected.append((order[m], T_rel, allowed))
        found = candidates(track, n, alike, options)
        assert [early for early, _, _ in found] == [k for k, _, _ in expected]
        for (_, T_early_late, may_be_off), (_, T_rel, allowed) in zip(found, expected, strict=True):
            np.testing.assert_allclose(T_early_late, T_rel, atol=1e-12)
            np.testing.assert_allclose(may_be_off, allowed, rtol=1e-9)
    assert candidates(track, 14, track.older(14), options)
