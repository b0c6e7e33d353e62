"""Mel-frequency cepstral coefficients (Davis and Mermelstein, IEEE Trans. ASSP 28, 357, 1980), as in speech
recognition: log energies of triangular filters that are evenly spaced on the mel scale, and their cosine transform.

Libraries that offer them depend on whole toolkits, and a filter bank and two transforms suffice here.
"""

import numpy as np
import numpy.typing as npt
from scipy.fft import dct, rfft
from scipy.signal.windows import hann

_Floats = npt.NDArray[np.float64]

FILTERS = 40
COEFFICIENTS = 13
WINDOW_S = 0.025
STEP_S = 0.010
_FLOOR = 1e-12


def mel(frequency_hz: npt.ArrayLike) -> _Floats:
    """The mel scale: 2595 log10(1 + f / 700 Hz) (O'Shaughnessy, Speech Communication, 1987)."""
    return np.asarray(2595.0 * np.log10(1.0 + np.asarray(frequency_hz, dtype=np.float64) / 700.0))


def hertz(mels: npt.ArrayLike) -> _Floats:
    return np.asarray(700.0 * (10.0 ** (np.asarray(mels, dtype=np.float64) / 2595.0) - 1.0))


def mel_filters(sample_rate: int, n_fft: int) -> _Floats:
    """(filter, bin) weights of power: triangles with a peak of one, from the centre of the filter below to that of the
    filter above."""
    centres = hertz(np.linspace(0.0, mel(sample_rate / 2), FILTERS + 2))
    frequency = np.fft.rfftfreq(n_fft, 1 / sample_rate)
    rising = (frequency - centres[:-2, None]) / np.diff(centres)[:-1, None]
    falling = (centres[2:, None] - frequency) / np.diff(centres)[1:, None]
    return np.maximum(0.0, np.minimum(rising, falling))


def mfcc(signal: npt.ArrayLike, sample_rate: int) -> _Floats:
    """The coefficients (..., coefficient, frame) of a signal (..., sample). Frames are 25 ms long and begin every 10
    ms, the first with the signal."""
    samples = np.asarray(signal, dtype=np.float64)
    window, step = round(WINDOW_S * sample_rate), round(STEP_S * sample_rate)
    if samples.shape[-1] < window:
        raise ValueError(f"a signal of {samples.shape[-1]} samples is shorter than a window of {window}")
    n_fft = 2 ** int(np.ceil(np.log2(window)))
    frames = np.lib.stride_tricks.sliding_window_view(samples, window, axis=-1)[..., ::step, :]
    power = np.square(np.abs(rfft(frames * hann(window, sym=False), n_fft, axis=-1)))
    energies = power @ mel_filters(sample_rate, n_fft).T
    coefficients = dct(np.log(energies + _FLOOR), axis=-1, norm="ortho")[..., :COEFFICIENTS]
    return np.asarray(np.swapaxes(coefficients, -1, -2))
