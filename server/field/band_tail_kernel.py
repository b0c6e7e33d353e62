"""The late tail of a response as band noises with changing gains, in compiled code.

Axes: bands (7), columns of a prediction, harmonics k; noises (band, left or right, sample); responses (ear, sample).
"""

import math

import numpy as np
import numpy.typing as npt

from server.acoustics.decoding_kernel import silence
from server.kernels.compiled import compiled
from server.kernels.simd import WIDE_LANES, add, lanes, multiply_add, store

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
    log_magnitude: Float32,
    directions: Float32,
    products: Float32,
    diffuse: Float32,
    steps: Float32,
    first: int,
    log_floor: float,
    least: float,
    gains: Float32,
) -> None:
    """Write the `gains` (3, band, column - first) of a prediction's columns from column `first` on: of the left noise
    at the left ear, of the left noise at the right ear, and of the right noise there.

    `products` (band, product, k) are those of the turned head, averaged over each band. `diffuse` (band, 3) are the
    band's powers at both ears, and the coherence between them, in diffuse sound of unit power, which is what the noises
    are. Gains are in units of `steps` (band, left or right), the units of the noises. Where directions cancel, an ear's
    power is `least` times that of diffuse sound.
    """
    bands, columns = log_magnitude.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    floor, lowest = np.float32(log_floor), np.float32(least)
    for column in range(first, columns):
        to = column - first
        for band in range(bands):
            left, right, real = products[band, 0, 0], products[band, 1, 0], products[band, 2, 0]
            for k in range(1, products.shape[2]):
                of_k = directions[k - 1, band, column]
                left += products[band, 0, k] * of_k
                right += products[band, 1, k] * of_k
                real += products[band, 2, k] * of_k
            # guard: where directions cancel, a band is left over
            left = max(left, lowest * diffuse[band, 0])
            right = max(right, lowest * diffuse[band, 1])
            magnitude = max(np.exp(log_magnitude[band, column]) - floor, zero)
            gains[0, band, to] = magnitude * np.sqrt(left / diffuse[band, 0])
            gains[1, band, to] = magnitude * np.sqrt(right / diffuse[band, 1])
            gains[2, band, to] = min(_ALMOST, max(-_ALMOST, real / np.sqrt(left * right)))
        before_left, before_right = gains[0, 0, to], gains[1, 0, to]
        for band in range(bands):
            after = min(band + 1, bands - 1)
            left, right, coherence = gains[0, band, to], gains[1, band, to], gains[2, band, to]
            at_left = left * balance(before_left, left, gains[0, after, to])
            at_right = right * balance(before_right, right, gains[1, after, to])
            before_left, before_right = left, right
            # Noises of coherence d with gains b and a have the coherence b + a d and the power a^2 + b^2 + 2 a b d.
            of_diffuse = diffuse[band, 2]
            own = np.sqrt((one - coherence * coherence) / (one - of_diffuse * of_diffuse))
            gains[0, band, to] = at_left * steps[band, 0]
            gains[1, band, to] = at_right * (coherence - own * of_diffuse) * steps[band, 0]
            gains[2, band, to] = at_right * own * steps[band, 1]


@compiled
def balance(before: np.float32, gain: np.float32, after: np.float32) -> np.float32:
    """The factor for the gain of a band by which its power is right, given the gains of the bands `before` and `after`
    it.

    Neighbouring bands overlap and are parts of one noise, so their amplitudes add up, and not their powers. Over the
    octave between two bands with gains g and h, the mean power is (g^2 + g h + h^2) / 3 where it should be
    (g^2 + h^2) / 2. The squared factor is the mean, over the octaves on both sides, of the second over the first.
    """
    return np.sqrt(np.float32(0.5) * (_lacking(before, gain) + _lacking(gain, after)))


@compiled
def _lacking(one: np.float32, other: np.float32) -> np.float32:
    squares = one * one + other * other
    # guard: silent bands lack nothing
    if not squares > np.float32(0.0):
        return np.float32(1.0)
    return np.float32(1.5) * squares / (squares + one * other)


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
    registers."""
    left_noise, right_noise = noises.ctypes.data + 2 * at, noises[0, 1].ctypes.data + 2 * at
    by_band = noises.strides[0]
    to_left, to_right = out[0].ctypes.data + 4 * to, out[1].ctypes.data + 4 * to
    values, ramp, nothing = lines.ctypes.data, load(_RAMP.ctypes.data, 0), broadcast(np.float32(0.0))
    count = stop - at
    vectors = count // WIDE_LANES * WIDE_LANES
    for n in range(0, vectors, WIDE_LANES):
        x = add(ramp, broadcast(np.float32(n)))
        left, right = nothing, nothing
        for band in range(noises.shape[0]):
            line = _LINES * band
            of_left = load_shorts(left_noise + band * by_band, n)
            of_right = load_shorts(right_noise + band * by_band, n)
            gain = multiply_add(x, load_broadcast(values, line + 3), load_broadcast(values, line))
            other = multiply_add(x, load_broadcast(values, line + 4), load_broadcast(values, line + 1))
            own = multiply_add(x, load_broadcast(values, line + 5), load_broadcast(values, line + 2))
            left = multiply_add(gain, of_left, left)
            right = multiply_add(own, of_right, multiply_add(other, of_left, right))
        store(to_left, n, left)
        store(to_right, n, right)
    for n in range(vectors, count):
        x = np.float32(n)
        out[0, to + n] = out[1, to + n] = 0
        for band in range(noises.shape[0]):
            of_left, of_right = np.float32(noises[band, 0, at + n]), np.float32(noises[band, 1, at + n])
            out[0, to + n] += (lines[band, 0] + lines[band, 3] * x) * of_left
            other, own = lines[band, 1] + lines[band, 4] * x, lines[band, 2] + lines[band, 5] * x
            out[1, to + n] += other * of_left + own * of_right
