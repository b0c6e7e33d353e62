"""The frozen noise behind a scene's late reverberation: white, with as even a spectrogram as a signal can have.

The spectrogram of plain white noise fluctuates by 5.6 dB (Rayleigh). These fluctuations would be imprinted on every
response of the scene, on top of the levels that the field predicts. Griffin and Lim's iteration towards a constant
magnitude, in the fast form of Perraudin, Balazs and Soendergaard (2013), nearly removes them and keeps the phase
random, so a response has the predicted levels.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from training.models.whole_transform import transform_at_once

_MOMENTUM = 0.9


def even_noise(codec: Codec, rng: np.random.Generator, *, iterations: int = 200) -> npt.NDArray[np.float32]:
    """(2, sample) independent noise signals of unit power for the two ears."""
    signal = rng.standard_normal((2, codec.samples)).astype(np.float32)
    before = spectrogram = transform_at_once(codec, signal)
    for _ in range(iterations):
        ahead = spectrogram + np.float32(_MOMENTUM) * (spectrogram - before)
        ahead /= np.maximum(np.abs(ahead), np.float32(1e-9))
        signal = codec.synthesise(ahead)
        before, spectrogram = spectrogram, transform_at_once(codec, signal)
    power = np.mean(np.abs(spectrogram) ** 2, dtype=np.float64) / codec.window_energy
    return np.asarray(signal / np.sqrt(power), np.float32)
