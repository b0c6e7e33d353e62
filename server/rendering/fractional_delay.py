"""The table of interpolation filters that read a signal between its samples: windowed sincs for many fractions.

A row of the table reads at the fraction (row / PHASES) of a sample after tap `BEFORE` of `TAPS` samples. It has the
coefficients, then their differences to the next row, for linear interpolation between rows. Against the exact delay of
a tone the error is below -90 dB up to 0.8 and below -100 dB up to half of the Nyquist frequency.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from server.kernels.cache_lines import on_lines

TAPS = 32
"""Taps of each row: a multiple of 16, since `server.rendering.path_loops` multiplies 16 of them at once."""
assert TAPS % 16 == 0, "TAPS must be a multiple of 16"
BEFORE = TAPS // 2 - 1
AFTER = TAPS // 2
"""Number of samples after the one read that must be known."""
PHASES = 256
_KAISER_BETA = 10.0


@cache
def sinc_table() -> npt.NDArray[np.float32]:
    """Return the table (PHASES, 2 * TAPS). All listeners share one, since several would compete for the caches."""
    offset = np.arange(TAPS) - BEFORE - np.arange(PHASES + 1)[:, None] / PHASES
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1 - (offset / (TAPS / 2)) ** 2)))
    rows = np.sinc(offset) * window
    rows /= rows.sum(axis=-1, keepdims=True)
    return on_lines(np.concatenate([rows[:-1], np.diff(rows, axis=0)], axis=-1))
