"""Eight complex Fourier transforms at once, one per lane, for compiled code.

`values` are (2, n, 8) float32 at an address: real parts, then imaginary parts, of n points in eight lanes. The
transform is radix 4, decimation in frequency, in place; its output is in digit-reversed order, which callers undo when
they move the data anyway. With real and imaginary parts exchanged in input and output it is the inverse, n times too
large.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled
from server.kernels.simd import (
    LANES,
    add,
    load,
    load_broadcast,
    multiply,
    multiply_add,
    multiply_subtract,
    store,
    subtract,
)


@cache
def twiddles(points: int) -> npt.NDArray[np.float32]:
    """The twiddle factors of each pass in turn: six floats per butterfly of radix 4, two per butterfly of radix 2.
    `points` must be a power of two."""
    passes = [np.zeros(0)]
    if is_odd_power(points):
        turn = np.exp(-2j * np.pi * np.arange(points // 2) / points)
        passes.append(np.stack([turn.real, turn.imag], axis=-1).ravel())
    span = first_span(points)
    while span:
        turn = np.exp(-2j * np.pi * np.arange(span)[:, None] * np.arange(1, 4) / (4 * span))
        passes.append(np.stack([turn.real, turn.imag], axis=-1).ravel())
        span //= 4
    return np.concatenate(passes).astype(np.float32)


@cache
def order(points: int) -> npt.NDArray[np.int64]:
    """(points,) the frequency at each position after the transform."""
    frequencies, length = np.arange(1), 1
    while length < points:
        radix = 2 if length * 2 == points and is_odd_power(points) else 4
        frequencies = np.concatenate([frequencies * radix + digit for digit in range(radix)])
        length *= radix
    return frequencies


@compiled
def first_span(points: int) -> int:
    """The span of the first radix-4 pass: a quarter of the points that remain after the radix-2 pass, if there is
    one."""
    return points // 8 if is_odd_power(points) else points // 4


@compiled
def is_odd_power(points: int) -> bool:
    """Whether `points` is an odd power of two, so that the first pass is of radix 2."""
    power = 0
    while points > 1:
        points >>= 1
        power += 1
    return power % 2 == 1


@compiled
def transform_lanes(values: int, points: int, passes: int) -> None:
    """Transform in place, forward; `passes` is the address of `twiddles(points)`."""
    if is_odd_power(points):
        _halve(values, points, passes)
    transform_halved(values, points, passes)


@compiled
def transform_halved(values: int, points: int, passes: int) -> None:
    """Do the part of `transform_lanes` after the pass of radix 2, if there is one."""
    _turned_passes(values, points, passes)
    size = LANES * points
    if first_span(points) == 0:
        return
    for at in range(0, size, 4 * LANES):
        y0r, y0i, y1r, y1i, y2r, y2i, y3r, y3i = butterfly(values, size, at, LANES)
        store(values, at, y0r)
        store(values, size + at, y0i)
        store(values, at + 8, y1r)
        store(values, size + at + 8, y1i)
        store(values, at + 16, y2r)
        store(values, size + at + 16, y2i)
        store(values, at + 24, y3r)
        store(values, size + at + 24, y3i)


@compiled
def transform_but_last(values: int, points: int, passes: int) -> None:
    """Do all passes except the last, whose butterflies each combine four neighbours without twiddles."""
    if is_odd_power(points):
        _halve(values, points, passes)
    _turned_passes(values, points, passes)


@compiled
def _turned_passes(values, points, passes) -> None:
    """Do the radix-4 passes except the last."""
    size = LANES * points
    table = points if is_odd_power(points) else 0
    span = first_span(points)
    while span > 1:
        for j in range(span):
            # A range with this step would need a division to find its length.
            at = LANES * j
            while at < size:
                _turned_butterfly(values, size, at, LANES * span, passes, table + 6 * j)
                at += 4 * LANES * span
        table += 6 * span
        span //= 4


@compiled
def _halve(values, points, passes) -> None:
    """Do the pass of radix 2."""
    size, half = LANES * points, points // 2
    for j in range(half):
        at, to = 8 * j, 8 * (j + half)
        ar, ai, br, bi = load(values, at), load(values, size + at), load(values, to), load(values, size + to)
        store(values, at, add(ar, br))
        store(values, size + at, add(ai, bi))
        store_turned(values, size, to, subtract(ar, br), subtract(ai, bi), passes, 2 * j)


@compiled
def butterfly(values: int, size: int, at: int, step: int):
    """Transform four points that are `step` apart; returns the real and imaginary part of each."""
    p1, p2, p3 = at + step, at + 2 * step, at + 3 * step
    ar, ai, br, bi = load(values, at), load(values, size + at), load(values, p1), load(values, size + p1)
    cr, ci, dr, di = load(values, p2), load(values, size + p2), load(values, p3), load(values, size + p3)
    er, ei, fr, fi = add(ar, cr), add(ai, ci), subtract(ar, cr), subtract(ai, ci)
    gr, gi = add(br, dr), add(bi, di)
    hr, hi = subtract(bi, di), subtract(dr, br)  # -i (b - d)
    return (
        add(er, gr),
        add(ei, gi),
        add(fr, hr),
        add(fi, hi),
        subtract(er, gr),
        subtract(ei, gi),
        subtract(fr, hr),
        subtract(fi, hi),
    )


@compiled
def _turned_butterfly(values, size, at, step, passes, t) -> None:
    y0r, y0i, y1r, y1i, y2r, y2i, y3r, y3i = butterfly(values, size, at, step)
    store(values, at, y0r)
    store(values, size + at, y0i)
    store_turned(values, size, at + step, y1r, y1i, passes, t)
    store_turned(values, size, at + 2 * step, y2r, y2i, passes, t + 2)
    store_turned(values, size, at + 3 * step, y3r, y3i, passes, t + 4)


@compiled
def store_turned(values, size, at, re, im, passes, t) -> None:
    """Store a point, multiplied by the twiddle factor at `t`."""
    # Loading the factors just before use keeps registers free until then.
    c, s = load_broadcast(passes, t), load_broadcast(passes, t + 1)
    store(values, at, multiply_subtract(im, s, multiply(re, c)))
    store(values, size + at, multiply_add(im, c, multiply(re, s)))
