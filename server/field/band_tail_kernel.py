"""The late tail of a response as band noises with changing gains, in compiled code.

Axes: bands (7), columns of a prediction, harmonics k; noises (band, left or right, sample); responses (ear, sample).
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.decoding_kernel import silence
from server.kernels.compiled import compiled
from server.kernels.simd import (
    WIDE_LANES,
    add,
    at_least,
    choose_below,
    divide,
    lanes,
    multiply,
    multiply_add,
    multiply_subtract,
    square_root,
    store,
)

Float32 = npt.NDArray[np.float32]
Int16 = npt.NDArray[np.int16]

MOST_IN_A_BAND = 0.999
"""The greatest coherence of the ears in a band."""
_ALMOST = np.float32(MOST_IN_A_BAND)
_LINES = 6
"""Numbers that describe the gains of a band between two columns."""
_RAMP = np.arange(WIDE_LANES, dtype=np.float32)
_wide = lanes(WIDE_LANES)
load, load_shorts, load_broadcast, broadcast = _wide.load, _wide.load_shorts, _wide.load_broadcast, _wide.broadcast


@compiled
def find_band_gains(
    turned: Float32,
    products: Float32,
    diffuse: Float32,
    steps: Float32,
    first: int,
    least: float,
    gains: Float32,
) -> None:
    """Write the `gains` (3, band, column) of a prediction's columns, from the vector with column `first` on: of the
    left noise at the left ear, of the left noise at the right ear, and of the right noise there.

    `turned` is what arrives, as `server.field.directions_kernel.turn_arrivals` writes it, and `products` (band,
    product, k) are those of the head, averaged over each band. `diffuse` (band, 3) are the band's powers at both ears,
    and the coherence between them, in diffuse sound of unit power, which is what the noises are. Gains are in units of
    `steps` (band, left or right), the units of the noises. Where directions cancel, an ear's power is `least` times
    that of diffuse sound.
    """
    bands, harmonics = products.shape[0], products.shape[2]
    by_harmonic, by_part = 4 * turned.shape[1] * turned.shape[2], 4 * gains.shape[1] * gains.shape[2]
    one, most, opposite = broadcast(np.float32(1.0)), broadcast(_ALMOST), broadcast(-_ALMOST)
    for column in range(first // WIDE_LANES * WIDE_LANES, gains.shape[2], WIDE_LANES):
        for band in range(bands):
            source, of_band = turned[0, band].ctypes.data, products[band].ctypes.data
            to = gains[0, band].ctypes.data
            left, right = load_broadcast(of_band, 0), load_broadcast(of_band, harmonics)
            real = load_broadcast(of_band, 2 * harmonics)
            for k in range(1, harmonics):
                of_k = load(source + k * by_harmonic, column)
                left = multiply_add(load_broadcast(of_band, k), of_k, left)
                right = multiply_add(load_broadcast(of_band, harmonics + k), of_k, right)
                real = multiply_add(load_broadcast(of_band, 2 * harmonics + k), of_k, real)
            # guard: where directions cancel, a band is left over
            left = at_least(left, broadcast(np.float32(least) * diffuse[band, 0]))
            right = at_least(right, broadcast(np.float32(least) * diffuse[band, 1]))
            magnitude = load(source, column)
            at_left = square_root(divide(left, broadcast(diffuse[band, 0])))
            at_right = square_root(divide(right, broadcast(diffuse[band, 1])))
            coherence = at_least(divide(real, square_root(multiply(left, right))), opposite)
            store(to, column, multiply(magnitude, at_left))
            store(to + by_part, column, multiply(magnitude, at_right))
            store(to + 2 * by_part, column, choose_below(coherence, most, coherence, most))
        balance(gains[0], column)
        balance(gains[1], column)
        for band in range(bands):
            to = gains[0, band].ctypes.data
            at_left, at_right = load(to, column), load(to + by_part, column)
            coherence = load(to + 2 * by_part, column)
            # Noises of coherence d with gains b and a have the coherence b + a d and the power a^2 + b^2 + 2 a b d.
            of_diffuse = diffuse[band, 2]
            left_out = broadcast(np.float32(1.0) - of_diffuse * of_diffuse)
            own = square_root(divide(multiply_subtract(coherence, coherence, one), left_out))
            other = multiply(at_right, multiply_subtract(own, broadcast(of_diffuse), coherence))
            store(to, column, multiply(at_left, broadcast(steps[band, 0])))
            store(to + by_part, column, multiply(other, broadcast(steps[band, 0])))
            store(to + 2 * by_part, column, multiply(multiply(at_right, own), broadcast(steps[band, 1])))


@compiled
def balance(gains: Float32, column: int) -> None:
    """Multiply `gains` (band, column), WIDE_LANES of them from `column` on, by the factors by which the power of each
    band is right.

    Neighbouring bands overlap and are parts of one noise, so their amplitudes add up, and not their powers. Over the
    octave between two bands with gains g and h, the mean power is (g^2 + g h + h^2) / 3 where it should be
    (g^2 + h^2) / 2. The squared factor is the mean, over the octaves on both sides, of the second over the first.
    """
    bands, half = gains.shape[0], broadcast(np.float32(0.5))
    before = load(gains[0].ctypes.data, column)
    for band in range(bands):
        gain, after = load(gains[band].ctypes.data, column), load(gains[min(band + 1, bands - 1)].ctypes.data, column)
        factor = square_root(multiply(half, add(_lacking(before, gain), _lacking(gain, after))))
        store(gains[band].ctypes.data, column, multiply(gain, factor))
        before = gain


@compiled
def _lacking(one, other):
    zero, even = broadcast(np.float32(0.0)), broadcast(np.float32(1.0))
    squares = multiply_add(one, one, multiply(other, other))
    factor = divide(multiply(broadcast(np.float32(1.5)), squares), multiply_add(one, other, squares))
    # guard: silent bands lack nothing
    return choose_below(zero, squares, factor, even)


@compiled
def add_band_tail(
    gains: Float32,
    places: npt.NDArray[np.float64],
    noises: Int16,
    fade_at: int,
    share: float,
    missing: Float32,
    scratch: Float32,
    response: Float32,
) -> None:
    """Add `noises` times `gains` to a response. Gains hold at the samples `places` (column,), and are interpolated
    between them.

    The tail fades in from sample `fade_at` on, where the first frame begins that was not decoded. `missing` (2, sample)
    is the amplitude that decoded sound lacks from there on: without the frames after that one, and without that one
    too. If the response is delayed by part of a frame, a `share` of that frame is in it, and the tail is between both
    rows. After `missing`, from `decoded_until` on, no sound was decoded: what the response contains there is
    overwritten. `scratch` (2, sample) is overwritten, too.
    """
    size = response.shape[1]
    end = min(size, noises.shape[2])
    there, one = np.float32(share), np.float32(1.0)
    lines = np.empty((noises.shape[0], _LINES), np.float32)
    decoded = decoded_until(fade_at, missing, size)
    begin, whole = max(0, fade_at), min(end, decoded)
    if begin < whole:
        _write(gains, places, noises, begin, whole, begin, lines, scratch)
        for ear in range(2):
            for n in range(begin, whole):
                amplitude = there * missing[0, n - fade_at] + (one - there) * missing[1, n - fade_at]
                response[ear, n] += amplitude * scratch[ear, n - begin]
    _write(gains, places, noises, whole, end, 0, lines, response)
    silence(response, max(end, decoded), size)


@compiled
def decoded_until(fade_at: int, missing: Float32, size: int) -> int:
    """The number of samples of a response of `size` in which there is decoded sound, as `add_band_tail` has it."""
    return min(size, max(0, fade_at + missing.shape[1]))


@compiled
def _write(gains, places, noises, begin, end, offset, lines, out) -> None:
    """Write samples `begin` to `end` to `out`, whose first sample is number `offset`. Between two places every gain is
    a line over the samples: `lines` (band, 6) are its three values at the first sample and their slopes."""
    last = places.size - 1
    at = begin
    column = -1
    while at < end:
        while column < last and places[column + 1] <= at:
            column += 1
        stop = end if column == last else min(end, math.ceil(places[column + 1]))
        low, high = max(column, 0), min(column + 1, last)
        apart = places[high] - places[low]
        share = (at - places[low]) / apart if apart > 0 else 0.0
        step = 1.0 / apart if apart > 0 else 0.0
        for band in range(noises.shape[0]):
            for part in range(3):
                before, after = gains[part, band, low], gains[part, band, high]
                lines[band, part] = before + (after - before) * share
                lines[band, 3 + part] = (after - before) * step
        _write_lines(lines, noises, at, stop, at - offset, out)
        at = stop


@compiled
def _write_lines(lines, noises, at, stop, to, out) -> None:
    """Write the sum of all bands' samples `at` to `stop` along `lines` to `out`, from its sample `to` on. Sums stay in
    registers, of two vectors at a time, for which a band's line is read once."""
    left_noise, right_noise = noises.ctypes.data + 2 * at, noises[0, 1].ctypes.data + 2 * at
    by_band, bands = noises.strides[0], noises.shape[0]
    to_left, to_right = out[0].ctypes.data + 4 * to, out[1].ctypes.data + 4 * to
    values, ramp, nothing = lines.ctypes.data, load(_RAMP.ctypes.data, 0), broadcast(np.float32(0.0))
    count = stop - at
    pairs, vectors = count // (2 * WIDE_LANES) * (2 * WIDE_LANES), count // WIDE_LANES * WIDE_LANES
    for n in range(0, pairs, 2 * WIDE_LANES):
        x, y = add(ramp, broadcast(np.float32(n))), add(ramp, broadcast(np.float32(n + WIDE_LANES)))
        left, right, next_left, next_right = nothing, nothing, nothing, nothing
        for band in range(bands):
            gain, other, own = _line(values, band, x)
            next_gain, next_other, next_own = _line(values, band, y)
            of_left = load_shorts(left_noise + band * by_band, n)
            of_right = load_shorts(right_noise + band * by_band, n)
            next_of_left = load_shorts(left_noise + band * by_band, n + WIDE_LANES)
            next_of_right = load_shorts(right_noise + band * by_band, n + WIDE_LANES)
            left = multiply_add(gain, of_left, left)
            right = multiply_add(own, of_right, multiply_add(other, of_left, right))
            next_left = multiply_add(next_gain, next_of_left, next_left)
            next_right = multiply_add(next_own, next_of_right, multiply_add(next_other, next_of_left, next_right))
        store(to_left, n, left)
        store(to_right, n, right)
        store(to_left, n + WIDE_LANES, next_left)
        store(to_right, n + WIDE_LANES, next_right)
    for n in range(pairs, vectors, WIDE_LANES):
        x = add(ramp, broadcast(np.float32(n)))
        left, right = nothing, nothing
        for band in range(bands):
            gain, other, own = _line(values, band, x)
            of_left = load_shorts(left_noise + band * by_band, n)
            of_right = load_shorts(right_noise + band * by_band, n)
            left = multiply_add(gain, of_left, left)
            right = multiply_add(own, of_right, multiply_add(other, of_left, right))
        store(to_left, n, left)
        store(to_right, n, right)
    for n in range(vectors, count):
        x = np.float32(n)
        out[0, to + n] = out[1, to + n] = 0
        for band in range(bands):
            of_left, of_right = np.float32(noises[band, 0, at + n]), np.float32(noises[band, 1, at + n])
            out[0, to + n] += (lines[band, 0] + lines[band, 3] * x) * of_left
            other, own = lines[band, 1] + lines[band, 4] * x, lines[band, 2] + lines[band, 5] * x
            out[1, to + n] += other * of_left + own * of_right


@compiled
def _line(values, band, x):
    """The three gains of a band at `x` samples after its line begins."""
    line = _LINES * band
    return (
        multiply_add(x, load_broadcast(values, line + 3), load_broadcast(values, line)),
        multiply_add(x, load_broadcast(values, line + 4), load_broadcast(values, line + 1)),
        multiply_add(x, load_broadcast(values, line + 5), load_broadcast(values, line + 2)),
    )
