"""Decoding of a network's spectrograms to impulse responses, with one choice of phase.

Axes: B poses; spectrograms (B, ear, frequency, frame); responses (B, ear, sample).
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property

import numpy as np
import numpy.typing as npt

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
from server.acoustics.phase import FrozenNoise
from server.acoustics.stft_kernel import Windows
from server.field.any_size_decoder import AnySizeDecoder
from server.field.graph import Spectrograms
from server.kernels.array_pool import ArrayPool
from server.kernels.simd import LANES
from server.scene.manifest import CodecParameters, Phase

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

_POOL = ArrayPool(16 * 1024 * 1024)
"""Freed responses of one request are reused for the next."""


def is_compiled_size(parameters: CodecParameters) -> bool:
    """Whether compiled code can decode spectrograms of this size. NumPy decodes all others, more slowly."""
    n_fft = parameters.n_fft
    return n_fft & (n_fft - 1) == 0 and parameters.codec.frames >= LANES and parameters.columns >= FEWEST


class Decoder:
    """Decodes predicted spectrograms to impulse responses. Thread-safe: every call uses its own buffers, which are kept
    for later calls.

    Responses have `ir_samples` samples, whatever the codec's length. Only the first `frames` frames of a prediction are
    used (default: all), and silence follows them.
    """

    def __init__(
        self,
        parameters: CodecParameters,
        noise: FrozenNoise,
        *,
        ir_samples: int,
        phase: Phase,
        frames: int | None = None,
    ) -> None:
        self.ir_samples = ir_samples
        self._codec = parameters.codec
        self._phase = phase
        self._noise = noise
        used = self._codec.frames if frames is None else min(frames, self._codec.frames)
        self._any_size: AnySizeDecoder | None = None
        if not is_compiled_size(parameters):
            self._any_size = AnySizeDecoder(parameters, noise, ir_samples=ir_samples, phase=phase, frames=used)
            return
        self._columns = Columns.of(parameters.frame_axis, used)
        self._windows = Windows.of(self._codec)
        self._shape = Shape(
            bins=self._codec.bins,
            frames=self._codec.frames,
            used=used,
            known=min(parameters.known_frames, used),
            samples=self._codec.samples,
            frame_lead=self._codec.frame_lead_samples,
            log_floor=parameters.log_floor,
            all_is_certain=phase.kind == "integrated",
        )
        self._workspaces: list[Workspace] = []

    def decode(self, predicted: Spectrograms, aligned: Floats, near: Sequence[Float32 | None] | None = None) -> Float32:
        """Decode predictions, given per frame or per cell, to responses (B, 2, ir_samples). The first sample of each
        prediction lies at sample `aligned` (B,) of its response, which may be a fraction.

        `near` (B) are responses of nearby poses, or None; a warm phase starts from them.
        """
        near = near or [None] * len(aligned)
        if self._any_size is not None:
            return self._any_size.decode(predicted, aligned, near)
        responses = self.room(len(aligned))
        with self._workspace() as work:
            if self._phase.kind == "griffin_lim":
                for row, response in enumerate(near):
                    self._iterate(predicted[row : row + 1], aligned[row : row + 1], response, work, responses[row])
            else:
                self._run(predicted, aligned, WHOLE, work, responses)
        return responses

    @cached_property
    def constants(self) -> tuple[Columns, Shape, Windows, Float32] | None:
        """What compiled code needs to decode spectrograms as this does; None if NumPy decodes them."""
        if self._any_size is not None:
            return None
        return self._columns, self._shape, self._windows, self._noise.parts

    def room(self, count: int, samples: int | None = None) -> Float32:
        """Room for so many responses or, with `samples`, for so much of them; not initialised."""
        return _POOL.floats(count, 2, self.ir_samples if samples is None else samples)

    def new_workspace(self) -> Workspace:
        """Buffers of compiled code for one call at a time."""
        return Workspace.of(self._shape, self._codec.n_fft, iterates=self._phase.kind == "griffin_lim")

    @contextmanager
    def _workspace(self) -> Iterator[Workspace]:
        """Lend buffers of compiled code."""
        try:
            work = self._workspaces.pop()
        except IndexError:
            work = self.new_workspace()
        yield work
        self._workspaces.append(work)

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
