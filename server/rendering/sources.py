"""Sources of an emitter's dry signal: a clip, or live samples from a client.

Samples are mono float32 at the stream's rate, full scale 1. A source fills one block at a time, on the rendering
thread.

Where a clip is and when it starts and stops is one `PLAYBACK` record. Compiled code (`server.rendering.mixing_kernel`)
plays a copy of it; `ClipPlayer` does the same in NumPy.
"""

from collections.abc import Callable
from typing import Final, Protocol

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

    def skip(self, samples: int) -> None:
        """Go on as if `samples`, >= 0, had been played before the next block."""

    def reset(self) -> None:
        """Start again from the beginning."""


NEVER: Final = 2**62
"""Samples until something that does not happen."""

PLAYBACK = np.dtype(
    [
        (name, np.int64)
        for name in (
            "clip",  # address of float32 samples; 0 if Python fills the row
            "samples",  # of the clip
            "at",  # next sample
            "loop_start",
            "loop_end",  # 0: the clip is played once
            "starts_in",  # samples from the next block's first until the clip begins; negative once it has
            "fade_in",  # length of the fade with which it begins, 0 for none
            "stops_in",  # samples from the next block's first until it fades out; negative once it does
            "fade_out",  # length of the fade with which it stops
        )
    ]
)


class ClipPlayer:
    """Plays mono samples (n,), n >= 1, block by block: from `offset` on, once followed by silence, or in a loop without
    a gap from `loop_start` to `loop_end` (exclusive; by default the clip's ends).

    Where it starts in the middle of the clip, it fades in over `FADE_SAMPLES`. `starts_at` and `stop` count by the
    clock that `begin` tells, or from the first block. An array is checked here (`server.rendering.ingest`), which takes
    a while if it is long. Raises ValueError for an `offset` or a loop outside the clip.
    """

    def __init__(
        self,
        clip: DryAudio | FloatArray,
        *,
        loop: bool,
        offset: int = 0,
        loop_start: int = 0,
        loop_end: int | None = None,
        starts_at: int = 0,
    ) -> None:
        audio = clip if isinstance(clip, DryAudio) else DryAudio(clip)
        if audio.size == 0:
            raise ValueError("a clip is mono and not empty, got no samples")
        # guard: a caller's array goes through the door
        self.clip = audio.samples
        self.loop = loop
        self._starts_at, self._stops_at = starts_at, NEVER
        end = audio.size if loop_end is None or not loop else loop_end
        if not 0 <= loop_start < end <= audio.size:
            raise ValueError(f"a loop from sample {loop_start} to {end} is none in a clip of {audio.size} samples")
        if not 0 <= offset < end:
            raise ValueError(f"offset {offset} is not among the {end} samples that are played")
        self._offset = offset
        self._fade = raised_cosine(FADE_SAMPLES)
        self._records = np.zeros(1, PLAYBACK)
        self.playback: np.void = self._records[0]
        """The PLAYBACK record, as of the next block."""
        self.playback["clip"], self.playback["samples"] = self.clip.ctypes.data, audio.size
        self.playback["loop_start"], self.playback["loop_end"] = loop_start, end if loop else 0
        self.playback["fade_in"] = FADE_SAMPLES if offset else 0
        self.playback["fade_out"] = FADE_SAMPLES
        self.reset()

    def stop(self, clock: int, fade: int) -> None:
        """Fade out over `fade` samples from `clock` on. This takes effect when `begin` is called next."""
        self._stops_at, self.playback["fade_out"] = clock, fade

    def begin(self, clock: int) -> None:
        """Set the clock of the next block's first sample. A clip that should have started earlier starts now. A clip
        that should stop before it starts is over."""
        self.playback["starts_in"], self.playback["stops_in"] = max(0, self._starts_at - clock), NEVER
        stop_playback(self.playback, stops_in=self._stops_at - clock, fade=int(self.playback["fade_out"]))

    def process(self, out: FloatArray) -> None:
        """Fill `out` (b,) with the next samples."""
        record = self.playback
        waits = min(max(int(record["starts_in"]), 0), out.size)
        out[:waits] = 0
        self._read(out[waits:], record)
        played = waits - int(record["starts_in"])
        if played < record["fade_in"]:
            rising = out[waits : waits + FADE_SAMPLES - played]
            rising *= self._fade[played : played + rising.size]
        if record["stops_in"] < out.size:
            falling = out[max(0, int(record["stops_in"])) :]
            falling *= _fade_out(np.arange(out.size - falling.size, out.size) - record["stops_in"], record["fade_out"])
        record["starts_in"] -= out.size
        record["stops_in"] -= out.size

    def _read(self, out: FloatArray, record: np.void) -> None:
        written, at, end = 0, int(record["at"]), int(record["loop_end"]) or self.clip.size
        while written < out.size:
            piece = self.clip[at : min(end, at + out.size - written)]
            if piece.size == 0:  # a clip that does not loop is over
                out[written:] = 0
                break
            out[written : written + piece.size] = piece
            written += piece.size
            at += piece.size
            if record["loop_end"] and at == end:
                at = int(record["loop_start"])
        record["at"] = at

    def skip(self, samples: int) -> None:
        """Go on as if `samples` had been played before the next block."""
        record = self.playback
        at, end, start = int(record["at"]), int(record["loop_end"]), int(record["loop_start"])
        at += max(0, samples - max(0, int(record["starts_in"])))
        if not end:
            at = min(at, self.clip.size)
        elif at >= end:
            at = start + (at - end) % (end - start)
        record["at"] = at
        record["starts_in"] -= samples
        record["stops_in"] -= samples

    def reset(self) -> None:
        self.playback["at"] = self._offset
        self.begin(0)


def _fade_out(since: npt.NDArray[np.int64], samples: int) -> FloatArray:
    """The gains of a fade-out that lasts `samples`, at the sample numbers `since` its beginning."""
    phase = np.pi * np.minimum((since + 0.5) / samples, 1.0)
    return np.asarray(0.5 + 0.5 * np.cos(phase), np.float32)


def stop_playback(record: np.void, *, stops_in: int, fade: int) -> None:
    """Let what a PLAYBACK record plays fade out over `fade` samples, >= 1, from `stops_in` samples after the next
    block's first on. What has not started by then is over. Once a fade-out has begun this changes nothing."""
    if record["stops_in"] >= 0:
        is_heard = record["starts_in"] < 0 or record["starts_in"] < stops_in
        record["stops_in"], record["fade_out"] = max(0, stops_in) if is_heard else -fade, fade


def is_over(record: np.void) -> bool:
    """Whether a PLAYBACK record plays nothing any more."""
    is_played = record["starts_in"] <= 0 and not record["loop_end"] and record["at"] == record["samples"]
    return bool(is_played or record["stops_in"] <= -record["fade_out"])


class SharedSource:
    """One source that several renderers play, each through a `tap`: the first that asks for a block has it made, and
    the others get the same samples. All have the same clock."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._clock = -1
        """Of the block that was made last; -1 before the first."""
        self._block: FloatArray = np.zeros(0, np.float32)

    def tap(self, clock: Callable[[], int]) -> "SourceTap":
        """Return the source for a renderer whose next block begins at `clock`."""
        return SourceTap(self, clock)

    def process(self, clock: int, out: FloatArray) -> None:
        """Fill `out` (b,) with the block that begins at a clock."""
        if clock != self._clock:
            self._clock = clock
            self._block = np.empty_like(out)
            self._source.process(self._block)
        np.copyto(out, self._block)

    def skip(self, samples: int) -> None:
        """Go on as if `samples` had been played. After the first block, this changes nothing."""
        if self._clock < 0:
            self._source.skip(samples)

    def reset(self) -> None:
        self._clock = -1
        self._source.reset()


class SourceTap:
    """A `SharedSource` with the interface of a `Source`, for one renderer: it asks for the block that begins at the
    clock of this renderer."""

    def __init__(self, shared: SharedSource, clock: Callable[[], int]) -> None:
        self._shared = shared
        self._clock = clock

    def process(self, out: FloatArray) -> None:
        """Fill `out` (b,) with the next samples."""
        self._shared.process(self._clock(), out)

    def skip(self, samples: int) -> None:
        """Go on as if `samples`, >= 0, had been played before the next block."""
        self._shared.skip(samples)

    def reset(self) -> None:
        """Start again from the beginning."""
        self._shared.reset()


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
        self._is_playing = self._fades_in = False
        self._waits_for = self._lead
        self._risen = FADE_SAMPLES  # of the fade-in after lost samples
        self._overtaken: FloatArray | None = None  # the samples that would have come next, had they not been dropped

    def skip(self, _samples: int) -> None:
        """Fade in with the first sample that is played: those before it were not."""
        self._fades_in = True

    def push(self, samples: FloatArray) -> None:
        """Queue samples (n,) from a client."""
        audio = DryAudio(samples)
        # guard: what a client sends goes through the door
        clean = audio.samples
        # guard: gated samples are counted
        self.samples_gated += audio.silenced
        if self._risen < FADE_SAMPLES:
            clean = clean.copy()
            rising = clean[: FADE_SAMPLES - self._risen]
            rising *= self._fade_in[self._risen : self._risen + rising.size]
            self._risen += rising.size
        capacity = self._ring.size
        self._drop(self.queued + clean.size - capacity)
        clean = clean[-capacity:]
        start = (self._read + self.queued) % capacity
        first = clean[: capacity - start]
        self._ring[start : start + first.size] = first
        self._ring[: clean.size - first.size] = clean[first.size :]
        self.queued += clean.size

    def lose(self, count: int) -> None:
        """Queue silence in place of `count` lost samples, at most as many as the lead. The queue fades out before it,
        and the next samples fade in. While nothing plays, the queue stays as it is."""
        if not self._is_playing:
            return
        # At least so many samples are in the queue of what plays.
        last = (self._read + self.queued - FADE_SAMPLES + np.arange(FADE_SAMPLES)) % self._ring.size
        self._ring[last] *= 1 - self._fade_in
        self._risen = FADE_SAMPLES
        self.push(np.zeros(min(count, self._lead), np.float32))
        self._risen = 0

    @property
    def target(self) -> int:
        """The number of queued samples at which it begins, or begins again, to play."""
        return self._waits_for

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
        if self.underruns or self._fades_in:
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
