"""What `path_loops` does, where there is no compiler."""

import numpy as np
import numpy.typing as npt
import scipy.fft

from server.rendering.fractional_delay import PHASES, TAPS

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

TILE = 64
_ALIASING = 8
"""How many times longer than the filter the circle of its transform is."""


def filter_block(samples: FloatArray, taps: FloatArray, out: FloatArray) -> None:
    out[:] = np.convolve(samples[: out.size + taps.size - 1], taps, "valid")


def filter_twice(
    samples: FloatArray, first: FloatArray, second: FloatArray, out_first: FloatArray, out_second: FloatArray
) -> None:
    filter_block(samples, first, out_first)
    filter_block(samples, second, out_second)


def read_at(
    line: FloatArray, first: IntArray, row: IntArray, share: FloatArray, table: FloatArray, out: FloatArray
) -> None:
    rows = table[row]
    taps = rows[:, :TAPS] + share[:, None] * rows[:, TAPS:]
    np.vecdot(taps, np.lib.stride_tricks.sliding_window_view(line, TAPS)[first], out=out)


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
    u = np.arange(1.0, first.size + 1)
    at = start + u - 1 - (a0 + u * (a1 + u * (a2 + u * a3)))
    at += ring * (at < 0)
    first[:] = at
    phase = (at - first) * PHASES
    np.minimum(phase, PHASES - 1, out=row, casting="unsafe")
    share[:] = phase - row


def series_exponential(cepstra: FloatArray, reciprocals: FloatArray, _sums: FloatArray, taps: FloatArray) -> None:
    count = taps.shape[1]
    n_fft = _ALIASING * scipy.fft.next_fast_len(count, real=True)
    spectra = scipy.fft.rfft(cepstra[:, :count] * reciprocals, n_fft)
    taps[:] = scipy.fft.irfft(np.exp(spectra), n_fft)[:, :count]


def scale(samples: FloatArray, start: float, end: float, ramp: FloatArray) -> None:
    samples[: ramp.size] *= np.float32(start) + np.float32(end - start) * ramp


def add_block(block: FloatArray, out: FloatArray) -> None:
    out += block[: out.size]


def add_scaled(values: FloatArray, factor: float, out: FloatArray) -> None:
    out += np.float32(factor) * values[: out.size]


def add_faded(before: FloatArray, after: FloatArray, fade: FloatArray, out: FloatArray) -> None:
    size = out.size
    out += before[:size] + fade * (after[:size] - before[:size])


def shift(samples: FloatArray, by: int, count: int) -> None:
    samples[:count] = samples[by : by + count]


def interpolate_reversed(row: FloatArray, share: float, taps: FloatArray) -> None:
    taps[::-1] = row[:TAPS] + np.float32(share) * row[TAPS:]


def is_silent(block: FloatArray) -> bool:
    return not block.any()
