"""Loudness of programmes by ITU-R BS.1770-4: K-weighting, and gated blocks of 0.4 s.

The two filters are those of the recommendation, which lists coefficients for 48 kHz only. For other rates they are
designed anew from the analogue filters behind them.
"""

import math

import numpy as np
import numpy.typing as npt
import scipy.signal

_BLOCK_S = 0.4
_STEP_S = 0.1
_ABSOLUTE_LUFS = -70.0
_RELATIVE_LU = -10.0
_OFFSET_LU = -0.691
_SHELF_HZ, _SHELF_DB, _SHELF_Q = 1681.974450955533, 3.999843853973347, 0.7071752369554196
_SHELF_POWER = 0.4996667741545416
_HIGH_PASS_HZ, _HIGH_PASS_Q = 38.13547087602444, 0.5003270373238773

_Floats = npt.NDArray[np.float64]


def loudness_lufs(samples: npt.NDArray[np.floating], sample_rate: float) -> float:
    """The integrated loudness of samples (channel, n), of one channel or two; minus infinity if all is below the
    absolute gate, or shorter than a block."""
    powers = _block_powers(samples, sample_rate)
    loud = powers[_lufs(powers) > _ABSOLUTE_LUFS]
    if not len(loud):
        return -math.inf
    gate = float(_lufs(loud.mean())) + _RELATIVE_LU
    return float(_lufs(loud[_lufs(loud) > gate].mean()))


def k_weighted(samples: npt.NDArray[np.floating], sample_rate: float) -> _Floats:
    return np.asarray(scipy.signal.sosfilt(_k_weighting(sample_rate), np.asarray(samples, np.float64), axis=-1))


def _k_weighting(sample_rate: float) -> _Floats:
    """Second-order sections: the shelf that stands for a head, and the high-pass."""
    k = math.tan(math.pi * _SHELF_HZ / sample_rate)
    gain = 10 ** (_SHELF_DB / 20)
    band = gain**_SHELF_POWER
    a0 = 1 + k / _SHELF_Q + k**2
    shelf = [gain + band * k / _SHELF_Q + k**2, 2 * (k**2 - gain), gain - band * k / _SHELF_Q + k**2]
    shelf += [a0, 2 * (k**2 - 1), 1 - k / _SHELF_Q + k**2]
    k = math.tan(math.pi * _HIGH_PASS_HZ / sample_rate)
    b0 = 1 + k / _HIGH_PASS_Q + k**2
    # The recommendation's numerator is 1, -2, 1 beside a denominator that begins with 1.
    high_pass = [1, -2, 1, 1, 2 * (k**2 - 1) / b0, (1 - k / _HIGH_PASS_Q + k**2) / b0]
    return np.array([np.array(shelf) / a0, high_pass])


def _block_powers(samples: npt.NDArray[np.floating], sample_rate: float) -> _Floats:
    """(block,) power of the weighted sound, summed over channels."""
    squares = np.square(k_weighted(samples, sample_rate)).sum(axis=0)
    block, step = round(_BLOCK_S * sample_rate), round(_STEP_S * sample_rate)
    if len(squares) < block:
        return np.zeros(0)
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    starts = np.arange(0, len(squares) - block + 1, step)
    return np.asarray(np.maximum(0.0, sums[starts + block] - sums[starts]) / block)


def _lufs(power: npt.NDArray[np.floating] | np.floating) -> _Floats:
    with np.errstate(divide="ignore"):
        return np.asarray(_OFFSET_LU + 10 * np.log10(power))
