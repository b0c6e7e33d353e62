"""Compiled vectors and transforms against NumPy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.kernels.compiled import compiled
from server.kernels.lane_fft import order, transform_lanes, twiddles
from server.kernels.simd import LANES, cosine_sine, exponential, load, store


@compiled
def _elementary(x, exponentials, cosines, sines) -> None:
    for n in range(0, x.size, LANES):
        values = load(x.ctypes.data, n)
        store(exponentials.ctypes.data, n, exponential(values))
        cosine, sine = cosine_sine(values)
        store(cosines.ctypes.data, n, cosine)
        store(sines.ctypes.data, n, sine)


def _of(values):
    x = np.resize(np.asarray(values, np.float32), -(-np.size(values) // LANES) * LANES)
    results = np.empty((3, x.size), np.float32)
    _elementary(x, *results)
    return x, *results


def test_exponentials_are_right_to_the_last_digits():
    x, exponentials, _, _ = _of(np.linspace(-87, 88, 100_003))
    assert_allclose(exponentials, np.exp(x.astype(np.float64)), rtol=3e-7)


def test_exponentials_of_anything_are_finite_and_of_nothing_nothing():
    _, exponentials, _, _ = _of([-np.inf, np.inf, 1e30, -1e30, np.nan, 0.0])
    assert np.isfinite(exponentials[[0, 1, 2, 3, 5]]).all()
    assert exponentials[0] < 1e-37
    assert np.isnan(exponentials[4])


def test_cosines_and_sines_are_right_for_hundreds_of_turns():
    x, _, cosines, sines = _of(np.linspace(-1000, 1000, 100_003))
    assert_allclose(cosines, np.cos(x.astype(np.float64)), atol=3e-7)
    assert_allclose(sines, np.sin(x.astype(np.float64)), atol=3e-7)


@pytest.mark.parametrize("points", [8, 16, 64, 128, 256, 512, 2048])
def test_each_lane_is_transformed_by_itself(points):
    values = np.random.default_rng(points).standard_normal((2, points, LANES), dtype=np.float32)
    expected = np.fft.fft(values[0].astype(np.float64) + 1j * values[1], axis=0)
    transform_lanes(values.ctypes.data, points, twiddles(points).ctypes.data)
    transformed = np.empty((points, LANES), np.complex128)
    transformed[order(points)] = values[0] + 1j * values[1]
    assert_allclose(transformed, expected, atol=2e-6 * np.abs(expected).max())
