"""Energies against NumPy, and what is not finite wherever it stands."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.kernels.energy import energy_of, first_not_finite


@pytest.mark.parametrize("size", [0, 1, 7, 64, 1001])
def test_energy_of_samples_is_the_sum_of_their_squares(size):
    samples = np.random.default_rng(size).standard_normal(size).astype(np.float32)
    assert_allclose(energy_of(samples), np.sum(samples.astype(np.float64) ** 2), rtol=1e-14)


def test_energy_of_samples_has_squares_that_single_precision_lacks():
    assert_allclose(energy_of(np.array([1e-30, 2e30], np.float32)), 4e60, rtol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e20])
@pytest.mark.parametrize("at", [(0, 0, 0), (1, 1, 12), (2, 0, 98), (2, 1, 99)])
def test_first_not_finite_finds_the_first_signal_with_such_a_sample(value, at):
    signals = np.ones((3, 2, 100), np.float32)
    assert first_not_finite(signals) == -1
    signals[at] = value
    assert first_not_finite(signals) == at[0]
    signals[2, 1, 50] = np.nan
    assert first_not_finite(signals) == at[0]
