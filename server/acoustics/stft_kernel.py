"""Short-time Fourier transforms of both ears for compiled code, eight frames at a time.

The two ears are the real and the imaginary part of one complex transform. `frames` is the address of a float32 buffer
(2, n_fft, 8): real and imaginary parts of n_fft bins or samples of eight neighbouring frames. `total` (2, length) is
each ear's overlap-add signal: frame t spans the samples from t * hop on. Four frames overlap.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from server.acoustics.phase import NO_PHASE
from server.kernels.cache_lines import on_lines
from server.kernels.compiled import compiled
from server.kernels.lane_fft import butterfly, order, transform_but_last, transform_lanes, twiddles
from server.kernels.simd import (
    LANES,
    add,
    at_least,
    broadcast,
    choose_below,
    divide,
    load,
    load_broadcast,
    load_int,
    multiply,
    multiply_add,
    rotate,
    square_root,
    store,
    subtract,
    transpose,
    with_first,
)

Float32 = npt.NDArray[np.float32]


class Windows(NamedTuple):
    """The constants of one codec: `analysis` and `synthesis` windows (n_fft,), where the latter includes the inverse's
    factor 1 / n_fft; `passes` and `places` of the transform, where the latter gives the position of each bin or sample
    after it."""

    n_fft: int
    analysis: Float32
    synthesis: Float32
    passes: Float32
    places: npt.NDArray[np.int64]

    @classmethod
    def of(cls, codec: Codec) -> "Windows":
        return cls(
            codec.n_fft,
            on_lines(codec.window),
            on_lines(codec.dual_window / codec.n_fft),
            twiddles(codec.n_fft),
            np.argsort(order(codec.n_fft)),
        )


@compiled
def place_bin(frames: int, n_fft: int, bin_: int, left_re, left_im, right_re, right_im) -> None:
    """Store one bin of eight frames in `frames` as `synthesise` needs it."""
    # The bin of left + i right, with real and imaginary parts exchanged for the inverse transform; negative frequencies
    # use the conjugates of both ears.
    size = LANES * n_fft
    at = LANES * bin_
    if bin_ == 0 or 2 * bin_ == n_fft:
        store(frames, at, right_re)
        store(frames, size + at, left_re)
        return
    mirrored = size - at
    store(frames, at, add(left_im, right_re))
    store(frames, size + at, subtract(left_re, right_im))
    store(frames, mirrored, subtract(right_re, left_im))
    store(frames, size + mirrored, add(left_re, right_im))


@compiled
def synthesise(frames: int, windows: Windows, total: Float32, first: int) -> None:
    """Transform eight frames back and add them to `total`, from frame `first` on. `frames` is overwritten."""
    n_fft = windows.n_fft
    hop, size = n_fft // 4, LANES * n_fft
    transform_lanes(broadcast(np.float32(0.0)), frames, n_fft, LANES, size, windows.passes.ctypes.data)
    window = windows.synthesis.ctypes.data
    places = windows.places
    for ear in range(2):
        part = size * (1 - ear)
        signal = total[ear].ctypes.data
        for n in range(0, n_fft, LANES):
            samples = transpose(
                (
                    load(frames, part + LANES * places[n]),
                    load(frames, part + LANES * places[n + 1]),
                    load(frames, part + LANES * places[n + 2]),
                    load(frames, part + LANES * places[n + 3]),
                    load(frames, part + LANES * places[n + 4]),
                    load(frames, part + LANES * places[n + 5]),
                    load(frames, part + LANES * places[n + 6]),
                    load(frames, part + LANES * places[n + 7]),
                )
            )
            weight = load(window, n)
            at = first * hop + n
            store(signal, at, multiply_add(samples[0], weight, load(signal, at)))
            at += hop
            store(signal, at, multiply_add(samples[1], weight, load(signal, at)))
            at += hop
            store(signal, at, multiply_add(samples[2], weight, load(signal, at)))
            at += hop
            store(signal, at, multiply_add(samples[3], weight, load(signal, at)))
            at += hop
            store(signal, at, multiply_add(samples[4], weight, load(signal, at)))
            at += hop
            store(signal, at, multiply_add(samples[5], weight, load(signal, at)))
            at += hop
            store(signal, at, multiply_add(samples[6], weight, load(signal, at)))
            at += hop
            store(signal, at, multiply_add(samples[7], weight, load(signal, at)))


@compiled
def synthesise_next(frames: int, windows: Windows, carried: int, rows: int, to: int, other: int) -> None:
    """Synthesise the eight frames after the last eight, and write the samples that are now complete: eight hops of the
    left ear to address `to`, and of the right ear `other` floats after it. `frames` is overwritten.

    `carried` (hop, 2, 3, 8) keeps the sums to which the next frames will be added, and `rows` (2, 8, 8) is a buffer.
    """
    n_fft = windows.n_fft
    like = broadcast(np.float32(0.0))
    transform_but_last(like, frames, n_fft, LANES, LANES * n_fft, windows.passes.ctypes.data)
    add_up(frames, windows, carried, rows, to, other)


@compiled
def add_up(frames: int, windows: Windows, carried: int, rows: int, to: int, other: int) -> None:
    """Do the part of `synthesise_next` after all but the last pass of the transform."""
    hop, size = windows.n_fft // 4, LANES * windows.n_fft
    window, places = windows.synthesis.ctypes.data, windows.places.ctypes.data
    like = broadcast(np.float32(0.0))
    for n in range(0, hop, LANES):
        for i in range(LANES):
            # The last pass gives the samples that lie a hop apart; real and imaginary parts are exchanged, because it
            # is the inverse.
            r0, l0, r1, l1, r2, l2, r3, l3 = butterfly(like, frames, size, LANES * load_int(places, n + i), LANES)
            w0, w1 = load_broadcast(window, n + i), load_broadcast(window, hop + n + i)
            w2, w3 = load_broadcast(window, 2 * hop + n + i), load_broadcast(window, 3 * hop + n + i)
            kept = 6 * LANES * (n + i)
            store(rows, LANES * i, _overlapped(carried, kept, l0, l1, l2, l3, w0, w1, w2, w3))
            store(rows, LANES * (LANES + i), _overlapped(carried, kept + 3 * LANES, r0, r1, r2, r3, w0, w1, w2, w3))
        _store_columns(rows, 0, to, n, hop)
        _store_columns(rows, LANES * LANES, to, other + n, hop)


@compiled
def one_before(last: int, at: int, now):
    """Shift a row of eight values by one: each value is replaced by the one before it, and the first by the last value
    of the previous eight. `last` keeps at `at` what the next call needs."""
    turned = rotate(now)
    before = with_first(load(last, at), turned)
    store(last, at, turned)
    return before


@compiled
def _overlapped(carried, at, x0, x1, x2, x3, w0, w1, w2, w3):
    """One sample of each of eight hops, by overlap-add of the four hops of each of eight frames: the second hop is
    added to the first hop of the next frame, and so on."""
    total = multiply_add(x2, w2, one_before(carried, at, multiply(x3, w3)))
    total = multiply_add(x1, w1, one_before(carried, at + LANES, total))
    return multiply_add(x0, w0, one_before(carried, at + 2 * LANES, total))


@compiled
def _store_columns(rows, first, to, at, step) -> None:
    columns = transpose(
        (
            load(rows, first),
            load(rows, first + 8),
            load(rows, first + 16),
            load(rows, first + 24),
            load(rows, first + 32),
            load(rows, first + 40),
            load(rows, first + 48),
            load(rows, first + 56),
        )
    )
    store(to, at, columns[0])
    store(to, at + step, columns[1])
    store(to, at + 2 * step, columns[2])
    store(to, at + 3 * step, columns[3])
    store(to, at + 4 * step, columns[4])
    store(to, at + 5 * step, columns[5])
    store(to, at + 6 * step, columns[6])
    store(to, at + 7 * step, columns[7])


@compiled
def analyse(frames: int, windows: Windows, total: Float32, first: int) -> None:
    """Transform eight frames of `total`, from frame `first` on; bin k of left + i right is stored at `places[k]`."""
    n_fft = windows.n_fft
    hop, size = n_fft // 4, LANES * n_fft
    window = windows.analysis.ctypes.data
    for ear in range(2):
        signal = total[ear].ctypes.data
        for n in range(0, n_fft, LANES):
            weight = load(window, n)
            at = first * hop + n
            samples = transpose(
                (
                    multiply(load(signal, at), weight),
                    multiply(load(signal, at + hop), weight),
                    multiply(load(signal, at + 2 * hop), weight),
                    multiply(load(signal, at + 3 * hop), weight),
                    multiply(load(signal, at + 4 * hop), weight),
                    multiply(load(signal, at + 5 * hop), weight),
                    multiply(load(signal, at + 6 * hop), weight),
                    multiply(load(signal, at + 7 * hop), weight),
                )
            )
            to = ear * size + LANES * n
            store(frames, to, samples[0])
            store(frames, to + 8, samples[1])
            store(frames, to + 16, samples[2])
            store(frames, to + 24, samples[3])
            store(frames, to + 32, samples[4])
            store(frames, to + 40, samples[5])
            store(frames, to + 48, samples[6])
            store(frames, to + 56, samples[7])
    transform_lanes(broadcast(np.float32(0.0)), frames, n_fft, LANES, size, windows.passes.ctypes.data)


@compiled
def _with_magnitude(re, im, magnitude):
    """A complex number of the given magnitude with the phase of re + i im."""
    square = multiply_add(re, re, multiply(im, im))
    tiny = broadcast(np.float32(NO_PHASE))
    scale = divide(magnitude, square_root(at_least(square, tiny)))
    return (
        choose_below(square, tiny, magnitude, multiply(re, scale)),
        choose_below(square, tiny, broadcast(np.float32(0.0)), multiply(im, scale)),
    )


@compiled
def impose_magnitudes(analysed: int, placed: int, windows: Windows, target: Float32, first: int) -> None:
    """Combine the phases of eight frames in `analysed` with the magnitudes of `target` (bin, ear, frame), from frame
    `first` on, and store the result in `placed`."""
    n_fft = windows.n_fft
    size = LANES * n_fft
    places = windows.places
    half = broadcast(np.float32(0.5))
    for bin_ in range(n_fft // 2 + 1):
        at, mirrored = LANES * places[bin_], LANES * places[(n_fft - bin_) % n_fft]
        re, im = load(analysed, at), load(analysed, size + at)
        mirrored_re, mirrored_im = load(analysed, mirrored), load(analysed, size + mirrored)
        magnitude = target[bin_].ctypes.data
        left_re, left_im = _with_magnitude(
            multiply(add(re, mirrored_re), half), multiply(subtract(im, mirrored_im), half), load(magnitude, first)
        )
        right_re, right_im = _with_magnitude(
            multiply(add(im, mirrored_im), half),
            multiply(subtract(mirrored_re, re), half),
            load(magnitude, target.shape[2] + first),
        )
        place_bin(placed, n_fft, bin_, left_re, left_im, right_re, right_im)
