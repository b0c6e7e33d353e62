"""Eight complex transforms at once, one per lane: the Fourier transform for compiled code.

`values` are (2, n, 8) float32 at an address: real parts, then imaginary parts, of n points in eight lanes. Radix 4,
decimation in frequency, in place; what comes out is in an order of its own (digits reversed), which callers undo where
they move data anyway. With real and imaginary parts exchanged on both sides it is the inverse, n times too large.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from server.acoustics.simd import (
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
from server.compiled import compiled


@cache
def twiddles(points: int) -> npt.NDArray[np.float32]:
    """Of each pass in turn: six floats per butterfly of radix 4, two of radix 2; `points` is a power of two."""
    passes = [np.zeros(0)]
    if _is_odd_power(points):
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
    """(points,) the frequency that each position holds after the transform."""
    frequencies, length = np.arange(1), 1
    while length < points:
        radix = 2 if length * 2 == points and _is_odd_power(points) else 4
        frequencies = np.concatenate([frequencies * radix + digit for digit in range(radix)])
        length *= radix
    return frequencies


@compiled
def first_span(points: int) -> int:
    """Of the radix-4 passes: a quarter of what is left to transform after the pass of radix 2, where there is one."""
    return points // 8 if _is_odd_power(points) else points // 4


@compiled
def _is_odd_power(points: int) -> bool:
    power = 0
    while points > 1:
        points >>= 1
        power += 1
    return power % 2 == 1


@compiled
def transform_lanes(values: int, points: int, passes: int) -> None:
    """Forward, in place; `passes` is the address of `twiddles(points)`."""
    size = LANES * points
    table = 0
    span = first_span(points)
    if _is_odd_power(points):
        half = points // 2
        for j in range(half):
            at, to = 8 * j, 8 * (j + half)
            ar, ai, br, bi = load(values, at), load(values, size + at), load(values, to), load(values, size + to)
            store(values, at, add(ar, br))
            store(values, size + at, add(ai, bi))
            dr, di = subtract(ar, br), subtract(ai, bi)
            c, s = load_broadcast(passes, table + 2 * j), load_broadcast(passes, table + 2 * j + 1)
            store(values, to, multiply_subtract(di, s, multiply(dr, c)))
            store(values, size + to, multiply_add(di, c, multiply(dr, s)))
        table += 2 * half
    while span > 0:
        for j in range(span):
            t = table + 6 * j
            c1, s1 = load_broadcast(passes, t), load_broadcast(passes, t + 1)
            c2, s2 = load_broadcast(passes, t + 2), load_broadcast(passes, t + 3)
            c3, s3 = load_broadcast(passes, t + 4), load_broadcast(passes, t + 5)
            for group in range(j, points, 4 * span):
                p0, p1 = 8 * group, 8 * (group + span)
                p2, p3 = 8 * (group + 2 * span), 8 * (group + 3 * span)
                ar, ai, br, bi = load(values, p0), load(values, size + p0), load(values, p1), load(values, size + p1)
                cr, ci, dr, di = load(values, p2), load(values, size + p2), load(values, p3), load(values, size + p3)
                er, ei, fr, fi = add(ar, cr), add(ai, ci), subtract(ar, cr), subtract(ai, ci)
                gr, gi = add(br, dr), add(bi, di)
                hr, hi = subtract(bi, di), subtract(dr, br)  # -i (b - d)
                store(values, p0, add(er, gr))
                store(values, size + p0, add(ei, gi))
                yr, yi = add(fr, hr), add(fi, hi)
                store(values, p1, multiply_subtract(yi, s1, multiply(yr, c1)))
                store(values, size + p1, multiply_add(yi, c1, multiply(yr, s1)))
                yr, yi = subtract(er, gr), subtract(ei, gi)
                store(values, p2, multiply_subtract(yi, s2, multiply(yr, c2)))
                store(values, size + p2, multiply_add(yi, c2, multiply(yr, s2)))
                yr, yi = subtract(fr, hr), subtract(fi, hi)
                store(values, p3, multiply_subtract(yi, s3, multiply(yr, c3)))
                store(values, size + p3, multiply_add(yi, c3, multiply(yr, s3)))
        table += 6 * span
        span //= 4
