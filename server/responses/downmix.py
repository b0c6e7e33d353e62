"""What one ear without a head hears where a field knows two ears of one.

Axes: responses (B, channel, sample).
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from server.acoustics.fast_length import next_fast_length
from server.rendering.hrtf import kemar
from server.responses.binaural import mean_over_directions

_LEAST = 0.25
"""Of what the head does to sound from all sides, no more than 12 dB are undone."""


def binaural_to_mono(responses: npt.NDArray[np.float32], sample_rate: int) -> npt.NDArray[np.float32]:
    """(B, 1, sample) of responses (B, 2, sample) heard through the head that fields are simulated with.

    One ear is taken a quarter of a turn of phase after the other, so that energies add whether what they hear is alike,
    of opposite sign, or has nothing to do with each other (the 90 degree shift of matrix surround). What the head does
    to sound from all sides is undone. Nothing comes before it did at either ear.
    """
    from scipy.fft import rfft  # a third of a second; NumPy's gives other bits in single precision

    samples = responses.shape[-1]
    size = next_fast_length(2 * samples)
    spectra = rfft(responses, size)
    one = (spectra[:, 0] - 1j * spectra[:, 1]) / np.sqrt(2) * _equaliser(sample_rate, size)
    heard = np.fft.irfft(one, size)[:, :samples]
    begins = np.argmax(responses.any(axis=1), axis=-1)
    heard[np.arange(samples) < begins[:, None]] = 0
    return np.asarray(heard[:, None], np.float32)


@cache
def _equaliser(sample_rate: int, size: int) -> npt.NDArray[np.complex64]:
    """(bin,) the inverse of the minimum-phase mean over all directions."""
    from scipy.fft import rfft

    mean = rfft(mean_over_directions(kemar(sample_rate)), size)
    magnitude = np.abs(mean)
    return np.asarray(mean.conj() / (magnitude * np.maximum(magnitude, _LEAST)), np.complex64)
