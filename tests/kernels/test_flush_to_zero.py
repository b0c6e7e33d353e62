"""Denormal numbers are zeros within the mode, on both ways, and nowhere else."""

import platform
import threading

import numba
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.kernels.flush_to_zero import flush_to_zero, restore

SMALL, NORMAL = np.float32(1e-40), np.float32(2.0**-126)
FACTORS = np.array([SMALL, NORMAL, 1e-30, -1e-30, 1.0, np.inf, np.nan, -2.0], np.float32)
OTHERS = np.array([1e10, 0.5, 1e-9, 1e-9, SMALL, 2.0, 1.0, 3.0], np.float32)
EXACT = FACTORS * OTHERS
FLUSHED = np.where(np.abs(np.where(np.isnan(EXACT), 1, EXACT)) < NORMAL, 0, EXACT)
FLUSHED[0] = 0  # its factor is taken for zero, whatever the product

knows_the_processor = pytest.mark.skipif(
    platform.machine().lower() not in {"x86_64", "amd64", "aarch64", "arm64"}, reason="nothing changes here"
)


@numba.njit
def products(a, b, out):
    for n in range(a.size):
        out[n] = a[n] * b[n]


@numba.njit
def within(a, b, out, after):
    mode = flush_to_zero()
    products(a, b, out)
    restore(mode)
    products(b, a, after)


@numba.njit
def nested(a, b, out, after):
    outer = flush_to_zero()
    inner = flush_to_zero()
    restore(inner)
    products(a, b, out)
    restore(outer)
    products(b, a, after)


def found_by(function):
    out, after = np.full((2, FACTORS.size), 7, np.float32)
    function(FACTORS, OTHERS, out, after)
    return out, after


@knows_the_processor
def test_flush_to_zero_makes_zeros_of_denormal_factors_and_products():
    out, _ = found_by(within)
    assert_array_equal(out, FLUSHED)
    assert np.count_nonzero(EXACT) - np.count_nonzero(out) == 5


def test_restore_leaves_the_mode_as_it_was():
    _, after = found_by(within)
    assert_array_equal(after, EXACT)
    assert_array_equal(FACTORS * OTHERS, EXACT)


@knows_the_processor
def test_restore_goes_back_to_the_mode_that_was_and_not_out_of_all():
    out, after = found_by(nested)
    assert_array_equal(out, FLUSHED)
    assert_array_equal(after, EXACT)


def test_flush_to_zero_is_of_one_thread():
    """While another is within, this one is not."""
    entered, leave = threading.Event(), threading.Event()

    @numba.njit(nogil=True)
    def enter():
        return flush_to_zero()

    @numba.njit(nogil=True)
    def go(mode):
        restore(mode)

    def other():
        mode = enter()
        entered.set()
        leave.wait()
        go(mode)

    thread = threading.Thread(target=other)
    thread.start()
    entered.wait()
    out, after = np.empty((2, FACTORS.size), np.float32)
    products(FACTORS, OTHERS, out)
    leave.set()
    thread.join()
    assert_array_equal(out, EXACT)
    del after
