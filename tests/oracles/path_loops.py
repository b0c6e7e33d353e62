"""The functions of `server.rendering.path_loops` in NumPy."""

import numpy as np
import numpy.typing as npt
import scipy.fft

from server.rendering.fractional_delay import PHASES, TAPS

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]

TILE = 64
_ALIASING = 8
"""How many times longer than the filter the circle of its transform is."""


def filter_block(samples: FloatArray, taps: FloatArray, out: FloatArray) -> None:
    out[:] = np.convolve(samples[: out.size + taps.size - 1], taps, "valid")


def transform_tables(size: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    twist = np.exp(-0.5j * np.pi * np.arange(size) / size)
    none = np.zeros(1, np.float32)
    return np.stack([twist.real, twist.imag]).astype(np.float32), none, none


def transform(
    samples: FloatArray, twist: FloatArray, _passes: FloatArray, _lanes: FloatArray, bins: FloatArray
) -> None:
    size = bins.shape[1]
    folded = samples[:size] - 1j * samples[size : 2 * size]
    spectrum = scipy.fft.fft(folded * (twist[0] + 1j * twist[1]))
    bins[0], bins[1] = spectrum.real, spectrum.imag


def synthesise(mix: FloatArray, twist: FloatArray, _passes: FloatArray, _lanes: FloatArray, out: FloatArray) -> None:
    out[:] = -(scipy.fft.ifft(mix[0] + 1j * mix[1]) * (twist[0] - 1j * twist[1])).imag


def accumulate(bins: FloatArray, filters: FloatArray, mix: FloatArray) -> None:
    mix[0] += bins[0] * filters[0] - bins[1] * filters[1]
    mix[1] += bins[0] * filters[1] + bins[1] * filters[0]


def accumulate_change(bins: FloatArray, before: FloatArray, after: FloatArray, mix: FloatArray) -> None:
    accumulate(bins, before - after, mix)


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


def fetch(_samples: FloatArray, _begin: int, _end: int) -> None:
    """For compiled loops."""


def scale(samples: FloatArray, start: float, end: float, ramp: FloatArray) -> None:
    samples[: ramp.size] *= np.float32(start) + np.float32(end - start) * ramp


def copy(values: FloatArray, out: FloatArray) -> None:
    out[:] = values[: out.size]


def copy_spectrum(values: FloatArray, out: FloatArray) -> None:
    out[:] = values


def multiply_by(samples: FloatArray, factor: float) -> None:
    samples *= np.float32(factor)


def weight(values: FloatArray, weights: FloatArray) -> None:
    values *= weights


def add_block(block: FloatArray, out: FloatArray) -> None:
    out += block[: out.size]


def add_scaled(values: FloatArray, factor: float, out: FloatArray) -> None:
    out += np.float32(factor) * values[: out.size]


def add_fading(block: FloatArray, fade: FloatArray, out: FloatArray) -> None:
    out += (1 - fade) * block


def add_faded(before: FloatArray, after: FloatArray, fade: FloatArray, out: FloatArray) -> None:
    size = out.size
    out += before[:size] + fade * (after[:size] - before[:size])


def shift(samples: FloatArray, by: int, count: int) -> None:
    samples[:count] = samples[by : by + count]


def interpolate_reversed(row: FloatArray, share: float, taps: FloatArray) -> None:
    taps[::-1] = row[:TAPS] + np.float32(share) * row[TAPS:]


def is_silent(block: FloatArray) -> bool:
    return not block.any()
