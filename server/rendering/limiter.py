"""The last thing that happens to what a listener hears: nothing, unless it would be too loud for a converter.

A peak limiter, both ears by the same gain so that nothing moves. Peaks are true peaks: of the signal between samples
too, which a converter makes of them, estimated at four times the rate as in ITU-R BS.1770-4, Annex 2. A block below the
ceiling passes to the last bit.

It adds no latency, so it looks ahead no further than the end of its block. The gain falls in time for a peak within
the block, at most by 1 over `_ATTACK` samples; where a block begins with a peak it falls as fast as it must, and until
it is low enough samples are held at the ceiling. What lies between the last samples of a block and the first of the
next is known only with the latter; a gain that recovers slowly keeps that in check while sound goes on. It stays down
for as long as a period of the lowest tones before it does, so that they are not bent.

A sample that is not finite becomes silence here. Nothing before lets one arise; were it otherwise, a loudspeaker would
be the wrong place to find out.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from server.kernels.by_reference import Reference
from server.kernels.compiled import compiled

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CEILING = 10 ** (-1 / 20)
"""-1 dB of full scale, true peak: the maximum permitted by EBU R 128, with room for what codecs and resamplers add."""

_TAPS = 16
_KAISER_BETA = 6.0
_PHASES = 3  # between two samples
_STEP = 16
"""Samples between the points that the gain is a straight line between."""
_ATTACK = 64
_HOLD_S = 0.02
_AGAIN = 1.01
"""A peak that asks for so little more than the gain there is keeps it down."""
_RELEASE_S = 0.2
_AT_REST = 1e-5
"""Of a gain that is so near to 1, the rest is let go: a ten-thousandth of a decibel."""


def _interpolators() -> FloatArray:
    """(phase, tap): the signal a quarter, a half and three quarters of a sample after tap `_TAPS` / 2 - 1."""
    offset = np.arange(_TAPS) - (_TAPS // 2 - 1) - np.arange(1, _PHASES + 1)[:, None] / (_PHASES + 1)
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1 - (offset / (_TAPS / 2)) ** 2)))
    rows = np.sinc(offset) * window
    return np.asarray(rows / rows.sum(axis=-1, keepdims=True), np.float32)


class LimiterState(NamedTuple):
    """Everything that `limit` reads and writes."""

    signal: FloatArray  # (channel, the last of the block before, and room for a block)
    table: FloatArray  # (phase, tap)
    peak: FloatArray  # (sample,)
    gain: DoubleArray  # at the ends of steps
    held: IntArray  # (1,) steps since a peak asked for a gain
    counts: IntArray  # (2,) whether the block last processed was changed; samples silenced so far
    ceiling: float
    safe: float
    keep: float
    hold: int


class Limiter:
    """Of blocks (channels, block_size), whose size is a multiple of 16. `state` is for compiled code to hand on."""

    def __init__(self, *, channels: int, block_size: int, sample_rate: int, ceiling: float = CEILING) -> None:
        if block_size % _STEP or not 0 < ceiling < math.inf:
            raise ValueError(f"blocks are multiples of {_STEP} samples, and a ceiling is above 0 and finite")
        table = _interpolators()
        state = LimiterState(
            signal=np.zeros((channels, _TAPS - 1 + block_size), np.float32),
            table=table,
            peak=np.zeros(block_size, np.float32),
            # In double precision: in single, the last of a slow release is lost to rounding, and it never ends.
            gain=np.ones(block_size // _STEP + 1),
            held=np.zeros(1, np.int64),
            counts=np.zeros(2, np.int64),
            ceiling=float(np.float32(ceiling)),
            # Up to here no signal reaches the ceiling between samples, whatever its phases.
            safe=float(np.float32(ceiling / np.abs(table).sum(axis=-1).max())),
            keep=math.exp(-_STEP / (_RELEASE_S * sample_rate)),
            hold=round(_HOLD_S * sample_rate / _STEP),
        )
        self.state: Any = Reference(state)

    def reset(self) -> None:
        """Forget what was heard before."""
        for array in (self.state.signal, self.state.held, self.state.counts):
            array.fill(0)
        self.state.gain.fill(1)

    @property
    def acted(self) -> bool:
        """Whether the block last processed was changed."""
        return bool(self.state.counts[0])

    @property
    def samples_silenced(self) -> int:
        """Since the beginning, because they were not finite."""
        return int(self.state.counts[1])

    def process(self, block: FloatArray) -> None:
        """Limit a block in place."""
        limit(self.state, block)


@compiled
def limit(state: LimiterState, block: FloatArray) -> None:
    """Limit a block (channel, block_size) in place."""
    is_changed, silenced = _limit(state, block, np.float32(state.ceiling), np.float32(state.safe))
    state.counts[0] = is_changed or silenced > 0
    state.counts[1] += silenced


@compiled
def _limit(state: LimiterState, block: FloatArray, ceiling: np.float32, safe: np.float32) -> tuple[bool, int]:
    """Whether it would have been too loud, and how many samples were silenced."""
    signal, peak, gain = state.signal, state.peak, state.gain
    channels, size = block.shape
    before = signal.shape[1] - size
    silenced = 0
    is_loud = not _is_within(signal[:, :before], safe)
    if not _is_within(block, safe):
        is_loud = True
        # guard: what is not finite never leaves
        silenced = _silence_what_is_not_finite(block)
    gain[0] = gain[-1]
    if is_loud:
        signal[:, before:] = block
        _find_peaks(signal, state.table, peak)
        is_loud = bool(np.max(peak) > ceiling)
    for channel in range(channels):
        signal[channel, :before] = block[channel, size - before :]
    if not is_loud and gain[0] == 1:
        return False, silenced
    if not is_loud:
        peak[:] = 0
    _follow(peak, ceiling, state.keep, state.hold, gain, state.held)
    rise = np.arange(1, _STEP + 1) / _STEP
    for step in range(gain.size - 1):
        at = step * _STEP
        line = (gain[step] + (gain[step + 1] - gain[step]) * rise).astype(np.float32)
        if step == 0:
            # guard: a peak at the beginning of a block is held
            line = np.minimum(line, ceiling / np.maximum(peak[:_STEP], ceiling))
        for channel in range(channels):
            block[channel, at : at + _STEP] *= line
    return True, silenced


@compiled
def _is_within(samples: FloatArray, limit: np.float32) -> bool:
    """Whether none is beyond; what is no number is."""
    beyond = 0
    for channel in range(samples.shape[0]):
        for value in samples[channel]:
            beyond += not abs(value) <= limit
    return beyond == 0


@compiled
def _interpolate(samples: FloatArray, taps: FloatArray, out: FloatArray) -> None:
    """out[i] = sum over k of taps[k] samples[i + k]"""
    out[:] = 0
    for k in range(taps.size):
        tap, from_k = taps[k], samples[k:]
        for i in range(out.size):
            out[i] += tap * from_k[i]


@compiled
def _raise_to(samples: FloatArray, peak: FloatArray) -> None:
    """Have `peak` be no less than the magnitude of any sample."""
    for i in range(peak.size):
        peak[i] = max(peak[i], abs(samples[i]))


@compiled
def _silence_what_is_not_finite(block: FloatArray) -> int:
    silenced = 0
    for channel in range(block.shape[0]):
        is_finite = np.isfinite(block[channel])
        silenced += is_finite.size - np.sum(is_finite)
        block[channel] = np.where(is_finite, block[channel], np.float32(0))
    return silenced


@compiled
def _find_peaks(signal: FloatArray, table: FloatArray, peak: FloatArray) -> None:
    """(sample,) the loudest of both channels at a sample, and between it and its neighbours as far as those are
    known."""
    size = peak.size
    ahead = _TAPS // 2
    between = np.zeros(size, np.float32)  # after the samples from `ahead` before the block on
    read = np.zeros(size, np.float32)
    peak[:] = 0
    for channel in range(signal.shape[0]):
        _raise_to(signal[channel, signal.shape[1] - size :], peak)
        for phase in range(table.shape[0]):
            _interpolate(signal[channel], table[phase], read)
            _raise_to(read, between)
    known = size - ahead
    peak[:known] = np.maximum(peak[:known], between[ahead:])
    peak[: known + 1] = np.maximum(peak[: known + 1], between[ahead - 1 :])


@compiled
def _follow(peak: FloatArray, ceiling: np.float32, keep: float, hold: int, gain: DoubleArray, held: IntArray) -> None:
    """The gain at the ends of steps, from what it is at the beginning."""
    steps = gain.size - 1
    for step in range(steps):
        allowed = float(ceiling) / max(float(ceiling), float(np.max(peak[step * _STEP : (step + 1) * _STEP])))
        gain[step + 1] = allowed
        if step > 0:
            gain[step] = min(gain[step], allowed)
    fall = _STEP / _ATTACK
    for step in range(steps - 1, 0, -1):
        gain[step] = min(gain[step], gain[step + 1] + fall)
    for step in range(steps):
        if gain[step + 1] < min(1.0, _AGAIN * gain[step]):
            held[0] = 0
        else:
            held[0] += 1
        gain[step + 1] = min(gain[step + 1], gain[step] if held[0] < hold else 1 - (1 - gain[step]) * keep)
    # guard: a gain that recovers gets there
    if gain[steps] > 1 - _AT_REST:
        gain[steps] = 1
