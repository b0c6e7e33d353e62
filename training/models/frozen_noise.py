"""The frozen noise behind a scene's late reverberation: white, and as even as a signal can be.

The spectrogram of plain white noise fluctuates by 5.6 dB (Rayleigh). Those fluctuations would be imprinted on every
response of the scene, on top of the levels the field predicts. Griffin and Lim's iteration (1984) towards a constant
magnitude keeps the noise random in phase and nearly takes them away, so a response has the levels that were asked for.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec


def even_noise(codec: Codec, rng: np.random.Generator, *, iterations: int = 200) -> npt.NDArray[np.float32]:
    """(2, sample) independent noise signals of unit power for the two ears."""
    signal = rng.standard_normal((2, codec.samples))
    for _ in range(iterations):
        spectrogram = codec.transform(signal)
        signal = codec.synthesise(spectrogram / np.maximum(np.abs(spectrogram), 1e-9))
    power = np.mean(np.abs(codec.transform(signal)) ** 2) / codec.window_energy
    return (signal / np.sqrt(power)).astype(np.float32)
