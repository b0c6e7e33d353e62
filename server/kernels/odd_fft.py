"""The transform of the compiled convolver: the odd-frequency Fourier transform of real samples, in place, with bins in
an unspecified order.

Its bins lie halfway between those of an ordinary transform. A window of 2 n real samples x is a polynomial modulo z^2n
= -1. At the n roots of z^n = -i its values are those of the n complex numbers x[j] - i x[n + j], j < n, twisted by
exp(-i pi j / 2 n) and transformed by an ordinary complex FFT of size n (Nussbaumer 1981; the "right-angle" convolution
of Krot and Minervina 1992). The other n roots give the conjugates. So 2 n real samples need n complex bins, all alike:
no bin is real, and no bins have to be separated as after an ordinary FFT of real samples. Products of such bins
convolve negacyclically: samples that wrap around change their sign. This does not matter for overlap-save, which drops
these samples.

The FFT splits n = 8 m: m-point transforms in every lane (`lane_fft`), twiddles, then 8 points across the lanes after a
transposition of eight vectors. The resulting order of bins is kept, since only products of bins follow, and the inverse
undoes the steps in reverse.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from server.kernels.cache_lines import on_lines
from server.kernels.compiled import compiled
from server.kernels.lane_fft import (
    first_span,
    is_odd_power,
    order,
    store_turned,
    transform_halved,
    transform_lanes,
    twiddles,
)
from server.kernels.simd import (
    LANES,
    add,
    broadcast,
    broadcast_as,
    first_halves,
    join,
    lanes,
    load,
    load_broadcast,
    multiply,
    multiply_add,
    multiply_subtract,
    second_halves,
    store,
    subtract,
    transpose,
)

_WIDE = 2 * LANES
_pair = lanes(_WIDE)
_load_pair, _load_twice = _pair.load, _pair.load_twice

SMALLEST = LANES * LANES


@dataclass(frozen=True)
class Tables:
    """Constants of size n = `size`, a power of two from `SMALLEST` on; float32, real parts then imaginary parts.

    `twist` (2, n) is exp(-i pi j / 2 n); `lanes` (2, n) the twiddles before the transform across lanes, in the order of
    the bins; `passes` the twiddles of each radix-4 pass, six per butterfly.
    """

    size: int
    twist: npt.NDArray[np.float32]
    passes: npt.NDArray[np.float32]
    lanes: npt.NDArray[np.float32]


@cache
def tables(size: int) -> Tables:
    """The tables of a size. Raises ValueError for a size that is no power of two, or below `SMALLEST`."""
    if size < SMALLEST or size & (size - 1):
        raise ValueError(f"the transform has a size of {SMALLEST} or more, a power of two, not {size}")
    vectors = size // LANES
    lanes = np.exp(-2j * np.pi * order(vectors)[:, None] * np.arange(LANES) / size).ravel()
    twist = np.exp(-0.5j * np.pi * np.arange(size) / size)
    return Tables(size, _parts(twist), twiddles(vectors), _parts(lanes))


def _parts(values: npt.NDArray[np.complex128]) -> npt.NDArray[np.float32]:
    return on_lines(np.stack([values.real, values.imag]))


@compiled
def forward(
    first: int,
    second: int,
    bins: int,
    to: int,
    step: int,
    imaginary: int,
    size: int,
    twist: int,
    passes: int,
    lanes: int,
) -> None:
    """Transform the window whose halves (n,) are at addresses `first` and `second`; all arrays are addresses.

    Real parts are written, eight at a time, to every `step`-th float32 from `to` on, and imaginary parts `imaginary`
    floats after them. `bins` (2, n) is a buffer, which may be the same as `to` if vectors are contiguous: step 8,
    imaginary n.
    """
    vectors = size // 8
    like = broadcast(np.float32(0.0))
    if is_odd_power(vectors):
        half = size // 2
        for n in range(0, half, 8):
            ar, ai = _twisted(first, second, n, size, twist)
            br, bi = _twisted(first, second, half + n, size, twist)
            store(bins, n, add(ar, br))
            store(bins, size + n, add(ai, bi))
            store_turned(bins, size, half + n, subtract(ar, br), subtract(ai, bi), passes, n // 4)
        transform_halved(like, bins, vectors, LANES, size, passes)
    else:
        for n in range(0, size, 8):
            re, im = _twisted(first, second, n, size, twist)
            store(bins, n, re)
            store(bins, size + n, im)
        transform_lanes(like, bins, vectors, LANES, size, passes)
    for at in range(0, size, 64):
        re, im = _load_8(bins, at, 8), _load_8(bins, size + at, 8)
        cos, sin = _load_8(lanes, at, 8), _load_8(lanes, size + at, 8)
        re, im = _multiply_8(re, im, cos, sin)
        re, im = _eight_points(transpose(re), transpose(im))
        _store_8(to, at // 8 * step, step, re)
        _store_8(to, imaginary + at // 8 * step, step, im)


@compiled
def forward_pair(
    one: int, other: int, bins: int, to: int, step: int, size: int, twist: int, passes: int, lanes: int
) -> None:
    """Transform two windows at once, whose first halves (n,) are at addresses `one` and `other`, and whose second
    halves are silent; all arrays are addresses.

    For eight bins, 32 floats are written at every `step`-th float32 from `to` on: real and imaginary parts of the first
    window, then those of the other. `bins` (4 n) is a buffer, in which imaginary parts follow the real parts of each
    vector: if they were a power of two apart, both would need the same place in a cache.
    """
    vectors, half = size // 8, size // 2
    like = join(broadcast(np.float32(0.0)), broadcast(np.float32(0.0)))
    if is_odd_power(vectors):
        for n in range(0, half, 8):
            ar, ai = _twisted_pair(one, other, n, size, twist)
            br, bi = _twisted_pair(one, other, half + n, size, twist)
            store(bins, 4 * n, add(ar, br))
            store(bins, 4 * n + _WIDE, add(ai, bi))
            store_turned(bins, _WIDE, 4 * (half + n), subtract(ar, br), subtract(ai, bi), passes, n // 4)
        transform_halved(like, bins, vectors, 2 * _WIDE, _WIDE, passes)
    else:
        for n in range(0, size, 8):
            re, im = _twisted_pair(one, other, n, size, twist)
            store(bins, 4 * n, re)
            store(bins, 4 * n + _WIDE, im)
        transform_lanes(like, bins, vectors, 2 * _WIDE, _WIDE, passes)
    for at in range(0, size, 64):
        re, im = _load_pair_8(bins, 4 * at), _load_pair_8(bins, 4 * at + _WIDE)
        cos, sin = _load_twice_8(lanes, at), _load_twice_8(lanes, size + at)
        re, im = _multiply_8(re, im, cos, sin)
        re, im = _eight_points(transpose(re), transpose(im))
        _store_pair_8(to, at // 8 * step, step, re, im)


@compiled
def _twisted_pair(one, other, n, size, twist):
    windows = join(load(one, n), load(other, n))
    return multiply(windows, _load_twice(twist, n)), multiply(windows, _load_twice(twist, size + n))


@compiled
def _twisted(first, second, n, size, twist):
    a, b = load(first, n), load(second, n)
    c, s = load(twist, n), load(twist, size + n)
    return multiply_add(b, s, multiply(a, c)), multiply_subtract(b, c, multiply(a, s))  # (a - i b)(c + i s)


@compiled
def inverse(
    spectrum: int,
    step: int,
    imaginary: int,
    bins: int,
    out: int,
    size: int,
    twist: int,
    passes: int,
    lanes: int,
) -> None:
    """Write the second half (n,) of the window, which overlap-save keeps, to `out`. The spectrum is laid out as
    `forward` writes it; `bins` (2, n) is a buffer, which may be the same as the spectrum and is overwritten."""
    vectors = size // 8
    _invert_across_lanes(spectrum, step, imaginary, bins, size, lanes)
    largest = first_span(vectors)
    is_odd = 4 * largest != vectors
    # The twiddles of a span come after those of all larger spans, six floats per butterfly.
    table = 2 * (4 * largest - 4) + (vectors if is_odd else 0)
    span = 1
    while span <= largest:
        _invert_pass(bins, size, span, passes, table)
        span *= 4
        table -= 6 * span
    scale = broadcast(np.float32(-1.0 / size))
    if is_odd:
        _untwist_halves(bins, size, twist, passes, scale, out)
    else:
        for n in range(0, size, 8):
            _untwist(load(bins, n), load(bins, size + n), n, size, twist, scale, out)


@compiled
def _invert_across_lanes(spectrum, step, imaginary, bins, size, lanes) -> None:
    """Undo the eight-point transforms across the lanes, and the twiddles before them."""
    for at in range(0, size, 64):
        im, re = _load_8(spectrum, imaginary + at // 8 * step, step), _load_8(spectrum, at // 8 * step, step)
        im, re = _eight_points(im, re)  # real and imaginary parts swapped: the inverse
        re, im = transpose(re), transpose(im)
        cos, sin = _load_8(lanes, at, 8), _load_8(lanes, size + at, 8)
        re, im = _multiply_conjugate_8(re, im, cos, sin)
        _store_8(bins, at, 8, re)
        _store_8(bins, size + at, 8, im)


@compiled
def _invert_pass(bins, size, span, passes, table) -> None:
    """Undo a pass of radix 4, whose butterflies' points are `span` apart; `table` is the index of its twiddles."""
    vectors = size // 8
    for j in range(span):
        t = table + 6 * j
        c1, s1 = load_broadcast(passes, t), load_broadcast(passes, t + 1)
        c2, s2 = load_broadcast(passes, t + 2), load_broadcast(passes, t + 3)
        c3, s3 = load_broadcast(passes, t + 4), load_broadcast(passes, t + 5)
        group = j  # a range with this step would need a division to find its length
        while group < vectors:
            p0, p1 = 8 * group, 8 * (group + span)
            p2, p3 = 8 * (group + 2 * span), 8 * (group + 3 * span)
            ar, ai = load(bins, p0), load(bins, size + p0)
            br, bi = _turned_back(bins, size, p1, c1, s1)
            cr, ci = _turned_back(bins, size, p2, c2, s2)
            dr, di = _turned_back(bins, size, p3, c3, s3)
            er, ei, fr, fi = add(ar, cr), add(ai, ci), subtract(ar, cr), subtract(ai, ci)
            gr, gi = add(br, dr), add(bi, di)
            hr, hi = subtract(di, bi), subtract(br, dr)  # i (b - d)
            store(bins, p0, add(er, gr))
            store(bins, size + p0, add(ei, gi))
            store(bins, p1, add(fr, hr))
            store(bins, size + p1, add(fi, hi))
            store(bins, p2, subtract(er, gr))
            store(bins, size + p2, subtract(ei, gi))
            store(bins, p3, subtract(fr, hr))
            store(bins, size + p3, subtract(fi, hi))
            group += 4 * span


@compiled
def _turned_back(bins, size, at, cos, sin):
    """Multiply a point by the conjugate of a twiddle factor."""
    re, im = load(bins, at), load(bins, size + at)
    return multiply_add(im, sin, multiply(re, cos)), multiply_subtract(re, sin, multiply(im, cos))


@compiled
def _untwist_halves(bins, size, twist, passes, scale, out) -> None:
    """Undo the pass of radix 2 and the twist."""
    half = size // 2
    for n in range(0, half, 8):
        m = half + n
        c, s = load_broadcast(passes, n // 4), load_broadcast(passes, n // 4 + 1)
        ar, ai = load(bins, n), load(bins, size + n)
        br, bi = _turned_back(bins, size, m, c, s)
        _untwist(add(ar, br), add(ai, bi), n, size, twist, scale, out)
        _untwist(subtract(ar, br), subtract(ai, bi), m, size, twist, scale, out)


@compiled
def _untwist(re, im, n, size, twist, scale, out) -> None:
    part = multiply_subtract(re, load(twist, size + n), multiply(im, load(twist, n)))  # -Im((re + i im)(c - i s))
    store(out, n, multiply(part, scale))


@compiled
def _load_8(address: int, index: int, step: int) -> Any:
    return (
        load(address, index),
        load(address, index + step),
        load(address, index + 2 * step),
        load(address, index + 3 * step),
        load(address, index + 4 * step),
        load(address, index + 5 * step),
        load(address, index + 6 * step),
        load(address, index + 7 * step),
    )


@compiled
def _store_8(address: int, index: int, step: int, rows: Any) -> None:
    store(address, index, rows[0])
    store(address, index + step, rows[1])
    store(address, index + 2 * step, rows[2])
    store(address, index + 3 * step, rows[3])
    store(address, index + 4 * step, rows[4])
    store(address, index + 5 * step, rows[5])
    store(address, index + 6 * step, rows[6])
    store(address, index + 7 * step, rows[7])


@compiled
def _load_pair_8(address: int, index: int) -> Any:
    step = 2 * _WIDE
    return (
        _load_pair(address, index),
        _load_pair(address, index + step),
        _load_pair(address, index + 2 * step),
        _load_pair(address, index + 3 * step),
        _load_pair(address, index + 4 * step),
        _load_pair(address, index + 5 * step),
        _load_pair(address, index + 6 * step),
        _load_pair(address, index + 7 * step),
    )


@compiled
def _load_twice_8(address: int, index: int) -> Any:
    return (
        _load_twice(address, index),
        _load_twice(address, index + 8),
        _load_twice(address, index + 16),
        _load_twice(address, index + 24),
        _load_twice(address, index + 32),
        _load_twice(address, index + 40),
        _load_twice(address, index + 48),
        _load_twice(address, index + 56),
    )


@compiled
def _store_pair_8(address: int, index: int, step: int, re: Any, im: Any) -> None:
    """Store the real and imaginary parts of one window, and after them those of the other."""
    _store_pair(address, index, re[0], im[0])
    _store_pair(address, index + step, re[1], im[1])
    _store_pair(address, index + 2 * step, re[2], im[2])
    _store_pair(address, index + 3 * step, re[3], im[3])
    _store_pair(address, index + 4 * step, re[4], im[4])
    _store_pair(address, index + 5 * step, re[5], im[5])
    _store_pair(address, index + 6 * step, re[6], im[6])
    _store_pair(address, index + 7 * step, re[7], im[7])


@compiled
def _store_pair(address: int, index: int, re: Any, im: Any) -> None:
    store(address, index, first_halves(re, im))
    store(address, index + _WIDE, second_halves(re, im))


@compiled
def _multiply_8(ar: Any, ai: Any, br: Any, bi: Any) -> Any:
    return (
        (
            multiply_subtract(ai[0], bi[0], multiply(ar[0], br[0])),
            multiply_subtract(ai[1], bi[1], multiply(ar[1], br[1])),
            multiply_subtract(ai[2], bi[2], multiply(ar[2], br[2])),
            multiply_subtract(ai[3], bi[3], multiply(ar[3], br[3])),
            multiply_subtract(ai[4], bi[4], multiply(ar[4], br[4])),
            multiply_subtract(ai[5], bi[5], multiply(ar[5], br[5])),
            multiply_subtract(ai[6], bi[6], multiply(ar[6], br[6])),
            multiply_subtract(ai[7], bi[7], multiply(ar[7], br[7])),
        ),
        (
            multiply_add(ai[0], br[0], multiply(ar[0], bi[0])),
            multiply_add(ai[1], br[1], multiply(ar[1], bi[1])),
            multiply_add(ai[2], br[2], multiply(ar[2], bi[2])),
            multiply_add(ai[3], br[3], multiply(ar[3], bi[3])),
            multiply_add(ai[4], br[4], multiply(ar[4], bi[4])),
            multiply_add(ai[5], br[5], multiply(ar[5], bi[5])),
            multiply_add(ai[6], br[6], multiply(ar[6], bi[6])),
            multiply_add(ai[7], br[7], multiply(ar[7], bi[7])),
        ),
    )


@compiled
def _multiply_conjugate_8(ar: Any, ai: Any, br: Any, bi: Any) -> Any:
    return (
        (
            multiply_add(ai[0], bi[0], multiply(ar[0], br[0])),
            multiply_add(ai[1], bi[1], multiply(ar[1], br[1])),
            multiply_add(ai[2], bi[2], multiply(ar[2], br[2])),
            multiply_add(ai[3], bi[3], multiply(ar[3], br[3])),
            multiply_add(ai[4], bi[4], multiply(ar[4], br[4])),
            multiply_add(ai[5], bi[5], multiply(ar[5], br[5])),
            multiply_add(ai[6], bi[6], multiply(ar[6], br[6])),
            multiply_add(ai[7], bi[7], multiply(ar[7], br[7])),
        ),
        (
            multiply_subtract(ar[0], bi[0], multiply(ai[0], br[0])),
            multiply_subtract(ar[1], bi[1], multiply(ai[1], br[1])),
            multiply_subtract(ar[2], bi[2], multiply(ai[2], br[2])),
            multiply_subtract(ar[3], bi[3], multiply(ai[3], br[3])),
            multiply_subtract(ar[4], bi[4], multiply(ai[4], br[4])),
            multiply_subtract(ar[5], bi[5], multiply(ai[5], br[5])),
            multiply_subtract(ar[6], bi[6], multiply(ai[6], br[6])),
            multiply_subtract(ar[7], bi[7], multiply(ai[7], br[7])),
        ),
    )


@compiled
def _four_points(ar: Any, ai: Any, br: Any, bi: Any, cr: Any, ci: Any, dr: Any, di: Any) -> Any:
    er, ei, fr, fi = add(ar, cr), add(ai, ci), subtract(ar, cr), subtract(ai, ci)
    gr, gi = add(br, dr), add(bi, di)
    hr, hi = subtract(bi, di), subtract(dr, br)  # -i (b - d)
    return (
        (add(er, gr), add(fr, hr), subtract(er, gr), subtract(fr, hr)),
        (add(ei, gi), add(fi, hi), subtract(ei, gi), subtract(fi, hi)),
    )


@compiled
def _eight_points(re: Any, im: Any) -> Any:
    """The transform of eight points in every lane, in order of frequency."""
    half = broadcast_as(re[0], np.float32(np.sqrt(0.5)))
    er, ei = _four_points(re[0], im[0], re[2], im[2], re[4], im[4], re[6], im[6])
    odd_r, odd_i = _four_points(re[1], im[1], re[3], im[3], re[5], im[5], re[7], im[7])
    # Multiplied by exp(-i pi k / 4): k = 1 and 3 need a rotation, k = 2 is -i.
    ar, ai = odd_r[0], odd_i[0]
    br, bi = multiply(add(odd_r[1], odd_i[1]), half), multiply(subtract(odd_i[1], odd_r[1]), half)
    cr, ci = odd_i[2], odd_r[2]  # the imaginary part with the other sign
    dr, di = multiply(subtract(odd_i[3], odd_r[3]), half), multiply(add(odd_r[3], odd_i[3]), half)  # the same here
    return (
        (
            add(er[0], ar),
            add(er[1], br),
            add(er[2], cr),
            add(er[3], dr),
            subtract(er[0], ar),
            subtract(er[1], br),
            subtract(er[2], cr),
            subtract(er[3], dr),
        ),
        (
            add(ei[0], ai),
            add(ei[1], bi),
            subtract(ei[2], ci),
            subtract(ei[3], di),
            subtract(ei[0], ai),
            subtract(ei[1], bi),
            add(ei[2], ci),
            add(ei[3], di),
        ),
    )
