"""Interpolation between samples: a windowed sinc, tabulated for PHASES fractions of a sample.

A row of the table reads at the fraction (row / PHASES) of a sample after tap `BEFORE` of `TAPS` samples. The row holds
the coefficients, followed by their differences to the next row, for linear interpolation between rows. Compared with an
exact delay of a tone, the error is below -90 dB up to 0.8 of the Nyquist frequency, and below -100 dB up to half of it.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from server.kernels.cache_lines import on_lines

TAPS = 32
BEFORE = TAPS // 2 - 1
AFTER = TAPS // 2
"""How many samples after the one that is read must be known."""
PHASES = 256
_KAISER_BETA = 10.0


@cache
def sinc_table() -> npt.NDArray[np.float32]:
    """The table (PHASES, 2 * TAPS). All listeners share one: separate copies would evict each other from the caches."""
    offset = np.arange(TAPS) - BEFORE - np.arange(PHASES + 1)[:, None] / PHASES
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1 - (offset / (TAPS / 2)) ** 2)))
    rows = np.sinc(offset) * window
    rows /= rows.sum(axis=-1, keepdims=True)
    return on_lines(np.concatenate([rows[:-1], np.diff(rows, axis=0)], axis=-1))
