"""Phase for a predicted binaural spectrogram: what is known is used, the rest is noise with the right correlation
between the ears.

A field knows the phase of some early reflections, and cannot know that of late reverberation. It says how much it
knows: `certainty` is the length of the mean phasor, 1 where the phase is determined and 0 where it is anybody's guess.
A bin is then the known phasor plus frozen noise carrying the remaining energy:

    S = M (R exp(i phi) + sqrt(1 - R**2) N)

The noise is the transform of one white signal per scene. It stands still in time, whatever the pose: a field's frames
count from the moment sound arrives, so their levels are delayed to the time of emission before they meet the noise, and
only the known part moves with the emitter. Responses of neighbouring poses therefore crossfade without combing. The
noise of the right ear is mixed so that the whole has the predicted complex interaural coherence.

Axes: (..., ear, frequency, frame), ear 0 = left; coherence (..., frequency, frame), E[S_left conj(S_right)] over the
magnitudes.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec

Real = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]
Number = TypeVar("Number", np.float32, np.complex64)

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


def separate(magnitude: Real, known_phase: Real, certainty: Real, coherence: Complex) -> tuple[Complex, Real, Complex]:
    """The known part, and the magnitude and coherence of the noise that makes up the rest.

    `known_phase` and `certainty` cover the first frames only, as many as they have, and so does the known part.
    """
    known_frames = certainty.shape[-1]
    phasors = (certainty * np.exp(1j * known_phase)).astype(np.complex64)
    unknown = np.sqrt(np.maximum(1 - certainty**2, 0))
    # The known parts bring a coherence of their own; the noise makes up the difference.
    rest = coherence[..., :known_frames] - phasors[..., 0, :, :] * np.conj(phasors[..., 1, :, :])
    share = np.maximum(unknown[..., 0, :, :] * unknown[..., 1, :, :], _UNDECIDED)
    noise_coherence = np.concatenate([rest / share, coherence[..., known_frames:]], axis=-1)
    noise_coherence /= np.maximum(np.abs(noise_coherence), 1)
    noise_magnitude = magnitude.copy()
    noise_magnitude[..., :known_frames] *= unknown
    return magnitude[..., :known_frames] * phasors, noise_magnitude, noise_coherence


def delayed(values: npt.NDArray[Number], frames: npt.NDArray[np.float64]) -> npt.NDArray[Number]:
    """(B, ..., frame) values later by `frames` (B,), not necessarily whole: interpolated linearly, zero before them."""
    later = np.zeros_like(values)
    count = values.shape[-1]
    for row, delay in enumerate(frames):
        whole = int(np.floor(delay))
        share = float(delay - whole)
        for start, weight in ((whole, 1 - share), (whole + 1, share)):
            first, last = max(0, start), min(count, count + start)
            if last > first:
                later[row, ..., first:last] += (
                    values.dtype.type(weight) * values[row, ..., first - start : last - start]
                )
    return later


def correlated_noise(magnitude: Real, coherence: Complex, noise: FrozenNoise) -> Complex:
    """(..., 2, frequency, frame) frozen noise of the given magnitudes and interaural coherence (at most 1)."""
    left, right = noise.spectrogram
    spectrogram = np.empty(magnitude.shape, dtype=np.complex64)
    spectrogram[..., 0, :, :] = left
    independent = np.sqrt(np.maximum(1 - np.abs(coherence) ** 2, 0))
    spectrogram[..., 1, :, :] = np.conj(coherence) * left + independent * right
    spectrogram *= magnitude
    return spectrogram
