"""Compiled transforms, one per lane, against NumPy."""

from functools import cache

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.kernels.lane_fft import (
    butterfly,
    first_span,
    is_odd_power,
    order,
    store_turned,
    transform_but_last,
    transform_halved,
    transform_lanes,
    twiddles,
)
from server.kernels.simd import LANES, broadcast, lanes, load, store

ALL_POINTS = [1, 2, 4, 8, 16, 64, 128, 256, 512, 2048]
EACH = pytest.mark.parametrize("points", ALL_POINTS)


# Points of so many lanes, whose imaginary parts follow the real parts of all points, or those of each.
LAYOUTS = pytest.mark.parametrize(("lanes", "together"), [(8, False), (8, True), (16, False), (16, True)])


def lanes_of(points, lanes=LANES, seed=0):
    """Real and imaginary parts, and the complex numbers (point, lane) of which they are."""
    values = np.random.default_rng(seed + points).standard_normal((2, points, lanes), dtype=np.float32)
    return values, complex_of(values)


def done(transform, values, *, together):
    """Values transformed in a layout."""
    _, points, lanes = values.shape
    run = in_lanes(transform, lanes)
    passes = twiddles(points).ctypes.data
    if together:
        interleaved = np.ascontiguousarray(values.transpose(1, 0, 2))
        run(interleaved.ctypes.data, points, 2 * lanes, lanes, passes)
        return np.ascontiguousarray(interleaved.transpose(1, 0, 2))
    values = values.copy()
    run(values.ctypes.data, points, lanes, lanes * points, passes)
    return values


@cache
def in_lanes(transform, count):
    broadcast = lanes(count).broadcast

    @numba.njit
    def run(values, points, step, imaginary, passes):
        transform(broadcast(np.float32(0)), values, points, step, imaginary, passes)

    return run


def complex_of(values):
    return values[0].astype(np.float64) + 1j * values[1]


def put(values, numbers):
    values[0], values[1] = numbers.real, numbers.imag


def assert_transformed(values, numbers):
    """Whether the workspace holds the transforms of numbers, in its own order."""
    expected = np.fft.fft(numbers, axis=0)
    found = np.empty(expected.shape, np.complex128)
    found[order(len(expected))] = complex_of(values)
    assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())


@EACH
def test_is_odd_power_of_two(points):
    assert is_odd_power(points) == (int(np.log2(points)) % 2 == 1)


@EACH
def test_first_span_is_a_quarter_of_what_radix_4_is_left_with(points):
    assert first_span(points) == (points // 2 if np.log2(points) % 2 else points) // 4


@EACH
def test_order_has_every_frequency_once(points):
    assert sorted(order(points)) == list(range(points))


@EACH
@LAYOUTS
def test_transform_lanes_transforms_each_by_itself(points, lanes, together):
    values, numbers = lanes_of(points, lanes)
    assert_transformed(done(transform_lanes, values, together=together), numbers)


@EACH
def test_transform_lanes_keeps_silence_and_what_is_no_number_apart(points):
    values, numbers = lanes_of(points)
    values[:, :, 3], values[:, :, 5] = 0, np.nan
    values = done(transform_lanes, values, together=False)
    assert not values[:, :, 3].any()
    assert np.isnan(values[:, :, 5]).all()
    others = [0, 1, 2, 4, 6, 7]
    expected = np.fft.fft(numbers, axis=0)[order(points)][:, others]
    assert_allclose(complex_of(values)[:, others], expected, atol=2e-6 * np.abs(expected).max())


@EACH
@LAYOUTS
def test_transform_halved_does_what_is_left_after_the_pass_of_radix_2(points, lanes, together):
    values, numbers = lanes_of(points, lanes)
    if np.log2(points) % 2:
        first, second = np.split(numbers, 2)
        turn = np.exp(-2j * np.pi * np.arange(points // 2) / points)[:, None]
        put(values, np.concatenate([first + second, (first - second) * turn]))
    assert_transformed(done(transform_halved, values, together=together), numbers)


@pytest.mark.parametrize("points", [points for points in ALL_POINTS if points > 2])
@LAYOUTS
def test_transform_but_last_leaves_transforms_of_four_neighbours_to_do(points, lanes, together):
    values, numbers = lanes_of(points, lanes)
    values = done(transform_but_last, values, together=together)
    put(values, np.fft.fft(complex_of(values).reshape(-1, 4, lanes), axis=1).reshape(points, lanes))
    assert_transformed(values, numbers)


@pytest.mark.parametrize("step", [LANES, 3 * LANES, 5])
def test_butterfly_is_the_transform_of_four_points_any_step_apart(step):
    @numba.njit
    def run(values, size, at, step, out):
        y0r, y0i, y1r, y1i, y2r, y2i, y3r, y3i = butterfly(broadcast(np.float32(0)), values.ctypes.data, size, at, step)
        to = out.ctypes.data
        store(to, 0, y0r)
        store(to, 8, y0i)
        store(to, 16, y1r)
        store(to, 24, y1i)
        store(to, 32, y2r)
        store(to, 40, y2i)
        store(to, 48, y3r)
        store(to, 56, y3i)

    size, at = 200, 7
    values = np.random.default_rng(1).standard_normal((2, size), dtype=np.float32)
    out = np.empty((4, 2, LANES), np.float32)
    run(values, size, at, step, out)
    points = np.stack([complex_of(values)[at + k * step : at + k * step + LANES] for k in range(4)])
    assert_allclose(out[:, 0] + 1j * out[:, 1], np.fft.fft(points, axis=0), atol=1e-6)


def test_store_turned_multiplies_by_a_twiddle_and_touches_nothing_else():
    size, at, t = 64, 11, 2
    values = np.full((2, size), 7, np.float32)
    point = np.random.default_rng(2).standard_normal((2, LANES), dtype=np.float32)
    passes = np.array([9, 9, 0.6, -0.8, 9], np.float32)
    stored(values, size, at, point, passes, t)
    assert_allclose(complex_of(values)[at : at + LANES], complex_of(point) * (0.6 - 0.8j), rtol=1e-6)
    assert (np.delete(values, slice(at, at + LANES), axis=1) == 7).all()


@pytest.mark.parametrize("number", [np.inf, np.nan, 1e-45, 0.0])
def test_store_turned_by_one_is_what_it_was(number):
    values, point = np.empty((2, LANES), np.float32), np.zeros((2, LANES), np.float32)
    point[0] = number
    stored(values, LANES, 0, point, np.array([1, 0], np.float32), 0)
    assert_array_equal(values[0], point[0])


@numba.njit
def stored(values, size, at, point, passes, t):
    re, im = load(point.ctypes.data, 0), load(point.ctypes.data, LANES)
    store_turned(values.ctypes.data, size, at, re, im, passes.ctypes.data, t)
