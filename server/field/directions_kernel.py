"""The spectrograms of two ears from powers by direction, in compiled code.

Axes: bands (7), bins, columns of frames, harmonics k; products as in `server.rendering.ear_products`.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.spherical_harmonics import harmonics_after_first
from server.kernels.compiled import compiled, compiled_loosely
from server.kernels.simd import (
    WIDE_LANES,
    add,
    any_above,
    at_least,
    choose_below,
    divide,
    exponential,
    lanes,
    logarithm,
    multiply,
    multiply_add,
    square_root,
    store,
    subtract,
)

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

_wide = lanes(WIDE_LANES)
_load_wide, _all_wide, _wide_of = _wide.load, _wide.load_broadcast, _wide.broadcast
_SILENT = np.float32(-80.0)
"""A log magnitude below every floor."""

PRODUCTS = 4
"""Products of two ears at each bin."""
_MOST_HARMONICS = 16
_harmonics = compiled(harmonics_after_first)


class Turning(NamedTuple):
    """The products of a head, and what turns sound to its axes. `level` (row, k) are rows of products of any kind.
    `directions` (direction, 3) and `inverse` (k, direction) are as in
    `server.acoustics.spherical_harmonics.sampled`."""

    level: Float32
    directions: Floats
    inverse: Floats


def turned_shape(harmonics: int, bands: int, columns: int) -> tuple[int, int, int]:
    """The shape of what `turn_arrivals` writes."""
    return 2 * harmonics, bands, -(-columns // WIDE_LANES) * WIDE_LANES


@compiled
def turn_arrivals(
    log_magnitude: Float32,
    directions: Float32,
    turning: Turning,
    orientation: Floats,
    log_floor: float,
    turned: Float32,
) -> None:
    """Write to the first k of `turned` (2 k, band, column in whole vectors of WIDE_LANES) what arrives at a head with
    this orientation, in its own axes: magnitudes, then the harmonics of their powers from the second on, relative to
    the first. Columns after those of the prediction become zero. The rest of `turned` is overwritten.

    `log_magnitude` (band, column) and `directions` (at least k - 1, band, column) are a field's predictions, in world
    axes. Turning them and not the products of the head is a fraction of the work: there are fewer of them.
    """
    harmonics, columns, whole = turning.inverse.shape[0], log_magnitude.shape[1], turned.shape[2]
    matrix = np.empty((harmonics, harmonics), np.float32)
    _rotate(turning, orientation, matrix)
    floor, zero = _wide_of(np.float32(log_floor)), _wide_of(np.float32(0.0))
    by_harmonic = 4 * whole * turned.shape[1]
    for band in range(log_magnitude.shape[0]):
        _copy_row(log_magnitude[band], columns, _SILENT, turned[harmonics, band])
        for k in range(1, harmonics):
            _copy_row(directions[k - 1, band], columns, np.float32(0.0), turned[harmonics + k, band])
        to, source = turned[0, band].ctypes.data, turned[harmonics, band].ctypes.data
        for column in range(0, whole, WIDE_LANES):
            magnitude = subtract(exponential(_load_wide(source, column)), floor)
            store(to, column, at_least(magnitude, zero))
            begin, size = 1, 3
            while begin < harmonics:
                for row in range(begin, begin + size):
                    total, of_row = zero, matrix[row].ctypes.data
                    for k in range(begin, begin + size):
                        total = multiply_add(_all_wide(of_row, k), _load_wide(source + k * by_harmonic, column), total)
                    store(to + row * by_harmonic, column, total)
                begin, size = begin + size, size + 2


@compiled
def _copy_row(values: Float32, columns: int, after: np.float32, row: Float32) -> None:
    """Copy a row of columns, with the number `after` in those up to the next whole vector."""
    for column in range(columns):
        row[column] = values[column]
    for column in range(columns, row.size):
        row[column] = after


@compiled
def _rotate(turning: Turning, orientation: Floats, matrix: Float32) -> None:
    """Write the parts of the matrix of `server.acoustics.spherical_harmonics.rotation` by which harmonics of one degree
    turn into each other."""
    x, y, z, w = orientation
    harmonics, count = turning.inverse.shape
    turned = np.empty((_MOST_HARMONICS - 1, count))
    for number in range(count):
        east, north, up = turning.directions[number]
        of_direction = _harmonics(
            (1 - 2 * (y * y + z * z)) * east + 2 * (x * y + z * w) * north + 2 * (x * z - y * w) * up,
            2 * (x * y - z * w) * east + (1 - 2 * (x * x + z * z)) * north + 2 * (y * z + x * w) * up,
            2 * (x * z + y * w) * east + 2 * (y * z - x * w) * north + (1 - 2 * (x * x + y * y)) * up,
        )
        for k in range(harmonics - 1):
            turned[k, number] = of_direction[k]
    begin, size = 1, 3
    while begin < harmonics:
        for row in range(begin, begin + size):
            for column in range(begin, begin + size):
                matrix[row, column] = _product(turned[row - 1], turning.inverse[column])
        begin, size = begin + size, size + 2


@compiled_loosely
def _product(one: Floats, other: Floats) -> float:
    total = 0.0
    for n in range(one.size):
        total += one[n] * other[n]
    return total


@compiled
def ears_of_directions(
    turned: Float32,
    products: Float32,
    band: npt.NDArray[np.int64],
    share: Float32,
    log_floor: float,
    least: float,
    columns: int,
    margin: int,
    work: Float32,
    levels: Float32,
    coherence: Float32,
) -> None:
    """Write the log magnitudes `levels` (ear, bin, column) and the `coherence` (real and imaginary, bin, column) of two
    ears.

    `turned` is what arrives, as `turn_arrivals` writes it, and `products` (bin, product, k) are those of the head. A
    bin lies between `band` (bin,) and the next, at this `share` (bin,) of the way. Where directions cancel, an ear's
    power is `least` times that of the same sound from all directions. Only the first `columns` are written and, where
    there is room, silence up to a whole vector. With a `margin` from 0 on, `levels` are magnitudes and no logarithms,
    and columns begin after so many others. `work` is (k + 1, band, columns in whole vectors of WIDE_LANES).
    """
    harmonics = products.shape[2]
    floor, lowest = _wide_of(np.float32(log_floor)), _wide_of(np.float32(least))
    zero, one = _wide_of(np.float32(0.0)), _wide_of(np.float32(1.0))
    _find_powers(turned, columns, work)
    row, rest = work.shape[2], work[harmonics].ctypes.data
    by_band, by_harmonic = 4 * row, 4 * row * work.shape[1]
    for bin_ in range(products.shape[0]):
        upper = _wide_of(share[bin_])
        lower = subtract(one, upper)
        of_bin = products[bin_].ctypes.data
        for column in range(0, columns, WIDE_LANES):
            at = work.ctypes.data + band[bin_] * by_band
            power = multiply_add(upper, _load_wide(at + by_band, column), multiply(lower, _load_wide(at, column)))
            left, right = multiply(_all_wide(of_bin, 0), power), multiply(_all_wide(of_bin, harmonics), power)
            real = multiply(_all_wide(of_bin, 2 * harmonics), power)
            imaginary = multiply(_all_wide(of_bin, 3 * harmonics), power)
            least_left, least_right = multiply(lowest, left), multiply(lowest, right)
            for k in range(1, harmonics):
                at += by_harmonic
                power = multiply_add(upper, _load_wide(at + by_band, column), multiply(lower, _load_wide(at, column)))
                left = multiply_add(_all_wide(of_bin, k), power, left)
                right = multiply_add(_all_wide(of_bin, harmonics + k), power, right)
                real = multiply_add(_all_wide(of_bin, 2 * harmonics + k), power, real)
                imaginary = multiply_add(_all_wide(of_bin, 3 * harmonics + k), power, imaginary)
            # guard: where directions cancel, sound is left over
            left_power = at_least(left, least_left)
            left_size, right_size = square_root(left_power), square_root(at_least(right, least_right))
            both = multiply(left_size, right_size)
            # guard: silent ears have no coherence
            scale = choose_below(zero, both, divide(one, both), zero)
            real, imaginary = multiply(real, scale), multiply(imaginary, scale)
            square = multiply_add(real, real, multiply(imaginary, imaginary))
            # guard: coherence from directions is at most one
            if any_above(square, one):  # rarely true
                shrunk = divide(one, square_root(at_least(square, one)))
                real, imaginary = multiply(real, shrunk), multiply(imaginary, shrunk)
            if margin >= 0:
                store(levels[0, bin_].ctypes.data, margin + column, left_size)
                store(levels[1, bin_].ctypes.data, margin + column, right_size)
                store(coherence[0, bin_].ctypes.data, margin + column, real)
                store(coherence[1, bin_].ctypes.data, margin + column, imaginary)
                continue
            if column + WIDE_LANES <= levels.shape[2]:
                store(levels[0, bin_].ctypes.data, column, logarithm(add(left_size, floor)))
                store(levels[1, bin_].ctypes.data, column, logarithm(add(right_size, floor)))
                store(coherence[0, bin_].ctypes.data, column, real)
                store(coherence[1, bin_].ctypes.data, column, imaginary)
                continue
            store(rest, 0, logarithm(add(left_size, floor)))
            store(rest, row, logarithm(add(right_size, floor)))
            store(rest, 2 * row, real)
            store(rest, 3 * row, imaginary)
            for lane in range(columns - column):
                levels[0, bin_, column + lane] = work[harmonics, 0, lane]
                levels[1, bin_, column + lane] = work[harmonics, 1, lane]
                coherence[0, bin_, column + lane] = work[harmonics, 2, lane]
                coherence[1, bin_, column + lane] = work[harmonics, 3, lane]


@compiled
def _find_powers(turned, columns, work) -> None:
    """Fill `work` (k, band, column) with the arriving powers of the first `columns` columns: first (k = 0) the power
    itself, then its product with each harmonic. The other columns of the last whole vector become zero."""
    by_harmonic, of_work = 4 * turned.shape[1] * turned.shape[2], 4 * work.shape[1] * work.shape[2]
    for number in range(work.shape[1]):
        for column in range(columns):
            work[0, number, column] = turned[0, number, column] * turned[0, number, column]
        for column in range(columns, work.shape[2]):
            work[0, number, column] = 0
    for number in range(work.shape[1]):
        source, to = turned[0, number].ctypes.data, work[0, number].ctypes.data
        for column in range(0, work.shape[2], WIDE_LANES):
            power = _load_wide(to, column)
            for k in range(1, work.shape[0] - 1):
                store(to + k * of_work, column, multiply(power, _load_wide(source + k * by_harmonic, column)))
