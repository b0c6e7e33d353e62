"""Phase of a predicted binaural spectrogram. Known phase is used; the rest is noise with the predicted coherence
between the ears.

A field can predict the phase of some early reflections, but not that of late reverberation. Its `certainty` is the
length of the mean phasor: 1 where the phase is known and 0 where it is random. A bin is the known phasor plus frozen
noise with the remaining energy:

S = M (R exp(i phi) + sqrt(1 - R**2) N)

The noise is the transform of one white signal per scene. It does not move with the pose: a field's frames count from
the arrival of sound, so their levels are delayed to count from emission before they multiply the noise, and only the
known part moves. Responses of neighbouring poses therefore crossfade without comb filtering. The noise of the right ear
is mixed so that the sum has the predicted complex interaural coherence.

If only the magnitudes can be trusted, `griffin_lim` finds the phases that fit them best.

Axes: (..., ear, frequency, frame), ear 0 = left. Coherence is (..., frequency, frame): E[S_left conj(S_right)] divided
by the magnitudes.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from server.kernels.cache_lines import on_lines

Real = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]
Number = TypeVar("Number", np.float32, np.complex64)

UNDECIDED = 1e-6
"""Smallest product of the two ears' noise magnitudes, relative to the whole, for which coherence is computed."""
MOST_COHERENT = 1 - 1e-5
"""Largest coherence of the noise at two ears. Nearer to 1, rounding would dominate 1 - coherence**2."""
NO_PHASE = 1e-30
"""Bins with a smaller squared magnitude are given phase zero."""


@dataclass(frozen=True)
class FrozenNoise:
    """Two independent white signals as spectrograms (2, frequency, frame) of unit expected power."""

    spectrogram: Complex

    @classmethod
    def from_signal(cls, codec: Codec, signal: npt.NDArray[np.floating]) -> "FrozenNoise":
        """From white signals (2, sample) of unit variance."""
        scale = 1 / np.sqrt(codec.window_energy)
        return cls((codec.transform(signal.astype(np.float64)) * scale).astype(np.complex64))

    @cached_property
    def parts(self) -> Real:
        """(frame // 8, frequency, 4, 8) left real, left imaginary, right real and right imaginary parts, in groups of
        eight frames as the decoder reads them. Silent frames fill the last group."""
        left, right = self.spectrogram
        parts = np.stack([left.real, left.imag, right.real, right.imag], axis=1)
        parts = np.pad(parts, [(0, 0), (0, 0), (0, -parts.shape[-1] % 8)])
        return on_lines(parts.reshape(*parts.shape[:2], -1, 8).transpose(2, 0, 1, 3))


def separate(magnitude: Real, known_phase: Real, certainty: Real, coherence: Complex) -> tuple[Complex, Real, Complex]:
    """Split a prediction into the known part, and the magnitude and coherence of the noise.

    `known_phase` and `certainty` may cover only the first frames. The known part covers the same frames.
    """
    known_frames = certainty.shape[-1]
    phasors = (certainty * np.exp(1j * known_phase)).astype(np.complex64)
    unknown = np.sqrt(np.maximum(1 - certainty**2, 0))
    # The known parts have a coherence of their own. The noise supplies the difference.
    rest = coherence[..., :known_frames] - phasors[..., 0, :, :] * np.conj(phasors[..., 1, :, :])
    # guard: noise that is not there has no coherence
    share = np.maximum(unknown[..., 0, :, :] * unknown[..., 1, :, :], UNDECIDED)
    noise_coherence = np.concatenate([rest / share, coherence[..., known_frames:]], axis=-1)
    # guard: coherence is at most one
    noise_coherence *= MOST_COHERENT / np.maximum(np.abs(noise_coherence), 1)
    noise_magnitude = magnitude.copy()
    noise_magnitude[..., :known_frames] *= unknown
    return magnitude[..., :known_frames] * phasors, noise_magnitude, noise_coherence


def delayed(values: npt.NDArray[Number], frames: npt.NDArray[np.float64]) -> npt.NDArray[Number]:
    """Delay values (B, ..., frame) by `frames` (B,), which may be fractional: linear interpolation, zero before the
    first frame."""
    later = np.zeros_like(values)
    count = values.shape[-1]
    for row, delay in enumerate(frames):
        whole = int(np.floor(delay))
        # guard: levels are delayed by parts of a frame
        share = float(delay - whole)
        for start, weight in ((whole, 1 - share), (whole + 1, share)):
            # guard: a delayed level stays within its response
            first, last = max(0, start), min(count, count + start)
            if last > first:
                later[row, ..., first:last] += (
                    values.dtype.type(weight) * values[row, ..., first - start : last - start]
                )
    return later


def correlated_noise(magnitude: Real, coherence: Complex, noise: FrozenNoise) -> Complex:
    """(..., 2, frequency, frame) frozen noise with these magnitudes and this interaural coherence (at most 1)."""
    left, right = noise.spectrogram
    spectrogram = np.empty(magnitude.shape, dtype=np.complex64)
    spectrogram[..., 0, :, :] = left
    independent = np.sqrt(np.maximum(1 - np.abs(coherence) ** 2, 0))
    spectrogram[..., 1, :, :] = np.conj(coherence) * left + independent * right
    spectrogram *= magnitude
    return spectrogram


def zero_phase(magnitude: Real) -> Complex:
    """(..., frequency, frame) spectrogram whose phase is zero at the centre of each window."""
    return (magnitude * (-1) ** np.arange(magnitude.shape[-2])[:, None]).astype(np.complex64)


def griffin_lim(codec: Codec, magnitude: Real, signal: Real, iterations: int) -> Real:
    """(..., sample) signal whose transform has nearly these magnitudes (..., frequency, frame). From `signal` (...,
    sample), each iteration keeps the transform's phases and replaces its magnitudes (Griffin and Lim 1984)."""
    for _ in range(iterations):
        spectrogram = codec.transform(signal)
        square = spectrogram.real**2 + spectrogram.imag**2
        # guard: what is silent has no phase
        has_phase = square >= NO_PHASE
        phasors = np.where(has_phase, spectrogram / np.sqrt(np.where(has_phase, square, 1)), 1)
        signal = codec.synthesise((magnitude * phasors).astype(np.complex64)).astype(np.float32)
    return signal
