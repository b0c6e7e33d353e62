"""Mono responses without a head, made from binaural ones.

Axes: responses (B, channel, sample).
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from server.acoustics.fast_length import next_fast_length
from server.rendering.hrtf import kemar
from server.responses.binaural import mean_over_directions

_LEAST = 0.25
"""Lower limit of the head's mean gain in the equaliser: at most 12 dB are compensated."""


def binaural_to_mono(responses: npt.NDArray[np.float32], sample_rate: int) -> npt.NDArray[np.float32]:
    """Return (B, 1, sample) for responses (B, 2, sample) through the head that fields are simulated with.

    One ear is shifted in phase by 90 degrees against the other (as in matrix surround), so that energies add whether
    the ears' signals are equal, opposite or uncorrelated. The head's mean response over all directions is equalised.
    Nothing arrives earlier than at either ear.
    """
    from scipy.fft import rfft  # the import takes 0.3 s; NumPy's rfft gives other bits in single precision

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
    """Return the inverse (bin,) of the head's minimum-phase mean over all directions."""
    from scipy.fft import rfft

    mean = rfft(mean_over_directions(kemar(sample_rate)), size)
    magnitude = np.abs(mean)
    return np.asarray(mean.conj() / (magnitude * np.maximum(magnitude, _LEAST)), np.complex64)
