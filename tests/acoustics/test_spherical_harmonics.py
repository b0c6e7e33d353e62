"""Spherical harmonics against their definition by Legendre functions, and rotations against theory."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from server.acoustics.geometry import Quaternion, axes_of
from server.acoustics.spherical_harmonics import (
    HIGHEST_ORDER,
    degrees,
    even_directions,
    mean_squares,
    real_harmonics,
    rotation,
)

ORDERS = range(HIGHEST_ORDER + 1)
parts = st.floats(-1, 1).filter(lambda part: abs(part) > 1e-3)
quaternions = st.builds(Quaternion, parts, parts, parts, parts)


def by_definition(directions, order):
    """ACN, SN3D, from complex harmonics, without the Condon-Shortley phase."""
    x, y, z = np.moveaxis(directions, -1, 0)
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    columns = []
    for n in range(order + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), polar, azimuth) * np.sqrt(4 * np.pi / (2 * n + 1))
            part = value.real if m == 0 else np.sqrt(2) * (-1) ** m * (value.imag if m < 0 else value.real)
            columns.append(part)
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("order", ORDERS)
def test_equal_their_definition_by_legendre_functions(order):
    directions = even_directions(500)
    np.testing.assert_allclose(real_harmonics(directions, order), by_definition(directions, order), atol=1e-12)


def test_first_order_is_y_z_x():
    np.testing.assert_allclose(real_harmonics([0.6, 0.0, 0.8], 1), [1.0, 0.0, 0.8, 0.6])


def test_are_orthogonal_with_the_mean_squares_of_sn3d():
    harmonics = real_harmonics(even_directions(20_000), 3)
    products = harmonics.T @ harmonics / len(harmonics)
    np.testing.assert_allclose(products, np.diag(mean_squares(3)), atol=2e-4)


@pytest.mark.parametrize("order", [-1, 4])
def test_an_order_that_is_none_is_refused_with_the_range(order):
    with pytest.raises(ValueError, match=f"order: is {order}, must be 0 to 3"):
        real_harmonics([1.0, 0.0, 0.0], order)


@given(quaternions)
def test_rotation_gives_the_harmonics_of_turned_directions(orientation):
    directions = even_directions(50)
    turned = directions @ axes_of(orientation).T
    found = real_harmonics(directions, 3) @ rotation(orientation, 3).T
    np.testing.assert_allclose(found, real_harmonics(turned, 3), atol=1e-12)


@given(quaternions)
def test_rotation_keeps_the_energy_of_each_degree(orientation):
    matrix = rotation(orientation, 3)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(16), atol=1e-12)
    n = degrees(3)
    assert not matrix[n[:, None] != n].any()


def test_a_head_that_looks_north_hears_the_east_at_its_right():
    matrix = rotation(Quaternion.from_yaw(np.pi / 2), 1)
    np.testing.assert_allclose(matrix @ real_harmonics([1.0, 0.0, 0.0], 1), [1, -1, 0, 0], atol=1e-12)
