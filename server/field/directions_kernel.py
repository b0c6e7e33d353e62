"""The spectrograms of two ears from powers by direction, in compiled code.

Axes: bands (7), bins, columns of frames, harmonics k; products as in `server.rendering.ear_products`.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.spherical_harmonics import harmonics_after_first
from server.kernels.compiled import compiled
from server.kernels.simd import (
    LANES,
    WIDE_LANES,
    add,
    at_least,
    broadcast,
    choose_below,
    divide,
    exponential,
    lanes,
    load,
    load_broadcast,
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
_PADDED = 2 * LANES
"""Numbers in a row of a rotation: at least as many as harmonics up to the third order."""
TURNED_SCRATCH = _PADDED
"""Numbers after the products that `turn_products` overwrites."""
_harmonics = compiled(harmonics_after_first)


class Turning(NamedTuple):
    """The products of a head that looks ahead, and what turns them. `level` (row, k) are rows of products of any kind.
    `directions` (direction, 3) and `inverse` (k, direction) are as in
    `server.acoustics.spherical_harmonics.sampled`."""

    level: Float32
    directions: Floats
    inverse: Floats


@compiled
def turn_products(turning: Turning, orientation: Floats, turned: Float32) -> None:
    """Write to `turned` the products (row * k,) of a head with this orientation, for harmonics in world axes. The next
    TURNED_SCRATCH numbers of `turned` are overwritten, too."""
    level = turning.level
    harmonics = level.shape[1]
    matrix = np.zeros((harmonics, _PADDED), np.float32)
    _rotate(turning, orientation, matrix)
    source, rows = matrix.ctypes.data, level.ctypes.data
    to = turned.ctypes.data
    # Rows are written one after the other, so that each overwrites what the one before it wrote too much.
    for row in range(level.shape[0]):
        first, rest = broadcast(np.float32(0.0)), broadcast(np.float32(0.0))
        for k in range(harmonics):
            factor = load_broadcast(rows, row * harmonics + k)
            first = multiply_add(factor, load(source, k * _PADDED), first)
            rest = multiply_add(factor, load(source, k * _PADDED + LANES), rest)
        store(to, row * harmonics, first)
        store(to, row * harmonics + LANES, rest)


@compiled
def _rotate(turning: Turning, orientation: Floats, matrix: Float32) -> None:
    """Write the matrix of `server.acoustics.spherical_harmonics.rotation`."""
    x, y, z, w = orientation
    harmonics = turning.inverse.shape[0]
    total = np.zeros((harmonics, harmonics))
    total[0, 0] = 1.0
    for number in range(turning.directions.shape[0]):
        east, north, up = turning.directions[number]
        turned = _harmonics(
            (1 - 2 * (y * y + z * z)) * east + 2 * (x * y + z * w) * north + 2 * (x * z - y * w) * up,
            2 * (x * y - z * w) * east + (1 - 2 * (x * x + z * z)) * north + 2 * (y * z + x * w) * up,
            2 * (x * z + y * w) * east + 2 * (y * z - x * w) * north + (1 - 2 * (x * x + y * y)) * up,
        )
        begin = 1
        while begin < harmonics:
            size = 2 * int(math.sqrt(begin)) + 1
            for row in range(begin, begin + size):
                for column in range(begin, begin + size):
                    total[row, column] += turned[row - 1] * turning.inverse[column, number]
            begin += size
    for row in range(harmonics):
        for column in range(harmonics):
            matrix[row, column] = total[row, column]


@compiled
def ears_of_directions(
    log_magnitude: Float32,
    directions: Float32,
    products: Float32,
    band: npt.NDArray[np.int64],
    share: Float32,
    log_floor: float,
    least: float,
    columns: int,
    work: Float32,
    levels: Float32,
    coherence: Float32,
) -> None:
    """Write the log magnitudes `levels` (ear, bin, column) and the `coherence` (real and imaginary, bin, column) of two
    ears.

    `log_magnitude` (band, column) and `directions` (k - 1, band, column) are a field's predictions, `products` (bin,
    product, k) those of the turned head. A bin lies between `band` (bin,) and the next, at this `share` (bin,) of the
    way. Where directions cancel, an ear's power is `least` times that of the same sound from all directions. Only the
    first `columns` are written and, where there is room, silence up to a whole vector. `work` is (k + 1, band, columns
    in whole vectors of WIDE_LANES).
    """
    harmonics = products.shape[2]
    floor, lowest = _wide_of(np.float32(log_floor)), _wide_of(np.float32(least))
    zero, one = _wide_of(np.float32(0.0)), _wide_of(np.float32(1.0))
    _find_powers(log_magnitude, directions, columns, floor, zero, work)
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
            shrunk = divide(one, square_root(at_least(square, one)))
            if column + WIDE_LANES <= levels.shape[2]:
                store(levels[0, bin_].ctypes.data, column, logarithm(add(left_size, floor)))
                store(levels[1, bin_].ctypes.data, column, logarithm(add(right_size, floor)))
                store(coherence[0, bin_].ctypes.data, column, multiply(real, shrunk))
                store(coherence[1, bin_].ctypes.data, column, multiply(imaginary, shrunk))
                continue
            store(rest, 0, logarithm(add(left_size, floor)))
            store(rest, row, logarithm(add(right_size, floor)))
            store(rest, 2 * row, multiply(real, shrunk))
            store(rest, 3 * row, multiply(imaginary, shrunk))
            for lane in range(columns - column):
                levels[0, bin_, column + lane] = work[harmonics, 0, lane]
                levels[1, bin_, column + lane] = work[harmonics, 1, lane]
                coherence[0, bin_, column + lane] = work[harmonics, 2, lane]
                coherence[1, bin_, column + lane] = work[harmonics, 3, lane]


@compiled
def _find_powers(log_magnitude, directions, columns, floor, zero, work) -> None:
    """Fill `work` (k, band, column) with the arriving powers of the first `columns` columns: first (k = 0) the power
    itself, then its product with each of the `directions`. The other columns of the last whole vector become zero."""
    whole = work.shape[2]
    for number in range(log_magnitude.shape[0]):
        power = work[0, number]
        for column in range(columns):
            power[column] = log_magnitude[number, column]
        for column in range(columns, whole):
            power[column] = _SILENT
        for column in range(0, whole, WIDE_LANES):
            magnitude = at_least(subtract(exponential(_load_wide(power.ctypes.data, column)), floor), zero)
            store(power.ctypes.data, column, multiply(magnitude, magnitude))
        for k in range(1, directions.shape[0] + 1):
            for column in range(columns):
                work[k, number, column] = power[column] * directions[k - 1, number, column]
            for column in range(columns, whole):
                work[k, number, column] = 0
