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

Where magnitudes are all that is trusted, `griffin_lim` finds the phases that fit them best.

Axes: (..., ear, frequency, frame), ear 0 = left; coherence (..., frequency, frame), E[S_left conj(S_right)] over the
magnitudes.
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
"""Noise of two ears below this product of magnitudes, relative to the whole, has whatever coherence."""
MOST_COHERENT = 1 - 1e-5
"""Of noise at two ears: nearer to 1, what is left of 1 - coherence**2 would be rounding."""
NO_PHASE = 1e-30
"""Square of a magnitude below which the phase is taken as zero."""


@dataclass(frozen=True)
class FrozenNoise:
    """Two independent white signals as spectrograms (2, frequency, frame) of unit expected power."""

    spectrogram: Complex

    @classmethod
    def from_signal(cls, codec: Codec, signal: npt.NDArray[np.floating]) -> "FrozenNoise":
        """`signal` is (2, sample), of unit variance."""
        scale = 1 / np.sqrt(codec.window_energy)
        return cls((codec.transform(signal.astype(np.float64)) * scale).astype(np.complex64))

    @cached_property
    def parts(self) -> Real:
        """(frame // 8, frequency, 4, 8) left and right, real and imaginary, of eight frames after the other as they are
        decoded; with silent frames to a multiple of eight."""
        left, right = self.spectrogram
        parts = np.stack([left.real, left.imag, right.real, right.imag], axis=1)
        parts = np.pad(parts, [(0, 0), (0, 0), (0, -parts.shape[-1] % 8)])
        return on_lines(parts.reshape(*parts.shape[:2], -1, 8).transpose(2, 0, 1, 3))


def separate(magnitude: Real, known_phase: Real, certainty: Real, coherence: Complex) -> tuple[Complex, Real, Complex]:
    """The known part, and the magnitude and coherence of the noise that makes up the rest.

    `known_phase` and `certainty` cover the first frames only, as many as they have, and so does the known part.
    """
    known_frames = certainty.shape[-1]
    phasors = (certainty * np.exp(1j * known_phase)).astype(np.complex64)
    unknown = np.sqrt(np.maximum(1 - certainty**2, 0))
    # The known parts bring a coherence of their own; the noise makes up the difference.
    rest = coherence[..., :known_frames] - phasors[..., 0, :, :] * np.conj(phasors[..., 1, :, :])
    share = np.maximum(unknown[..., 0, :, :] * unknown[..., 1, :, :], UNDECIDED)
    noise_coherence = np.concatenate([rest / share, coherence[..., known_frames:]], axis=-1)
    noise_coherence *= MOST_COHERENT / np.maximum(np.abs(noise_coherence), 1)
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


def zero_phase(magnitude: Real) -> Complex:
    """(..., frequency, frame) spectrogram whose phase is zero in the middle of each window, where the window lets
    through what adds up there."""
    return (magnitude * (-1) ** np.arange(magnitude.shape[-2])[:, None]).astype(np.complex64)


def griffin_lim(codec: Codec, magnitude: Real, signal: Real, iterations: int) -> Real:
    """(..., sample) whose transform has nearly these magnitudes (..., frequency, frame), from a `signal` (..., sample)
    near it: the transform's phases with the magnitudes asked for, again and again (Griffin and Lim 1984)."""
    for _ in range(iterations):
        spectrogram = codec.transform(signal)
        square = spectrogram.real**2 + spectrogram.imag**2
        has_phase = square >= NO_PHASE
        phasors = np.where(has_phase, spectrogram / np.sqrt(np.where(has_phase, square, 1)), 1)
        signal = codec.synthesise((magnitude * phasors).astype(np.complex64)).astype(np.float32)
    return signal
