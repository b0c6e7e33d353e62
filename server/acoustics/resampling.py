"""Impulse responses at another sample rate.

A response is resampled so that a signal at the new rate, convolved with it, sounds as one at the old rate did: its
samples are scaled by the ratio of the rates, because there are more of them. Sample 0 remains the moment of emission.
soxr's linear-phase filter keeps everything up to 0.91 of the lower of both Nyquist frequencies within 0.01 dB, and
lets nothing beyond it through (-130 dB). The ratio is exact: nothing changes its pitch.
"""

import math

import numpy as np
import numpy.typing as npt
import soxr

_QUALITY = "VHQ"
_REACH_S = 0.006
"""How far a sample reaches to either side at the lower rate, of rates from 22 kHz on: beyond, less than -100 dB."""
_REACH_AT_HZ = 22_050


def resampled_length(samples: int, from_hz: int, to_hz: int) -> int:
    """The length of a response of so many samples at another rate."""
    return -(-samples * to_hz // from_hz)


def samples_before(samples: int, from_hz: int, to_hz: int) -> int:
    """How many samples at the rate `from_hz` decide the first `samples` at `to_hz`, those that they reach into
    included."""
    reach = math.ceil(_REACH_S * _REACH_AT_HZ / min(from_hz, to_hz) * from_hz)
    return -(-samples * from_hz // to_hz) + reach


def resample_responses(responses: npt.NDArray[np.float32], from_hz: int, to_hz: int) -> npt.NDArray[np.float32]:
    """Return responses (B, channel, sample) at the rate `to_hz` in place of `from_hz`, in a new array."""
    count, channels, samples = responses.shape
    length = resampled_length(samples, from_hz, to_hz)
    resampled = np.zeros((count, channels, length), np.float32)
    scale = np.float32(from_hz / to_hz)
    for response, other in zip(responses, resampled, strict=True):
        made = soxr.resample(response.T, from_hz, to_hz, quality=_QUALITY)[:length].T
        np.multiply(made, scale, out=other[:, : made.shape[1]])
    return resampled
