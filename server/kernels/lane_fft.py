"""Eight or sixteen complex Fourier transforms at once, one per lane, for compiled code.

`values` is the address of n points: the real parts of each begin `step` float32 after those of the one before it, and
its imaginary parts are `imaginary` float32 after its real parts. There are as many lanes as in the vector `like`, of
which nothing else is used. The transform is radix 4, decimation in frequency, in place; its output is in digit-reversed
order, which callers undo when they move the data anyway. With real and imaginary parts exchanged in input and output it
is the inverse, n times too large.
"""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled
from server.kernels.simd import (
    add,
    load_as,
    load_broadcast_as,
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
def transform_lanes(like: Any, values: int, points: int, step: int, imaginary: int, passes: int) -> None:
    """Transform in place, forward; `passes` is the address of `twiddles(points)`."""
    if is_odd_power(points):
        _halve(like, values, points, step, imaginary, passes)
    transform_halved(like, values, points, step, imaginary, passes)


@compiled
def transform_halved(like: Any, values: int, points: int, step: int, imaginary: int, passes: int) -> None:
    """Do the part of `transform_lanes` after the pass of radix 2, if there is one."""
    if first_span(points) == 0:
        return
    size = step * points
    part = size // 2 if is_odd_power(points) else size
    for begin in range(0, size, part):
        _turned_passes(like, values, begin, begin + part, points, step, imaginary, passes)
        for at in range(begin, begin + part, 4 * step):
            y0r, y0i, y1r, y1i, y2r, y2i, y3r, y3i = butterfly(like, values, imaginary, at, step)
            store(values, at, y0r)
            store(values, imaginary + at, y0i)
            store(values, at + step, y1r)
            store(values, imaginary + at + step, y1i)
            store(values, at + 2 * step, y2r)
            store(values, imaginary + at + 2 * step, y2i)
            store(values, at + 3 * step, y3r)
            store(values, imaginary + at + 3 * step, y3i)


@compiled
def transform_but_last(like: Any, values: int, points: int, step: int, imaginary: int, passes: int) -> None:
    """Do all passes except the last, whose butterflies each combine four neighbours without twiddles."""
    if is_odd_power(points):
        _halve(like, values, points, step, imaginary, passes)
    size = step * points
    part = size // 2 if is_odd_power(points) else size
    for begin in range(0, size, part):
        _turned_passes(like, values, begin, begin + part, points, step, imaginary, passes)


@compiled
def _turned_passes(like, values, begin, end, points, step, imaginary, passes) -> None:
    """Do the radix-4 passes except the last, from `begin` to `end`: all, or one of the halves that the pass of radix 2
    leaves, which then fits into a cache where both do not."""
    table = points if is_odd_power(points) else 0
    span = first_span(points)
    while span > 1:
        for j in range(span):
            # A range with this step would need a division to find its length.
            at = begin + step * j
            while at < end:
                _turned_butterfly(like, values, imaginary, at, step * span, passes, table + 6 * j)
                at += 4 * step * span
        table += 6 * span
        span //= 4


@compiled
def _halve(like, values, points, step, imaginary, passes) -> None:
    """Do the pass of radix 2."""
    half = points // 2
    for j in range(half):
        at, to = step * j, step * (j + half)
        ar, ai = load_as(like, values, at), load_as(like, values, imaginary + at)
        br, bi = load_as(like, values, to), load_as(like, values, imaginary + to)
        store(values, at, add(ar, br))
        store(values, imaginary + at, add(ai, bi))
        store_turned(values, imaginary, to, subtract(ar, br), subtract(ai, bi), passes, 2 * j)


@compiled
def butterfly(like: Any, values: int, imaginary: int, at: int, step: int):
    """Transform four points that are `step` apart; returns the real and imaginary part of each."""
    p1, p2, p3 = at + step, at + 2 * step, at + 3 * step
    ar, ai = load_as(like, values, at), load_as(like, values, imaginary + at)
    br, bi = load_as(like, values, p1), load_as(like, values, imaginary + p1)
    cr, ci = load_as(like, values, p2), load_as(like, values, imaginary + p2)
    dr, di = load_as(like, values, p3), load_as(like, values, imaginary + p3)
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
def _turned_butterfly(like, values, imaginary, at, step, passes, t) -> None:
    y0r, y0i, y1r, y1i, y2r, y2i, y3r, y3i = butterfly(like, values, imaginary, at, step)
    store(values, at, y0r)
    store(values, imaginary + at, y0i)
    store_turned(values, imaginary, at + step, y1r, y1i, passes, t)
    store_turned(values, imaginary, at + 2 * step, y2r, y2i, passes, t + 2)
    store_turned(values, imaginary, at + 3 * step, y3r, y3i, passes, t + 4)


@compiled
def store_turned(values, imaginary, at, re, im, passes, t) -> None:
    """Store a point, multiplied by the twiddle factor at `t`."""
    # Loading the factors just before use keeps registers free until then.
    c, s = load_broadcast_as(re, passes, t), load_broadcast_as(re, passes, t + 1)
    store(values, at, multiply_subtract(im, s, multiply(re, c)))
    store(values, imaginary + at, multiply_add(im, c, multiply(re, s)))
