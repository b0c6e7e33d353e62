"""Sounds of a listening test: music convolved with a response, anchors, and equal loudness.

Sounds are (channel, sample) with two channels, all of the same length.
"""

import numpy as np
import numpy.typing as npt
import scipy.signal

from training.listening.loudness import loudness_lufs

TARGET_LUFS = -23.0
"""Loudness of every sound (EBU R 128), unless one would then come near full scale."""
_HIGHEST_PEAK = 10 ** (-1 / 20)
_FADE_S = 0.05
_STOP_DB = 60.0
_BAND = 1 / 7
"""Width of a low-pass filter's transition band, relative to its edge: 3.5 to 4 kHz, as in ITU-R BS.1534."""

Sound = npt.NDArray[np.float64]


def auralised(music: npt.NDArray[np.floating], response: npt.NDArray[np.floating], samples: int, rate: int) -> Sound:
    """Music (n,) heard through a response (channel, m), faded out at its end. One microphone is heard by both ears."""
    heard = scipy.signal.oaconvolve(music[None], np.asarray(response, np.float64), axes=-1)[:, :samples]
    sound = np.zeros((2, samples))
    sound[:, : heard.shape[1]] = heard
    fade = round(_FADE_S * rate)
    sound[:, -fade:] *= 0.5 + 0.5 * np.cos(np.pi * np.arange(fade) / fade)
    return sound


def has_low_pass(edge_hz: float, rate: float) -> bool:
    """Whether a filter with this edge removes anything at this rate."""
    return edge_hz * (1 + _BAND) < rate / 2


def low_passed(sound: Sound, edge_hz: float, rate: float) -> Sound:
    """The sound without what lies above the edge, without delay."""
    width_hz = edge_hz * _BAND
    taps, beta = scipy.signal.kaiserord(_STOP_DB, width_hz / (rate / 2))
    kernel = scipy.signal.firwin(taps | 1, edge_hz + width_hz / 2, window=("kaiser", beta), fs=rate)
    return np.asarray(scipy.signal.oaconvolve(sound, kernel[None], mode="same", axes=-1))


def matched(sound: Sound, lufs: float, rate: float) -> Sound:
    """The sound at this loudness."""
    return np.asarray(sound * 10 ** ((lufs - loudness_lufs(sound, rate)) / 20))


def common_loudness(peaks_at_target: npt.ArrayLike) -> float:
    """The loudness at which sounds do not clip that have these peaks at TARGET_LUFS."""
    excess_db = 20 * np.log10(np.max(peaks_at_target) / _HIGHEST_PEAK)
    return TARGET_LUFS - max(0.0, float(np.ceil(10 * excess_db) / 10))
