"""Loops of paths against the recursions that they stand for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.kernels.compiled import compiled
from server.rendering import path_loops


@compiled
def series_exponential(cepstra, reciprocals, sums, taps):
    path_loops.series_exponential(cepstra, reciprocals, sums, taps)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 16, 23, 96, 100, 192])
def test_the_exponential_of_a_series_is_that_of_its_recursion(count):
    rng = np.random.default_rng(count)
    cepstra = rng.standard_normal((2, count)) * np.exp(-np.arange(count) / 20)
    expected = np.zeros((2, count))
    expected[:, 0] = np.exp(cepstra[:, 0])
    for n in range(1, count):
        for k in range(1, n + 1):
            expected[:, n] += k / n * cepstra[:, k] * expected[:, n - k]
    orders = np.maximum(np.arange(count), 1)
    given = np.full((2, count + 8), 1e3, np.float32)
    given[:, :count] = cepstra * orders
    taps = np.zeros((2, count), np.float32)
    series_exponential(given, (1 / orders).astype(np.float32), np.full((2, count + 8), np.nan, np.float32), taps)
    assert_allclose(taps, expected, rtol=0, atol=3e-6 * np.abs(expected).max())
