"""Decoding of spectrograms to responses in NumPy, for codec sizes that compiled code does not support: windows that are
no power of two, or very few frames or cells.

Axes as in `server.field.decoder`.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from server.acoustics.phase import FrozenNoise, correlated_noise, delayed, griffin_lim, separate, zero_phase
from server.field.graph import Spectrograms
from server.scene.manifest import CodecParameters, Phase

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]


class AnySizeDecoder:
    """Decodes as `server.field.decoder.Decoder` documents; only the first `frames` frames are used. Thread-safe."""

    def __init__(
        self, parameters: CodecParameters, noise: FrozenNoise, *, ir_samples: int, phase: Phase, frames: int
    ) -> None:
        self._codec = parameters.codec
        self._axis = parameters.frame_axis
        self._noise = noise
        self._ir_samples = ir_samples
        self._phase = phase
        self._used = frames
        self._known = min(parameters.known_frames, frames)

    def decode(self, predicted: Spectrograms, aligned: Floats, near: Sequence[Float32 | None]) -> Float32:
        codec, phase = self._codec, self._phase
        predicted = self._first_frames(predicted.spread(self._axis))
        start = np.floor(aligned).astype(int)
        certainty = predicted.certainty if phase.kind != "integrated" else np.ones_like(predicted.certainty)
        magnitude = codec.magnitude(predicted.log_magnitude)
        known, unknown, coherence = separate(
            magnitude, codec.integrate(predicted.instantaneous_frequency), certainty, predicted.coherence
        )
        for values in (unknown, magnitude, coherence):
            values[..., self._used :] = 0
        frames = aligned / codec.hop
        noise = correlated_noise(delayed(unknown, frames), delayed(coherence, frames), self._noise)
        responses = resized(codec.synthesise(noise), self._ir_samples)
        shift = np.exp(-2j * np.pi * np.arange(codec.bins) / codec.n_fft * (aligned - start)[:, None])
        early = codec.synthesise(known * shift[:, None, :, None].astype(np.complex64))
        for response, part, at in zip(responses, early, start, strict=True):
            add_from(part, response, at)
        if phase.iterations:
            targets = delayed(magnitude, frames)
            signals = resized(responses, codec.samples) if phase.warm else codec.synthesise(zero_phase(targets))
            for row, response in enumerate(near):
                if response is not None:
                    signals[row] = resized(response, codec.samples)
            responses = resized(griffin_lim(codec, targets, signals, phase.iterations), self._ir_samples)
        return responses

    def _first_frames(self, predicted: Spectrograms) -> Spectrograms:
        """The same predictions with no more known frames than used frames."""
        frequency, certainty = predicted.instantaneous_frequency, predicted.certainty
        known = self._known
        return Spectrograms(
            predicted.log_magnitude, frequency[..., :known], certainty[..., :known], predicted.interaural
        )


def add_from(part: Float32, response: Float32, at: int) -> None:
    """Add `part` (ear, sample) to the response from sample `at` on; samples outside the response are dropped."""
    first, last = max(0, at), min(response.shape[-1], at + part.shape[-1])
    if last > first:
        response[:, first:last] += part[:, first - at : last - at]


def resized(signals: npt.NDArray[np.floating], samples: int) -> Float32:
    """Signals (..., sample) cut or padded with zeros to `samples`."""
    short = max(0, samples - signals.shape[-1])
    padded = np.pad(signals[..., :samples], [(0, 0)] * (signals.ndim - 1) + [(0, short)])
    return padded.astype(np.float32)
