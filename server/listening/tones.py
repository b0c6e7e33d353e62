"""Tones that tell headphones from loudspeakers (Woods, Siegel, Traer and McDermott, 2017).

Of three tones of 200 Hz one is 6 dB quieter, and one has its channels in opposite phase. Between loudspeakers that one
nearly vanishes, and is taken for the quietest; over headphones it does not. People who name the quiet tone in five of
six trials wear headphones; of those who guess, 1.8 % do it.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from server.listening.plan import ANTIPHASE, QUIET

RATE_HZ = 48_000
TONE_S = 1.0
PAUSE_S = 0.5
_FREQUENCY_HZ = 200.0
_RAMP_S = 0.1
_LEVEL = 0.25
_QUIETER = 10 ** (-6 / 20)


def three_tones(kinds: Sequence[str]) -> npt.NDArray[np.float32]:
    """(2, sample) the tones one after the other, at RATE_HZ."""
    time_s = np.arange(round(TONE_S * RATE_HZ)) / RATE_HZ
    ramp = np.sin(0.5 * np.pi * np.minimum(1.0, np.minimum(time_s, TONE_S - time_s) / _RAMP_S)) ** 2
    tone = _LEVEL * ramp * np.sin(2 * np.pi * _FREQUENCY_HZ * time_s)
    step = round((TONE_S + PAUSE_S) * RATE_HZ)
    sound = np.zeros((2, step * (len(kinds) - 1) + len(tone)))
    for number, kind in enumerate(kinds):
        left = tone * (_QUIETER if kind == QUIET else 1.0)
        ears = np.stack([left, -left if kind == ANTIPHASE else left])
        sound[:, number * step : number * step + len(tone)] = ears
    return sound.astype(np.float32)
