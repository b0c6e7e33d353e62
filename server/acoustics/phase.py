"""Phase for a predicted binaural spectrogram: what is known is used, the rest is noise with the right correlation
between the ears.

A field knows the phase of the direct sound and of some early reflections, and cannot know that of late reverberation.
It says how much it knows: `certainty` is the length of the mean phasor, 1 where the phase is determined and 0 where it
is anybody's guess. A bin is then the known phasor plus frozen noise carrying the remaining energy:

    S = M (R exp(i phi) + sqrt(1 - R**2) N)

The noise is the transform of one white signal per scene, the same for every pose, so that responses of neighbouring
poses crossfade without combing. Its right ear is mixed so that the whole has the predicted complex interaural
coherence.

Axes: (..., ear, frequency, frame), ear 0 = left; coherence (..., frequency, frame), E[S_left conj(S_right)] over the
magnitudes.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec

Real = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

_UNDECIDED = 1e-6


@dataclass(frozen=True)
class FrozenNoise:
    """Two independent white signals as spectrograms (2, frequency, frame) of unit expected power."""

    spectrogram: Complex

    @classmethod
    def from_signal(cls, codec: Codec, signal: npt.NDArray[np.floating]) -> "FrozenNoise":
        """`signal` is (2, sample), of unit variance."""
        scale = 1 / np.sqrt(codec.window_energy)
        return cls((codec.transform(signal.astype(np.float64)) * scale).astype(np.complex64))


def compose(magnitude: Real, known_phase: Real, certainty: Real, coherence: Complex, noise: FrozenNoise) -> Complex:
    """(..., 2, frequency, frame) complex spectrogram.

    `known_phase` and `certainty` cover the first frames only, as many as they have; all later ones are pure noise.
    """
    known_frames = certainty.shape[-1]
    spectrogram = np.empty(magnitude.shape, dtype=np.complex64)
    spectrogram[..., known_frames:] = _correlated(noise.spectrogram[..., known_frames:], coherence[..., known_frames:])
    known = certainty * np.exp(1j * known_phase)
    unknown = np.sqrt(np.maximum(1 - certainty**2, 0))
    # The known parts bring a coherence of their own; the noise makes up the difference.
    rest = coherence[..., :known_frames] - known[..., 0, :, :] * np.conj(known[..., 1, :, :])
    share = np.maximum(unknown[..., 0, :, :] * unknown[..., 1, :, :], _UNDECIDED)
    early_noise = _correlated(noise.spectrogram[..., :known_frames], rest / share)
    spectrogram[..., :known_frames] = known + unknown * early_noise
    spectrogram *= magnitude
    return spectrogram


def _correlated(noise: Complex, coherence: Complex) -> Complex:
    """(..., 2, frequency, frame) noise of unit power whose ears have the given coherence, limited to what is
    possible."""
    strength = np.abs(coherence)
    coherence = (coherence / np.maximum(strength, 1)).astype(np.complex64)
    left = np.broadcast_to(noise[0], coherence.shape)
    right = np.conj(coherence) * noise[0] + np.sqrt(np.maximum(1 - np.abs(coherence) ** 2, 0)) * noise[1]
    return np.stack([left, right], axis=-3).astype(np.complex64)
