"""Noise on frames: its distribution, what it leaves alone, and that every frame has its own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rsgen.errors import UserError
from rstrack.data.image_files import with_noise
from rstrack.data.rig import Frame, Image

SHAPE = (240, 320)
SIGMA_Z = 1.2e-3


def make_frame(z: float = 2.0, grey: int = 120, colors: int = 1) -> Frame:
    depth = np.full(SHAPE, z, np.float32)
    color = np.full((*SHAPE, 3), grey, np.uint8) + np.array([-40, 0, 30], np.int16)
    return Frame(Image(0.5, depth), tuple(Image(0.5 + i, color.astype(np.uint8)) for i in range(colors)))


def test_depth_noise_is_gaussian_and_grows_with_the_square_of_depth() -> None:
    for z in (0.7, 2.0, 5.0):
        noisy = with_noise(make_frame(z), 3, SIGMA_Z, 0.0, 7).depth.pixels
        assert noisy.dtype == np.float32
        unit = (noisy.astype(float) - np.float32(z)).ravel() / (SIGMA_Z * z * z)
        # Five standard errors of mean, deviation, and the test of the whole distribution.
        n = unit.size
        assert abs(unit.mean()) < 5 / np.sqrt(n)
        assert abs(unit.std() - 1) < 5 / np.sqrt(2 * n)
        assert stats.kstest(unit[::10], "norm").pvalue > 1e-4


def test_missing_depth_stays_missing_and_nothing_goes_below_zero() -> None:
    z = np.full(SHAPE, 3.0, np.float32)
    z[::2] = 0.0
    noisy = with_noise(Frame(Image(0.0, z), ()), 0, 1.0, 0.01, 0)
    assert (noisy.depth.pixels[::2] == 0).all()
    assert noisy.depth.pixels.min() == 0.0 and (noisy.depth.pixels[1::2] > 0).mean() == pytest.approx(0.63, abs=0.02)
    assert noisy.colors == ()


def test_grey_value_has_the_asked_deviation() -> None:
    for sigma in (0.01, 0.05):
        frame = make_frame()
        noisy = with_noise(frame, 5, 0.0, sigma, 1).colors[0].pixels
        assert noisy.dtype == np.uint8
        change = noisy.astype(int) - frame.colors[0].pixels
        assert (change == change[..., :1]).all()
        grey = (noisy @ np.array([0.299, 0.587, 0.114]) / 255).ravel()
        expected = np.sqrt(sigma**2 + 1 / 12 / 255**2)
        assert grey.std() == pytest.approx(expected, abs=5 * expected / np.sqrt(2 * grey.size))
        assert abs(change.mean()) < 5 * 255 * expected / np.sqrt(grey.size)


def test_intensity_is_clipped_and_not_wrapped() -> None:
    for grey in (40, 225):  # 0 and 255 in one of the channels
        noisy = with_noise(make_frame(grey=grey), 0, 0.0, 10.0, 0).colors[0].pixels
        assert 0.4 < (noisy == 0).mean() < 0.6 and 0.4 < (noisy == 255).mean() < 0.6


def test_same_frame_has_the_same_noise_and_every_other_has_its_own() -> None:
    frame = make_frame(colors=2)
    first = with_noise(frame, 4, SIGMA_Z, 0.01, 9)
    again = with_noise(frame, 4, SIGMA_Z, 0.01, 9)
    np.testing.assert_array_equal(first.depth.pixels, again.depth.pixels)
    for a, b in zip(first.colors, again.colors, strict=True):
        np.testing.assert_array_equal(a.pixels, b.pixels)

    def fields(noisy: Frame) -> list[np.ndarray]:
        images = [noisy.depth.pixels - frame.depth.pixels]
        images += [c.pixels[..., 0].astype(float) - frame.colors[0].pixels[..., 0] for c in noisy.colors]
        return [image.ravel() for image in images]

    others = [with_noise(frame, 5, SIGMA_Z, 0.01, 9), with_noise(frame, 4, SIGMA_Z, 0.01, 10)]
    # k and seed swapped must not meet either.
    others += [with_noise(frame, 9, SIGMA_Z, 0.01, 4)]
    correlation = np.corrcoef(np.stack([field for noisy in (first, *others) for field in fields(noisy)]))
    assert np.abs(correlation - np.eye(len(correlation))).max() < 5 / np.sqrt(np.prod(SHAPE))


def test_zero_deviation_changes_nothing_and_stamps_stay() -> None:
    frame = make_frame(colors=2)
    same = with_noise(frame, 2, 0.0, 0.0, 3)
    np.testing.assert_array_equal(same.depth.pixels, frame.depth.pixels)
    assert same.colors == frame.colors
    noisy = with_noise(frame, 2, SIGMA_Z, 0.01, 3)
    assert noisy.depth.stamp == frame.depth.stamp and [c.stamp for c in noisy.colors] == [0.5, 1.5]
    assert frame.depth.pixels.max() == 2.0  # the input is left alone


@pytest.mark.parametrize(
    ("arguments", "named"),
    [((-1e-3, 0.0, 0), "sigma_depth"), ((0.0, float("nan"), 0), "sigma_intensity"), ((0.0, 0.0, -1), "seed")],
)
def test_absurd_arguments_are_refused(arguments: tuple[float, float, int], named: str) -> None:
    with pytest.raises(UserError, match=named) as error:
        with_noise(make_frame(), 0, *arguments)
    assert "\n" not in str(error.value)
