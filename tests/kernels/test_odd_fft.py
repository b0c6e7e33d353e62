"""The compiled transform against NumPy's, and what convolution asks of it."""

import numpy as np
import pytest

from server.kernels import odd_fft
from tests.signals import noise

SIZES = [64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384]


def address(array):
    return array.ctypes.data


def transform(window):
    size = window.size // 2
    tables = odd_fft.tables(size)
    bins = np.zeros((2, size), np.float32)
    odd_fft.forward(
        address(window),
        address(window) + 4 * size,
        address(bins),
        address(bins),
        8,
        size,
        size,
        address(tables.twist),
        address(tables.passes),
        address(tables.lanes),
    )
    return bins


def second_half(bins):
    size = bins.shape[1]
    tables = odd_fft.tables(size)
    out = np.zeros(size, np.float32)
    odd_fft.inverse(
        address(bins),
        8,
        size,
        address(bins),
        address(out),
        size,
        address(tables.twist),
        address(tables.passes),
        address(tables.lanes),
    )
    return out


@pytest.mark.parametrize("size", SIZES)
def test_forward_evaluates_the_polynomial_at_the_roots_of_minus_i(size):
    """In some order: each expected value has a bin near it, and energies agree."""
    window = noise(1, 2 * size)
    roots = np.exp(-1j * np.pi * (0.5 + 2 * np.arange(size)) / size)
    folded = window[:size] - 1j * window[size:]
    expected = np.fft.fft(folded * np.exp(-0.5j * np.pi * np.arange(size) / size))
    np.testing.assert_allclose(expected[:3], [np.polyval(window[::-1], root) for root in roots[:3]], rtol=1e-6)
    bins = transform(window)
    found = bins[0] + 1j * bins[1]
    scale = np.sqrt(size)
    order = np.lexsort((np.round(expected.imag / scale, 2), np.round(expected.real / scale, 2)))
    assert np.abs(np.sort(np.abs(found)) - np.sort(np.abs(expected))).max() / scale < 1e-5
    nearest = np.array([np.abs(found - value).min() for value in expected[order][:: max(1, size // 64)]])
    assert nearest.max() / scale < 1e-5


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("step", [32, 80])
def test_forward_pair_transforms_two_windows_that_end_in_silence_to_the_bit(size, step):
    tables = odd_fft.tables(size)
    windows = np.stack([noise(5, 2 * size), noise(6, 2 * size)])
    windows[:, size:] = 0
    out, room = np.full(size // 8 * step, 7, np.float32), np.empty(4 * size, np.float32)
    odd_fft.forward_pair(
        address(windows[0]),
        address(windows[1]),
        address(room),
        address(out),
        step,
        size,
        address(tables.twist),
        address(tables.passes),
        address(tables.lanes),
    )
    rows = out.reshape(-1, step)
    found = rows[:, :32].reshape(-1, 2, 2, 8).transpose(1, 2, 0, 3).reshape(2, 2, size)
    for window, bins in zip(windows, found, strict=True):
        np.testing.assert_array_equal(bins, transform(window))
    assert (rows[:, 32:] == 7).all()


@pytest.mark.parametrize("size", SIZES)
def test_inverse_brings_back_the_second_half(size):
    window = noise(2, 2 * size)
    np.testing.assert_allclose(second_half(transform(window)), window[size:], atol=3e-6)


@pytest.mark.parametrize("size", SIZES)
def test_products_of_bins_convolve_what_overlap_save_keeps(size):
    window, filter_taps = noise(3, 2 * size), noise(4, size)
    a, b = transform(window), transform(np.concatenate([filter_taps, np.zeros(size, np.float32)]))
    product = (a[0] + 1j * a[1]) * (b[0] + 1j * b[1])
    expected = np.convolve(window.astype(float), filter_taps.astype(float))[size : 2 * size]
    wet = second_half(np.ascontiguousarray(np.stack([product.real, product.imag]).astype(np.float32)))
    assert np.abs(wet - expected).max() / np.abs(expected).max() < 2e-6


def test_forward_keeps_silence_exactly():
    assert not transform(np.zeros(512, np.float32)).any()


@pytest.mark.parametrize("size", [0, 32, 96, 100])
def test_sizes_it_cannot_have_are_refused(size):
    with pytest.raises(ValueError, match="power of two"):
        odd_fft.tables(size)
