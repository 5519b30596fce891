"""`rstrack.images.sampling`: cubic convolution, and the pixels of a raster."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from rstrack_util import ENGINE

from rsgen.device.arrays import engine
from rsgen.geometry.camera import Camera
from rstrack.images.sampling import Raster, cubic_value_and_slope, grid, value_and_slope

SIZE = 16, 12


def looked_up(image: np.ndarray, x: np.ndarray, y: np.ndarray, read=cubic_value_and_slope) -> list[np.ndarray]:
    e = engine("llvm")
    found = read(e, e.upload(image.astype(np.float32)), *SIZE, e.upload(x), e.upload(y), e.Bool(True))
    return [np.array(each) for each in found]


def positions(count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(1.1, SIZE[0] - 2.1, count), rng.uniform(1.1, SIZE[1] - 2.1, count)


def pixels() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    return x, y


def test_cubic_convolution_is_exact_on_parabolas_with_their_slopes() -> None:
    def shape(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.3 + 0.02 * x - 0.01 * y + 0.004 * x * x - 0.003 * y * y + 0.002 * x * y

    x, y = positions()
    value, dx, dy, active = looked_up(shape(*pixels()), x, y)
    assert active.all()
    np.testing.assert_allclose(value, shape(x, y), atol=2e-6)
    np.testing.assert_allclose(dx, 0.02 + 0.008 * x + 0.002 * y, atol=5e-6)
    np.testing.assert_allclose(dy, -0.01 - 0.006 * y + 0.002 * x, atol=5e-6)
    assert np.abs(looked_up(shape(*pixels()), x, y, value_and_slope)[0] - shape(x, y)).max() > 5e-4


def test_slopes_are_those_of_the_values_and_pixels_are_passed_through() -> None:
    image = np.random.default_rng(1).uniform(0.0, 1.0, SIZE[::-1])
    x, y = positions()
    value, dx, dy, _ = looked_up(image, x, y)
    h = 1e-2
    along = [looked_up(image, x + sx * h, y + sy * h)[0] for sx, sy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    # Values have single precision, and a second difference of the slope that may jump at pixels.
    np.testing.assert_allclose(dx, (along[0] - along[1]) / (2 * h), atol=5e-3)
    np.testing.assert_allclose(dy, (along[2] - along[3]) / (2 * h), atol=5e-3)
    whole = looked_up(image, np.array([3.0, 12.0]), np.array([4.0, 1.0]))
    np.testing.assert_allclose(whole[0], image[[4, 1], [3, 12]], atol=1e-6)
    np.testing.assert_allclose(whole[1], 0.5 * (image[[4, 1], [4, 13]] - image[[4, 1], [2, 11]]), atol=1e-6)
    assert value.shape == x.shape


def test_only_where_all_sixteen_pixels_are_there() -> None:
    x, y = np.array([0.9, 1.0, 13.9, 14.0, 5.0, 5.0]), np.array([5.0, 5.0, 5.0, 5.0, 0.5, 10.0])
    assert looked_up(np.ones(SIZE[::-1]), x, y)[3].tolist() == [False, True, True, False, False, False]


@pytest.mark.parametrize(("width", "height", "stride"), [(7, 5, 1), (641, 481, 2), (4000, 3001, 1)])
def test_a_raster_that_is_handed_over_has_the_pixels_of_one_that_is_compiled_in(
    width: int, height: int, stride: int
) -> None:
    raster = Raster.of(Camera(width, height, 500.0, 500.0, width / 2, height / 2), stride)
    y, x = np.mgrid[:height:stride, :width:stride].reshape(2, -1)
    numbers = [(ENGINE.UInt if isinstance(one, int) else ENGINE.Float)(one) for one in raster.numbers]
    dr.make_opaque(numbers)
    for one in (raster, raster.traced(numbers)):
        for got, want in zip(grid(ENGINE, one), (y * width + x, x, y), strict=True):
            np.testing.assert_array_equal(got.numpy(), want)
