"""Spectrograms as a network predicts them to impulse responses, at one choice of phase.

Axes: B poses; spectrograms (B, ear, frequency, frame); responses (B, ear, sample).
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from server.acoustics.phase import FrozenNoise, correlated_noise, delayed, griffin_lim, separate, zero_phase
from server.field.graph import Spectrograms
from server.kernels.array_pool import ArrayPool
from server.kernels.compiled import HAS_NUMBA
from server.scene.manifest import CodecParameters, Phase

if HAS_NUMBA:
    from server.acoustics.columns_kernel import FEWEST, Columns
    from server.acoustics.decoding_kernel import (
        START,
        TARGETS,
        WHOLE,
        Shape,
        Workspace,
        decode,
    )
    from server.acoustics.griffin_lim_kernel import iterate
    from server.acoustics.stft_kernel import Windows
    from server.kernels.simd import LANES

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

_SPARES = ArrayPool(16 * 1024 * 1024)
"""A request's responses wait for those of the next."""


class Decoder:
    """Thread-safe: every call works in arrays of its own, kept for later ones.

    `ir_samples` are what a response has whatever the codec's length; of a prediction the first `frames` count, by
    default all, and what follows them is silent.
    """

    def __init__(
        self,
        parameters: CodecParameters,
        noise: FrozenNoise,
        *,
        ir_samples: int,
        phase: Phase,
        frames: int | None = None,
        is_compiled: bool = HAS_NUMBA,
    ) -> None:
        self.ir_samples = ir_samples
        self._codec = parameters.codec
        self._phase = phase
        self._noise = noise
        self._used = self._codec.frames if frames is None else min(frames, self._codec.frames)
        self._known = min(parameters.known_frames, self._used)
        n_fft = self._codec.n_fft
        self._axis = parameters.frame_axis
        self._is_compiled = is_compiled and n_fft & (n_fft - 1) == 0 and self._codec.frames >= LANES
        self._is_compiled = self._is_compiled and parameters.columns >= FEWEST
        if self._is_compiled:
            self._columns = Columns.of(self._axis, self._used)
            self._windows = Windows.of(self._codec)
            self._shape = Shape(
                bins=self._codec.bins,
                frames=self._codec.frames,
                used=self._used,
                known=self._known,
                samples=self._codec.samples,
                frame_lead=self._codec.frame_lead_samples,
                log_floor=parameters.log_floor,
                all_is_certain=phase.kind == "integrated",
            )
            self._workspaces: list[Workspace] = []

    def decode(self, predicted: Spectrograms, aligned: Floats, near: Sequence[Float32 | None] | None = None) -> Float32:
        """(B, 2, ir_samples) of predictions, of frames or of their cells, whose first sample is at `aligned` (B,),
        whole or not, of the response.

        `near` (B) are responses to take over the phase from, where there are any and the phase is warm.
        """
        near = near or [None] * len(aligned)
        if not self._is_compiled:
            return self.decode_with_numpy(predicted, aligned, near)
        responses = _SPARES.floats(len(aligned), 2, self.ir_samples)
        try:
            work = self._workspaces.pop()
        except IndexError:
            work = Workspace.of(self._shape, self._codec.n_fft, iterates=self._phase.kind == "griffin_lim")
        if self._phase.kind == "griffin_lim":
            for row, response in enumerate(near):
                self._iterate(predicted[row : row + 1], aligned[row : row + 1], response, work, responses[row])
        else:
            self._run(predicted, aligned, WHOLE, work, responses)
        self._workspaces.append(work)
        return responses

    def _iterate(
        self, predicted: Spectrograms, aligned: Floats, near: Float32 | None, work: "Workspace", response: Float32
    ) -> None:
        starts_from_noise = self._phase.warm and near is None
        self._run(predicted, aligned, START if starts_from_noise else TARGETS, work, response[None])
        if near is not None:
            response[:] = near
        iterate(
            self._phase.iterations,
            not self._phase.warm and near is None,
            float(aligned[0]),
            self._shape,
            self._windows,
            work,
            response,
        )

    def _run(
        self, predicted: Spectrograms, aligned: Floats, purpose: int, work: "Workspace", responses: Float32
    ) -> None:
        decode(
            predicted.log_magnitude,
            predicted.instantaneous_frequency,
            predicted.certainty,
            predicted.interaural,
            aligned,
            self._columns,
            self._shape,
            self._windows,
            self._noise.parts,
            purpose,
            work,
            responses,
        )

    def decode_with_numpy(self, predicted: Spectrograms, aligned: Floats, near: Sequence[Float32 | None]) -> Float32:
        """What `decode` does where nothing can be compiled."""
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
        responses = resized(codec.synthesise(noise), self.ir_samples)
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
            responses = resized(griffin_lim(codec, targets, signals, phase.iterations), self.ir_samples)
        return responses

    def _first_frames(self, predicted: Spectrograms) -> Spectrograms:
        """With no more known frames than there are frames."""
        frequency, certainty = predicted.instantaneous_frequency, predicted.certainty
        known = self._known
        return Spectrograms(
            predicted.log_magnitude, frequency[..., :known], certainty[..., :known], predicted.interaural
        )


def add_from(part: Float32, response: Float32, at: int) -> None:
    """Adds (ear, sample) `part` to the response from sample `at` on, as far as both reach."""
    first, last = max(0, at), min(response.shape[-1], at + part.shape[-1])
    if last > first:
        response[:, first:last] += part[:, first - at : last - at]


def resized(signals: npt.NDArray[np.floating], samples: int) -> Float32:
    """(..., sample) cut, or silent from where they end."""
    short = max(0, samples - signals.shape[-1])
    padded = np.pad(signals[..., :samples], [(0, 0)] * (signals.ndim - 1) + [(0, short)])
    return padded.astype(np.float32)
