"""Ambisonic channels from frozen noises in octave bands, in compiled code.

The first channel is a noise of its own, times the magnitude that arrives. Every other channel has a share of that noise
and of noises of its own. Axes: B poses; bands (7), columns of a prediction, k channels and as many noises; responses
(B, k, sample).
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.decoding_kernel import silence
from server.field.band_tail_kernel import balance
from server.kernels.compiled import compiled
from server.kernels.simd import (
    LANES,
    WIDE_LANES,
    add,
    at_least,
    broadcast,
    choose_below,
    divide,
    lanes,
    load,
    multiply,
    multiply_add,
    multiply_subtract,
    square_root,
    store,
    subtract,
)

Float32 = npt.NDArray[np.float32]
Int16 = npt.NDArray[np.int16]
Floats = npt.NDArray[np.float64]

_wide = lanes(WIDE_LANES)
_load_wide, _load_shorts, _all_wide, _wide_of = _wide.load, _wide.load_shorts, _wide.load_broadcast, _wide.broadcast
_SWEEPS = 5
_TINY = np.float32(1e-20)
_GROUP = 4
"""Channels whose sums are in registers at once. Responses have 1, 4, 9 or 16, so their last group has one or all."""
_RAMP = np.arange(WIDE_LANES, dtype=np.float32)
_ROOT_THIRD = np.float32(1 / math.sqrt(3.0))


@compiled
def find_first_order(directions: Float32, moments: Float32, mixing: Float32) -> None:
    """Write the `mixing` (4, 4, band, column) of the channels W, Y, Z and X from four noises, for unit power.

    `directions` (k - 1, band, column) are harmonics of the arriving power. Those of the second order give the
    covariance of Y, Z and X. Where they are not known, it is that of the smoothest sound of these first ones
    (Levermore, J. Quant. Spectrosc. Radiat. Transf. 31, 149, 1984). What W does not share with them is the symmetric
    root of the rest of the covariance, without its negative part: a root that is continuous and turns with the sound.
    `moments` (9, columns in whole vectors) is a buffer.
    """
    known, bands, columns = directions.shape
    for band in range(bands):
        for k in range(min(known, 8)):
            for column in range(moments.shape[1]):
                moments[k, column] = directions[k, band, column] if column < columns else np.float32(0.0)
        for k in range(known, 8):
            for column in range(moments.shape[1]):
                moments[k, column] = 0
        if known < 8:
            _smoothest(moments)
        for column in range(0, columns, LANES):
            _find_root(moments, column)
            for lane in range(min(LANES, columns - column)):
                _store_root(moments, column + lane, mixing, band)


@compiled
def _smoothest(moments) -> None:
    """Write the second-order harmonics, rows 3 to 7, of the smoothest sound that has the first-order harmonics of
    rows 0 to 2 (y, z, x)."""
    for column in range(moments.shape[1]):
        y, z, x = moments[0, column], moments[1, column], moments[2, column]
        square = min(np.float32(1.0), x * x + y * y + z * z)
        ahead = (3 + 4 * square) / (5 + 2 * math.sqrt(4 - 3 * square))
        # guard: sound from all sides comes from none
        scale = (3 * ahead - 1) / 2 / max(square, 1e-12)
        root = math.sqrt(3.0)
        moments[3, column] = scale * root * x * y
        moments[4, column] = scale * root * y * z
        moments[5, column] = scale * 0.5 * (2 * z * z - x * x - y * y)
        moments[6, column] = scale * root * x * z
        moments[7, column] = scale * 0.5 * root * (x * x - y * y)


@compiled
def _find_root(moments, column) -> None:
    """Replace eight columns of the moments. Rows 0 to 2 become the shares of W's noise in Y, Z and X. Rows 3 to 8
    become the elements yy, yz, yx, zz, zx and xx of the symmetric root that mixes the noises of these three
    channels."""
    at, row = moments.ctypes.data, moments.shape[1]
    zero, one, half = broadcast(np.float32(0.0)), broadcast(np.float32(1.0)), broadcast(np.float32(0.5))
    tiny, third = broadcast(_TINY), broadcast(_ROOT_THIRD)
    y, z, x = load(at, column), load(at, row + column), load(at, 2 * row + column)
    square = multiply_add(x, x, multiply_add(y, y, multiply(z, z)))
    # guard: no channel has more of a wave than there is
    shrunk = divide(one, square_root(at_least(square, one)))
    y, z, x = multiply(y, shrunk), multiply(z, shrunk), multiply(x, shrunk)
    xy, yz = multiply(third, load(at, 3 * row + column)), multiply(third, load(at, 4 * row + column))
    xz, apart = multiply(third, load(at, 6 * row + column)), multiply(third, load(at, 7 * row + column))
    zz = multiply(
        broadcast(np.float32(1 / 3)), multiply_add(broadcast(np.float32(2.0)), load(at, 5 * row + column), one)
    )
    level = multiply(half, subtract(one, zz))
    # The rest, after W's share; 0, 1 and 2 are y, z and x.
    a00 = multiply_subtract(y, y, subtract(level, apart))
    a11 = multiply_subtract(z, z, zz)
    a22 = multiply_subtract(x, x, add(level, apart))
    a01, a02, a12 = multiply_subtract(y, z, yz), multiply_subtract(x, y, xy), multiply_subtract(x, z, xz)
    left_over = at_least(add(a00, add(a11, a22)), zero)
    u0, u1, u2 = one, zero, zero
    v0, v1, v2 = zero, one, zero
    w0, w1, w2 = zero, zero, one
    for _ in range(_SWEEPS):  # of Jacobi's method
        t, c, s = _angle(a00, a11, a01)
        a00, a11, a01 = multiply_subtract(t, a01, a00), multiply_add(t, a01, a11), zero
        a02, a12 = multiply_subtract(s, a12, multiply(c, a02)), multiply_add(s, a02, multiply(c, a12))
        u0, v0 = multiply_subtract(s, v0, multiply(c, u0)), multiply_add(s, u0, multiply(c, v0))
        u1, v1 = multiply_subtract(s, v1, multiply(c, u1)), multiply_add(s, u1, multiply(c, v1))
        u2, v2 = multiply_subtract(s, v2, multiply(c, u2)), multiply_add(s, u2, multiply(c, v2))
        t, c, s = _angle(a00, a22, a02)
        a00, a22, a02 = multiply_subtract(t, a02, a00), multiply_add(t, a02, a22), zero
        a01, a12 = multiply_subtract(s, a12, multiply(c, a01)), multiply_add(s, a01, multiply(c, a12))
        u0, w0 = multiply_subtract(s, w0, multiply(c, u0)), multiply_add(s, u0, multiply(c, w0))
        u1, w1 = multiply_subtract(s, w1, multiply(c, u1)), multiply_add(s, u1, multiply(c, w1))
        u2, w2 = multiply_subtract(s, w2, multiply(c, u2)), multiply_add(s, u2, multiply(c, w2))
        t, c, s = _angle(a11, a22, a12)
        a11, a22, a12 = multiply_subtract(t, a12, a11), multiply_add(t, a12, a22), zero
        a01, a02 = multiply_subtract(s, a02, multiply(c, a01)), multiply_add(s, a01, multiply(c, a02))
        v0, w0 = multiply_subtract(s, w0, multiply(c, v0)), multiply_add(s, v0, multiply(c, w0))
        v1, w1 = multiply_subtract(s, w1, multiply(c, v1)), multiply_add(s, v1, multiply(c, w1))
        v2, w2 = multiply_subtract(s, w2, multiply(c, v2)), multiply_add(s, v2, multiply(c, w2))
    # guard: no power is negative
    a00, a11, a22 = at_least(a00, zero), at_least(a11, zero), at_least(a22, zero)
    positive = add(a00, add(a11, a22))
    # guard: where W has all, nothing is left over
    scale = choose_below(tiny, positive, divide(left_over, positive), zero)
    p, q, r = square_root(multiply(a00, scale)), square_root(multiply(a11, scale)), square_root(multiply(a22, scale))
    store(at, column, y)
    store(at, row + column, z)
    store(at, 2 * row + column, x)
    pu0, qv0, rw0 = multiply(p, u0), multiply(q, v0), multiply(r, w0)
    pu1, qv1, rw1 = multiply(p, u1), multiply(q, v1), multiply(r, w1)
    pu2, qv2, rw2 = multiply(p, u2), multiply(q, v2), multiply(r, w2)
    store(at, 3 * row + column, multiply_add(pu0, u0, multiply_add(qv0, v0, multiply(rw0, w0))))
    store(at, 4 * row + column, multiply_add(pu0, u1, multiply_add(qv0, v1, multiply(rw0, w1))))
    store(at, 5 * row + column, multiply_add(pu0, u2, multiply_add(qv0, v2, multiply(rw0, w2))))
    store(at, 6 * row + column, multiply_add(pu1, u1, multiply_add(qv1, v1, multiply(rw1, w1))))
    store(at, 7 * row + column, multiply_add(pu1, u2, multiply_add(qv1, v2, multiply(rw1, w2))))
    store(at, 8 * row + column, multiply_add(pu2, u2, multiply_add(qv2, v2, multiply(rw2, w2))))


@compiled
def _angle(one, other, between):
    """The tangent, cosine and sine of one rotation in Jacobi's method for the eigenvalues of a symmetric matrix.

    The rotation turns two axes so that the element `between` them becomes zero; `one` and `other` are their elements on
    the diagonal. Of the two angles that do so, it is the smaller, at most 45 degrees.
    """
    zero, unit = broadcast(np.float32(0.0)), broadcast(np.float32(1.0))
    apart, twice = subtract(other, one), add(between, between)
    size = at_least(apart, subtract(zero, apart))
    length = add(size, square_root(multiply_add(apart, apart, multiply(twice, twice))))
    tangent = divide(choose_below(apart, zero, subtract(zero, twice), twice), at_least(length, broadcast(_TINY)))
    cosine = divide(unit, square_root(multiply_add(tangent, tangent, unit)))
    return tangent, cosine, multiply(tangent, cosine)


@compiled
def _store_root(moments, column, mixing, band) -> None:
    mixing[0, 0, band, column] = 1
    number = 3
    for i in range(3):
        mixing[0, i + 1, band, column] = 0
        mixing[i + 1, 0, band, column] = moments[i, column]
        for j in range(i, 3):
            mixing[i + 1, j + 1, band, column] = moments[number, column]
            mixing[j + 1, i + 1, band, column] = moments[number, column]
            number += 1


@compiled
def mix_bands(
    log_magnitude: Float32,
    mixing: Float32,
    log_floor: float,
    places: Floats,
    noises: Int16,
    steps: Float32,
    begin: int,
    response: Float32,
) -> None:
    """Write a response (k, sample).

    `log_magnitude` (band, column) is what an ideal omnidirectional microphone hears, and `mixing` (k, noise, band,
    column) makes channels of unit power from the `noises` (noise, band, sample), whose units are `steps` (noise, band).
    Gains hold at the samples `places` (column,), and are interpolated between them. Before the first place, they rise
    from zero at sample `begin`, as the level does in a first frame, whose window overlaps with none before it.
    """
    gains = _gains_of(log_magnitude, mixing, log_floor, steps)
    silent, lines = np.zeros_like(gains[0]), np.empty((*gains.shape[1:3], 2 * _GROUP), np.float32)
    last, size = gains.shape[0] - 1, response.shape[1]
    end = min(size, noises.shape[2])
    at, column = max(0, begin), -1
    silence(response, 0, min(at, size))
    while at < end:
        while column < last and places[column + 1] <= at:
            column += 1
        stop = end if column == last else min(end, math.ceil(places[column + 1]))
        low, high = max(column, 0), min(column + 1, last)
        since = places[low] if column >= 0 else begin
        apart = places[high] - since
        share = (at - since) / apart if apart > 0 else 0.0
        step = 1.0 / apart if apart > 0 else 0.0
        _find_lines(gains[low] if column >= 0 else silent, gains[high], np.float32(share), np.float32(step), lines)
        for group in range(lines.shape[0]):
            _write_group(lines[group], noises, at, stop, response[_GROUP * group :])
        at = stop
    silence(response, max(at, end), size)


@compiled
def _gains_of(log_magnitude, mixing, log_floor, steps):
    """(column, group, band and noise, _GROUP) the gains of the noises in groups of channels; zeros for channels that a
    group lacks."""
    channels, bands, columns = mixing.shape[0], log_magnitude.shape[0], log_magnitude.shape[1]
    gains = np.zeros((columns, (channels + _GROUP - 1) // _GROUP, bands * channels, _GROUP), np.float32)
    magnitudes = np.zeros((bands, (columns + WIDE_LANES - 1) // WIDE_LANES * WIDE_LANES), np.float32)
    for band in range(bands):
        for column in range(columns):
            magnitude = np.exp(log_magnitude[band, column]) - np.float32(log_floor)
            magnitudes[band, column] = max(magnitude, np.float32(0.0))
    for column in range(0, columns, WIDE_LANES):
        balance(magnitudes, column)
    for column in range(columns):
        for band in range(bands):
            for i in range(channels):
                for j in range(channels):
                    of_noise = magnitudes[band, column] * steps[j, band] * mixing[i, j, band, column]
                    gains[column, i // _GROUP, band * channels + j, i % _GROUP] = of_noise
    return gains


@compiled
def _find_lines(before, after, share, step, lines) -> None:
    """Write how gains (group, band and noise, _GROUP) go from one place to the next: their values a `share` of the way
    on, then their slopes per sample."""
    for group in range(lines.shape[0]):
        for number in range(lines.shape[1]):
            for i in range(_GROUP):
                rise = after[group, number, i] - before[group, number, i]
                lines[group, number, i] = before[group, number, i] + rise * share
                lines[group, number, _GROUP + i] = rise * step


@compiled
def _write_group(lines, noises, at, stop, response) -> None:
    """Write samples `at` to `stop` of the first channels of a response, at most _GROUP, from the noises along `lines`
    (band and noise, 2 _GROUP). Sums over bands and noises stay in registers."""
    channels, bands = noises.shape[0], noises.shape[1]
    by_noise, by_band = noises.strides[0], noises.strides[1]
    source, to, row = noises.ctypes.data + 2 * at, response.ctypes.data + 4 * at, response.strides[0] // 4
    values, ramp, nothing = lines.ctypes.data, _load_wide(_RAMP.ctypes.data, 0), _wide_of(np.float32(0.0))
    count, written = stop - at, min(_GROUP, response.shape[0])
    vectors = count // WIDE_LANES * WIDE_LANES
    for n in range(0, vectors, WIDE_LANES):
        x = add(ramp, _wide_of(np.float32(n)))
        first, second, third, fourth = nothing, nothing, nothing, nothing
        line = 0
        for band in range(bands):
            for j in range(channels):
                noise = _load_shorts(source + j * by_noise + band * by_band, n)
                first = multiply_add(_on(values, line, x), noise, first)
                second = multiply_add(_on(values, line + 1, x), noise, second)
                third = multiply_add(_on(values, line + 2, x), noise, third)
                fourth = multiply_add(_on(values, line + 3, x), noise, fourth)
                line += 2 * _GROUP
        store(to, n, first)
        if written == _GROUP:
            store(to, row + n, second)
            store(to, 2 * row + n, third)
            store(to, 3 * row + n, fourth)
    for n in range(vectors, count):
        for i in range(written):
            total = np.float32(0.0)
            for band in range(bands):
                for j in range(channels):
                    line = lines[band * channels + j]
                    total += (line[i] + line[_GROUP + i] * np.float32(n)) * np.float32(noises[j, band, at + n])
            response[i, at + n] = total


@compiled
def _on(lines, at, x):
    """The gain at samples x of the line at `at`."""
    return multiply_add(x, _all_wide(lines, at + _GROUP), _all_wide(lines, at))
