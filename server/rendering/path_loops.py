"""The sample loops of the direct path, compiled.

Outputs of `filter_block` are a multiple of `TILE` long, so that its accumulators stay in registers.
"""

import numpy as np
import numpy.typing as npt

from server.kernels import odd_fft
from server.kernels.compiled import compiled_in_place
from server.kernels.simd import (
    broadcast,
    lanes,
    load,
    load_broadcast,
    load_short_int,
    multiply,
    multiply_add,
    multiply_subtract,
    prefetch,
    store,
    subtract,
    sum_each,
)
from server.rendering.fractional_delay import PHASES, TAPS

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]

_wide = lanes(16)
_load_wide, _broadcast_wide = _wide.load, _wide.load_broadcast

TILE = 64
_ROW = 2 * TAPS
_LINE_BYTES = 64


@compiled_in_place
def filter_block(samples: FloatArray, taps: FloatArray, out: FloatArray) -> None:
    """Filter a block: out[i] = sum over k of taps[k] samples[i + len(taps) - 1 - k]."""
    x, h, y = samples.ctypes.data, taps.ctypes.data, out.ctypes.data
    last = taps.size - 1
    zero = broadcast(np.float32(0))
    for i in range(0, out.size, TILE):
        a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = zero
        for k in range(taps.size):
            tap = load_broadcast(h, k)
            at = i + last - k
            a0 = multiply_add(tap, load(x, at), a0)
            a1 = multiply_add(tap, load(x, at + 8), a1)
            a2 = multiply_add(tap, load(x, at + 16), a2)
            a3 = multiply_add(tap, load(x, at + 24), a3)
            a4 = multiply_add(tap, load(x, at + 32), a4)
            a5 = multiply_add(tap, load(x, at + 40), a5)
            a6 = multiply_add(tap, load(x, at + 48), a6)
            a7 = multiply_add(tap, load(x, at + 56), a7)
        store(y, i, a0)
        store(y, i + 8, a1)
        store(y, i + 16, a2)
        store(y, i + 24, a3)
        store(y, i + 32, a4)
        store(y, i + 40, a5)
        store(y, i + 48, a6)
        store(y, i + 56, a7)


def transform_tables(size: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The tables that `transform` and `synthesise` need for `size` bins: twist, passes, lanes."""
    tables = odd_fft.tables(size)
    return tables.twist, tables.passes, tables.lanes


@compiled_in_place
def transform(samples: FloatArray, twist: FloatArray, passes: FloatArray, lanes: FloatArray, bins: FloatArray) -> None:
    """Write the spectrum (2, f) of the first 2 f samples to `bins`."""
    size = bins.shape[1]
    first = int(samples.ctypes.data)
    second, to = first + 4 * size, int(bins.ctypes.data)
    tables = int(twist.ctypes.data), int(passes.ctypes.data), int(lanes.ctypes.data)
    odd_fft.forward(first, second, to, to, 8, size, size, *tables)


@compiled_in_place
def synthesise(mix: FloatArray, twist: FloatArray, passes: FloatArray, lanes: FloatArray, out: FloatArray) -> None:
    """Transform a spectrum (2, f) back and write the second half (f,) of its window to `out`. The spectrum is
    overwritten."""
    size = mix.shape[1]
    bins = int(mix.ctypes.data)
    to = int(out.ctypes.data)
    tables = int(twist.ctypes.data), int(passes.ctypes.data), int(lanes.ctypes.data)
    odd_fft.inverse(bins, 8, size, bins, to, size, *tables)


@compiled_in_place
def accumulate(bins: FloatArray, filters: FloatArray, mix: FloatArray) -> None:
    """Multiply two spectra (2, f) and add the product to a third."""
    size = bins.shape[1]
    x, h, y = bins.ctypes.data, filters.ctypes.data, mix.ctypes.data
    for n in range(0, size, 8):
        xr, xi, hr, hi = load(x, n), load(x, size + n), load(h, n), load(h, size + n)
        store(y, n, multiply_subtract(xi, hi, multiply_add(xr, hr, load(y, n))))
        store(y, size + n, multiply_add(xi, hr, multiply_add(xr, hi, load(y, size + n))))


@compiled_in_place
def accumulate_change(bins: FloatArray, before: FloatArray, after: FloatArray, mix: FloatArray) -> None:
    """Multiply a spectrum by the difference of two filters, `before` minus `after`, and add the product to the mix."""
    size = bins.shape[1]
    x, h, g, y = bins.ctypes.data, before.ctypes.data, after.ctypes.data, mix.ctypes.data
    for n in range(0, size, 8):
        xr, xi = load(x, n), load(x, size + n)
        hr, hi = subtract(load(h, n), load(g, n)), subtract(load(h, size + n), load(g, size + n))
        store(y, n, multiply_subtract(xi, hi, multiply_add(xr, hr, load(y, n))))
        store(y, size + n, multiply_add(xi, hr, multiply_add(xr, hi, load(y, size + n))))


@compiled_in_place
def read_at(
    line: FloatArray, first: IntArray, row: IntArray, share: FloatArray, table: FloatArray, out: FloatArray
) -> None:
    """Interpolate a delay line: out[i] = the product of line[first[i] :] with the sinc that lies `share[i]` of the way
    from row `row[i]` of the table to the next. The length of `out` is a multiple of 8."""
    x, t, y = line.ctypes.data, table.ctypes.data, out.ctypes.data
    f, r, s = first.ctypes.data, row.ctypes.data, share.ctypes.data
    for i in range(0, out.size, 8):
        sums = sum_each(
            (
                _products(x, t, f, r, s, i),
                _products(x, t, f, r, s, i + 1),
                _products(x, t, f, r, s, i + 2),
                _products(x, t, f, r, s, i + 3),
                _products(x, t, f, r, s, i + 4),
                _products(x, t, f, r, s, i + 5),
                _products(x, t, f, r, s, i + 6),
                _products(x, t, f, r, s, i + 7),
            )
        )
        store(y, i, sums)


@compiled_in_place
def _products(x: int, t: int, f: int, r: int, s: int, i: int):  # type: ignore[no-untyped-def]
    """The products of one sample with its interpolated sinc, in sixteen lanes that are still to be summed."""
    at, row, share = load_short_int(f, i), load_short_int(r, i) * _ROW, _broadcast_wide(s, i)
    total = multiply(multiply_add(share, _load_wide(t, row + TAPS), _load_wide(t, row)), _load_wide(x, at))
    for k in range(16, TAPS, 16):
        tap = multiply_add(share, _load_wide(t, row + TAPS + k), _load_wide(t, row + k))
        total = multiply_add(tap, _load_wide(x, at + k), total)
    return total


@compiled_in_place
def locate(
    start: float,
    ring: int,
    a0: float,
    a1: float,
    a2: float,
    a3: float,
    first: IntArray,
    row: IntArray,
    share: FloatArray,
) -> None:
    """Compute the arguments with which `read_at` reads sample i at (start + i - delay) modulo `ring`, where the delay
    is the polynomial with coefficients `a` at i + 1."""
    turn, last = float(ring), np.int32(PHASES - 1)
    for i in range(first.size):
        # 32 bits, because processors convert several such numbers at once, and longer ones one by one.
        n = float(np.int32(i))
        u = n + 1.0
        at = start + n - (a0 + u * (a1 + u * (a2 + u * a3)))
        at += 0.0 if at >= 0.0 else turn
        whole = np.int32(at)
        phase = (at - whole) * PHASES
        step = np.int32(phase)
        step = min(last, step)
        first[i] = whole
        row[i] = step
        share[i] = phase - step


@compiled_in_place
def series_exponential(cepstra: FloatArray, reciprocals: FloatArray, sums: FloatArray, taps: FloatArray) -> None:
    """Compute the taps (2, n) of minimum-phase filters from their folded cepstra c: h = exp(c) as a power series.

    `cepstra` (2, n + 8) holds c[0] and then k c[k], `reciprocals` (n,) 1 and then 1 / k; `sums` (2, n + 8) is a buffer
    for n h[n] = sum over k of k c[k] h[n - k].

    Each tap needs all before it. Therefore eight are found one after the other, in registers, and then added to the
    sums of all later ones, in vectors.
    """
    count = taps.shape[1]
    whole = count // 8 * 8
    sums[:] = 0
    for ear in range(2):
        sums[ear, 0] = np.exp(cepstra[ear, 0])
    for begin in range(0, whole, 8):
        for ear in range(2):  # the chains of both ears are computed side by side
            _find_eight(cepstra[ear], reciprocals[begin:], sums[ear, begin:], taps[ear, begin:])
        for ear in range(2):
            _add_eight(cepstra[ear], taps[ear, begin:], sums[ear, begin:], count - begin)
    for n in range(whole, count):
        for ear in range(2):
            for k in range(whole, n):
                sums[ear, n] += cepstra[ear, n - k] * taps[ear, k]
            taps[ear, n] = sums[ear, n] * reciprocals[n]


@compiled_in_place
def _find_eight(c: FloatArray, r: FloatArray, s: FloatArray, h: FloatArray) -> None:
    """Find eight taps h from the sums s over all before them."""
    h0 = s[0] * r[0]
    h1 = (s[1] + c[1] * h0) * r[1]
    h2 = (s[2] + c[2] * h0 + c[1] * h1) * r[2]
    h3 = (s[3] + c[3] * h0 + c[2] * h1 + c[1] * h2) * r[3]
    h4 = (s[4] + c[4] * h0 + c[3] * h1 + c[2] * h2 + c[1] * h3) * r[4]
    h5 = (s[5] + c[5] * h0 + c[4] * h1 + c[3] * h2 + c[2] * h3 + c[1] * h4) * r[5]
    h6 = (s[6] + c[6] * h0 + c[5] * h1 + c[4] * h2 + c[3] * h3 + c[2] * h4 + c[1] * h5) * r[6]
    h7 = (s[7] + c[7] * h0 + c[6] * h1 + c[5] * h2 + c[4] * h3 + c[3] * h4 + c[2] * h5 + c[1] * h6) * r[7]
    h[0], h[1], h[2], h[3] = h0, h1, h2, h3
    h[4], h[5], h[6], h[7] = h4, h5, h6, h7


@compiled_in_place
def _add_eight(c: FloatArray, h: FloatArray, s: FloatArray, count: int) -> None:
    """Add what eight taps h are worth to the sums s of the taps after them, up to the next whole vector after
    `count`."""
    taps, cepstrum, sums = h.ctypes.data, c.ctypes.data, s.ctypes.data
    h0, h1, h2, h3 = load_broadcast(taps, 0), load_broadcast(taps, 1), load_broadcast(taps, 2), load_broadcast(taps, 3)
    h4, h5, h6, h7 = load_broadcast(taps, 4), load_broadcast(taps, 5), load_broadcast(taps, 6), load_broadcast(taps, 7)
    for n in range(8, count, 8):
        total = multiply_add(h0, load(cepstrum, n), load(sums, n))
        total = multiply_add(h1, load(cepstrum, n - 1), total)
        total = multiply_add(h2, load(cepstrum, n - 2), total)
        total = multiply_add(h3, load(cepstrum, n - 3), total)
        total = multiply_add(h4, load(cepstrum, n - 4), total)
        total = multiply_add(h5, load(cepstrum, n - 5), total)
        total = multiply_add(h6, load(cepstrum, n - 6), total)
        total = multiply_add(h7, load(cepstrum, n - 7), total)
        store(sums, n, total)


@compiled_in_place
def fetch(samples: FloatArray, begin: int, end: int) -> None:
    """Prefetch samples that are read soon. The arrays of one slot are so short that they end before a processor
    recognises them as streams."""
    address = int(samples.ctypes.data)
    for at in range(address + 4 * begin, address + 4 * end, _LINE_BYTES):
        prefetch(at)


@compiled_in_place
def scale(samples: FloatArray, start: float, end: float, ramp: FloatArray) -> None:
    """Multiply samples by a gain that goes from `start` to `end` along `ramp` (b,); samples beyond the ramp stay
    unchanged."""
    first, rise = np.float32(start), np.float32(end - start)
    for i in range(ramp.size):
        samples[i] *= first + rise * ramp[i]


@compiled_in_place
def copy(values: FloatArray, out: FloatArray) -> None:
    for i in range(out.size):
        out[i] = values[i]


@compiled_in_place
def copy_spectrum(values: FloatArray, out: FloatArray) -> None:
    """Copy a spectrum (2, f) to `out`."""
    for part in range(2):
        copy(values[part], out[part])


@compiled_in_place
def multiply_by(samples: FloatArray, factor: float) -> None:
    scalar = np.float32(factor)
    for i in range(samples.size):
        samples[i] *= scalar


@compiled_in_place
def weight(values: FloatArray, weights: FloatArray) -> None:
    for i in range(values.size):
        values[i] *= weights[i]


@compiled_in_place
def add_block(block: FloatArray, out: FloatArray) -> None:
    for i in range(out.size):
        out[i] += block[i]


@compiled_in_place
def add_scaled(values: FloatArray, factor: float, out: FloatArray) -> None:
    scalar = np.float32(factor)
    for i in range(out.size):
        out[i] += scalar * values[i]


@compiled_in_place
def add_fading(block: FloatArray, fade: FloatArray, out: FloatArray) -> None:
    """Add a block to `out`, faded out as `fade` rises."""
    for i in range(out.size):
        out[i] += (np.float32(1) - fade[i]) * block[i]


@compiled_in_place
def add_faded(before: FloatArray, after: FloatArray, fade: FloatArray, out: FloatArray) -> None:
    for i in range(out.size):
        out[i] += before[i] + fade[i] * (after[i] - before[i])


@compiled_in_place
def shift(samples: FloatArray, by: int, count: int) -> None:
    """Set samples[:count] to the values `by` samples further on; the two ranges may overlap."""
    for i in range(count):
        samples[i] = samples[i + by]


@compiled_in_place
def interpolate_reversed(row: FloatArray, share: float, taps: FloatArray) -> None:
    """The taps `share` of the way from a row of the table to the next, in reverse order as `filter_block` needs
    them."""
    scalar = np.float32(share)
    for k in range(TAPS):
        taps[TAPS - 1 - k] = row[k] + scalar * row[TAPS + k]


@compiled_in_place
def is_silent(block: FloatArray) -> bool:
    """Whether all samples are zero, of either sign."""
    bits = block.view(np.int32)
    some = np.int32(0)
    for i in range(bits.size):
        some |= bits[i]
    # Doubling drops the sign bit.
    return bool(np.int32(some << np.int32(1)) == 0)
