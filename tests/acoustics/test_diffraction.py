"""The knife-edge law against Maekawa's chart and against two theories of diffraction."""

import numpy as np
import pytest
from scipy.special import fresnel

from server.acoustics import diffraction
from server.acoustics.decibels import amplitude_to_db
from server.acoustics.diffraction import CLEAR_FRESNEL_NUMBER
from tests.oracles.sound_path import diffraction_gain_db as gain_db_by_numpy
from training.trials.edge_theories import MAEKAWA_LOSS_DB

diffraction_gain_db = np.vectorize(diffraction.diffraction_gain_db, otypes=[float])


@pytest.mark.parametrize(("fresnel_number", "loss_db"), MAEKAWA_LOSS_DB.items())
def test_agrees_with_the_chart(fresnel_number: float, loss_db: float) -> None:
    assert abs(diffraction_gain_db(fresnel_number) + loss_db) < 1.0


def test_is_within_a_few_db_of_kirchhoffs_integral_over_a_half_plane() -> None:
    """Which is 6 dB at grazing, deeper in the shadow than measured, and ripples in the light."""
    number = np.concatenate([-np.geomspace(30, 1e-3, 200), np.geomspace(1e-3, 100, 200)])
    sine, cosine = fresnel(np.sign(number) * np.sqrt(2 * np.abs(number)))
    kirchhoff = amplitude_to_db(np.abs((1 + 1j) / 2 * ((0.5 - cosine) - 1j * (0.5 - sine))))
    difference = diffraction_gain_db(number) - kirchhoff
    assert np.all((difference > -1.5) & (difference < 3.5))


def test_deep_in_the_shadow_it_is_kellers_ray_on_top_of_one_over_the_bent_path() -> None:
    """Keller's coefficient of an absorbing half-plane, at any angle and distances: 0 to 3 dB below the law."""
    rng = np.random.default_rng(3)
    before, after = rng.uniform(0.5, 20, (2, 2000))
    turn, wavelength = rng.uniform(0.05, 2.8, 2000), rng.uniform(0.02, 2, 2000)
    length = before + after
    straight = np.sqrt(before**2 + after**2 + 2 * before * after * np.cos(turn))
    number = 2 * (length - straight) / wavelength
    coefficient = np.sqrt(wavelength) / (4 * np.pi * np.sin(turn / 2))
    keller = amplitude_to_db(coefficient * np.sqrt(length / (before * after)))
    deep = number > 3
    assert np.count_nonzero(deep) > 500
    difference = (diffraction_gain_db(number) - keller)[deep]
    assert np.all((difference > -0.1) & (difference < 3.1))


def test_is_continuous_rising_with_the_detour_and_smooth_at_the_shadow_boundary() -> None:
    number = np.linspace(-0.5, 0.5, 200_001)
    loss = -diffraction_gain_db(number)
    step = np.diff(loss)
    assert np.all(step >= 0)
    assert np.max(step) < 5e-4
    slope = step / np.diff(number)
    # 20 log10(1 + x^2 / 3) from both sides, to first order.
    np.testing.assert_allclose(slope[99_990:100_010], 20 / np.log(10) * 2 * np.pi / 3, rtol=1e-3)


def test_is_exactly_nothing_in_the_clear() -> None:
    assert diffraction_gain_db([CLEAR_FRESNEL_NUMBER, -0.25, -1.0, -1e6, -np.inf]).tolist() == [0.0] * 5
    assert abs(diffraction_gain_db(CLEAR_FRESNEL_NUMBER + 1e-9)) < 1e-6
    assert diffraction_gain_db(0.0) == -5.0
    assert np.isfinite(diffraction_gain_db(1e12))


def test_compiled_and_numpy_agree() -> None:
    numbers = np.concatenate([np.linspace(-1, 4, 5_001), [0.0, -0.0, 5e-324, -5e-324, 1e-9, -1e-9, 1e300, -1e300]])
    np.testing.assert_allclose(diffraction_gain_db(numbers), gain_db_by_numpy(numbers), atol=1e-12)
