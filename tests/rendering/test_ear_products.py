"""What ears hear of harmonics, against sums over plane waves."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.acoustics.geometry import Quaternion, axes_of
from server.acoustics.spherical_harmonics import even_directions, real_harmonics, rotation
from server.rendering.ear_products import EarProducts, wave_spectra
from server.rendering.hrtf import kemar

BINS = 129
HEAD = kemar(24_000)


def of_waves(directions, powers, orientation=(0.0, 0.0, 0.0, 1.0)):
    """(bin, product) of waves from directions in world axes."""
    spectra = wave_spectra(HEAD, np.ascontiguousarray(directions @ axes_of(orientation).T), BINS)
    left, right = spectra[:, 0], spectra[:, 1]
    cross = left * np.conj(right)
    return np.einsum("pdf,d->fp", np.stack([abs(left) ** 2, abs(right) ** 2, cross.real, cross.imag]), powers)


def turned(products, orientation):
    """The products for harmonics in world axes."""
    return products.matrix @ rotation(orientation, products.order)


def test_diffuse_sound_is_the_mean_over_all_directions():
    directions = even_directions(5000)
    expected = of_waves(directions, np.full(5000, 1 / 5000))
    assert_allclose(EarProducts.of(HEAD, bins=BINS, order=0).matrix[..., 0], expected, atol=2e-3 * expected.max())


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_sound_that_is_a_sum_of_low_harmonics_is_heard_exactly(order, yaw):
    rng = np.random.default_rng(order)
    shape = rng.normal(size=(order + 1) ** 2) * 0.2
    shape[0] = 1.0
    directions = even_directions(5000)
    harmonics = real_harmonics(directions, order)
    powers = harmonics @ shape / len(directions)  # negative somewhere, which a sum does not mind
    orientation = Quaternion(0.1, -0.2, np.sin(yaw / 2), np.cos(yaw / 2))
    found = turned(EarProducts.of(HEAD, bins=BINS, order=order), orientation) @ (powers @ harmonics)
    expected = of_waves(directions, powers, orientation)
    assert_allclose(found, expected, atol=5e-3 * expected.max())


def test_the_ear_on_the_side_of_the_sound_hears_more():
    at_left = real_harmonics([0.0, 1.0, 0.0], 2)
    products = EarProducts.of(HEAD, bins=BINS, order=2)
    heard = turned(products, (0.0, 0.0, 0.0, 1.0)) @ at_left
    assert (heard[20:, 0] > 2 * heard[20:, 1]).all()
    behind = turned(products, Quaternion.from_yaw(np.pi)) @ at_left
    assert (behind[20:, 1] > 2 * behind[20:, 0]).all()


def test_products_of_a_head_are_kept():
    assert EarProducts.of(HEAD, bins=BINS, order=2) is EarProducts.of(HEAD, bins=BINS, order=2)
