"""Sources of an emitter's dry signal: a clip, or live samples from a client.

Samples are mono float32 at the scene's rate, full scale 1. A source fills one block at a time, on the rendering thread.
"""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.rendering.fade import raised_cosine
from server.rendering.ingest import DryAudio

FloatArray = npt.NDArray[np.float32]

FADE_SAMPLES = 64


class Source(Protocol):
    """The interface through which the renderer gets the next block of an emitter."""

    def process(self, out: FloatArray) -> None:
        """Fill `out` (b,) with the next samples."""

    def reset(self) -> None:
        """Start again from the beginning."""


class ClipPlayer:
    """Plays mono samples (n,), n >= 1, block by block: once followed by silence, or in a loop without a gap.

    An array is checked here (`server.rendering.ingest`), which takes a while if it is long.
    """

    def __init__(self, clip: DryAudio | FloatArray, *, loop: bool) -> None:
        audio = clip if isinstance(clip, DryAudio) else DryAudio(clip)
        if audio.size == 0:
            raise ValueError("a clip is mono and not empty, got no samples")
        # guard: a caller's array goes through the door
        self.clip = audio.samples
        self.loop = loop
        self._position = 0

    def process(self, out: FloatArray) -> None:
        """Fill `out` (b,) with the next samples."""
        written = 0
        while written < out.size:
            piece = self.clip[self._position : self._position + out.size - written]
            if piece.size == 0:  # a clip that does not loop is over
                out[written:] = 0
                return
            out[written : written + piece.size] = piece
            written += piece.size
            self._position += piece.size
            if self.loop and self._position == self.clip.size:
                self._position = 0

    def reset(self) -> None:
        self._position = 0


class LiveSource:
    """A queue of samples from a client to the renderer, of at most `capacity` samples.

    It starts to play when `lead` samples are queued, so that samples may arrive unevenly. If too few are queued for a
    block, the rest fades out and silence follows: this is one underrun. Playing resumes with the newest samples when
    twice the previous number is queued, up to half the capacity; older samples would only add delay. If the queue is
    full, the oldest samples are dropped, with a crossfade over the gap.

    Samples that are not valid audio become silence and are counted (`server.rendering.ingest`).

    Everything happens on the rendering thread, which receives the samples with the client's other messages. Blocks must
    have at least `FADE_SAMPLES` samples.
    """

    def __init__(self, *, capacity: int, lead: int) -> None:
        if not FADE_SAMPLES < lead <= capacity:
            raise ValueError(f"a lead of {lead} samples does not lie between {FADE_SAMPLES} and {capacity}")
        self._ring = np.zeros(capacity, np.float32)
        self._lead = lead
        self._fade_in = raised_cosine(FADE_SAMPLES)
        self.reset()

    def reset(self) -> None:
        """Drop the queue and set every count to zero."""
        self.queued = 0
        """The number of queued samples."""
        self.underruns = 0
        self.samples_dropped = 0
        self.samples_gated = 0
        self._read = 0
        self._is_playing = False
        self._waits_for = self._lead
        self._overtaken: FloatArray | None = None  # the samples that would have come next, had they not been dropped

    def push(self, samples: FloatArray) -> None:
        """Queue samples (n,) from a client."""
        audio = DryAudio(samples)
        # guard: what a client sends goes through the door
        clean = audio.samples
        # guard: gated samples are counted
        self.samples_gated += audio.silenced
        capacity = self._ring.size
        self._drop(self.queued + clean.size - capacity)
        clean = clean[-capacity:]
        start = (self._read + self.queued) % capacity
        first = clean[: capacity - start]
        self._ring[start : start + first.size] = first
        self._ring[: clean.size - first.size] = clean[first.size :]
        self.queued += clean.size

    def process(self, out: FloatArray) -> None:
        """Fill `out` (b,) with the next samples, or with silence if there are not enough."""
        if not self._is_playing:
            self._start(out)
        elif self.queued >= out.size + FADE_SAMPLES:
            # FADE_SAMPLES stay in the queue, for a fade-out in case nothing follows.
            self._take(out)
            if self._overtaken is not None:
                head = out[:FADE_SAMPLES]
                head += (1 - self._fade_in) * (self._overtaken - head)
        else:
            self._run_dry(out)
        self._overtaken = None

    def _start(self, out: FloatArray) -> None:
        wanted = max(self._waits_for, out.size + FADE_SAMPLES)
        if self.queued < wanted:
            out.fill(0)
            return
        if self.underruns:
            self._drop(self.queued - wanted)
        self._is_playing = True
        self._take(out)
        if self.underruns:
            out[:FADE_SAMPLES] *= self._fade_in

    def _run_dry(self, out: FloatArray) -> None:
        rest = out[: self.queued]
        self._take(rest)
        # guard: an underrun fades out
        rest[-FADE_SAMPLES:] *= 1 - self._fade_in
        out[rest.size :] = 0
        self._is_playing = False
        self._waits_for = min(2 * self._waits_for, self._ring.size // 2)
        self.underruns += 1

    def _drop(self, count: int) -> None:
        """Drop the `count` oldest samples: from the queue first, then from the samples that are arriving."""
        if count <= 0:
            return
        self.samples_dropped += count
        if self._is_playing and self._overtaken is None:
            self._overtaken = self._ring.take(np.arange(self._read, self._read + FADE_SAMPLES), mode="wrap")
        waiting = min(count, self.queued)
        self._read = (self._read + waiting) % self._ring.size
        self.queued -= waiting

    def _take(self, out: FloatArray) -> None:
        """Move the oldest samples to `out`, which must not be longer than the queue."""
        first = self._ring[self._read : self._read + out.size]
        out[: first.size] = first
        out[first.size :] = self._ring[: out.size - first.size]
        self._read = (self._read + out.size) % self._ring.size
        self.queued -= out.size
