"""The peak limiter, the last step before output. It changes a block only if the block would be too loud for a
converter.

All channels get the same gain, so that nothing seems to move. Peaks are true peaks: they include the signal between
samples, which a converter reconstructs, estimated at four times the sample rate as in ITU-R BS.1770-4, Annex 2. A block
below the ceiling passes unchanged to the last bit.

The limiter adds no latency, so it looks ahead only to the end of its block. The gain falls early enough for a peak
within the block, by at most 1 over `_ATTACK` samples. If a block begins with a peak, the gain falls as fast as needed,
and samples are clipped to the ceiling until it is low enough. The signal between the last sample of a block and the
first of the next is known only with the next block; a slowly recovering gain keeps these peaks small while sound
continues. The gain stays down for about a period of the lowest tones before it recovers, so that they are not
distorted.

Samples that are not finite are replaced by silence. Earlier stages should never produce any; this protects loudspeakers
if one does.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from server.kernels.by_reference import Reference
from server.kernels.compiled import compiled
from server.kernels.copying import copy

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CEILING = 10 ** (-1 / 20)
"""-1 dB of full scale, true peak: the maximum permitted by EBU R 128, with headroom for codecs and resamplers."""

_TAPS = 16
_KAISER_BETA = 6.0
_PHASES = 3  # between two samples
_STEP = 16
"""Samples between two points of the gain curve, which is a straight line between them."""
_ATTACK = 64
_HOLD_S = 0.02
_AGAIN = 1.01
"""A peak that allows less than this factor times the current gain restarts the hold time."""
_RELEASE_S = 0.2
_AT_REST = 1e-5
"""When the gain is this close to 1, it is set to 1: a difference of a ten-thousandth of a decibel."""


def _interpolators() -> FloatArray:
    """(phase, tap) filters for the points a quarter, a half and three quarters of a sample after tap `_TAPS` / 2 -
    1."""
    offset = np.arange(_TAPS) - (_TAPS // 2 - 1) - np.arange(1, _PHASES + 1)[:, None] / (_PHASES + 1)
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1 - (offset / (_TAPS / 2)) ** 2)))
    rows = np.sinc(offset) * window
    return np.asarray(rows / rows.sum(axis=-1, keepdims=True), np.float32)


class LimiterState(NamedTuple):
    """Everything that `limit` reads and writes."""

    signal: FloatArray  # (channel, sample) the end of the previous block, then the current block
    table: FloatArray  # (phase, tap)
    peak: FloatArray  # (sample,)
    gain: DoubleArray  # at the ends of steps
    held: IntArray  # (1,) steps since a peak last needed a lower gain
    counts: IntArray  # (2,) whether the last block was changed; samples silenced so far
    ceiling: float
    safe: float
    keep: float
    hold: int


class Limiter:
    """Limits blocks (channels, block_size), whose size must be a multiple of 16. `state` can be passed to compiled
    code."""

    def __init__(self, *, channels: int, block_size: int, sample_rate: int, ceiling: float = CEILING) -> None:
        if block_size % _STEP or not 0 < ceiling < math.inf:
            raise ValueError(f"blocks are multiples of {_STEP} samples, and a ceiling is above 0 and finite")
        table = _interpolators()
        state = LimiterState(
            signal=np.zeros((channels, _TAPS - 1 + block_size), np.float32),
            table=table,
            peak=np.zeros(block_size, np.float32),
            # Double precision: in single precision, the end of a slow release is lost to rounding, and the release
            # never ends.
            gain=np.ones(block_size // _STEP + 1),
            held=np.zeros(1, np.int64),
            counts=np.zeros(2, np.int64),
            ceiling=float(np.float32(ceiling)),
            # A signal below this level cannot reach the ceiling between samples, whatever its phases.
            safe=float(np.float32(ceiling / np.abs(table).sum(axis=-1).max())),
            keep=math.exp(-_STEP / (_RELEASE_S * sample_rate)),
            hold=round(_HOLD_S * sample_rate / _STEP),
        )
        self.state: Any = Reference(state)

    def reset(self) -> None:
        """Forget the gain and all earlier samples."""
        for array in (self.state.signal, self.state.held, self.state.counts):
            array.fill(0)
        self.state.gain.fill(1)

    @property
    def acted(self) -> bool:
        """Whether the last block was changed."""
        return bool(self.state.counts[0])

    @property
    def samples_silenced(self) -> int:
        """How many samples so far were replaced by silence because they were not finite."""
        return int(self.state.counts[1])

    def process(self, block: FloatArray) -> None:
        """Limit a block in place."""
        limit(self.state, block)


ANY_LIMITER: Final[Reference] = Limiter(channels=1, block_size=_STEP, sample_rate=48_000).state
"""Of no output: tells compiled code what a state is, also where there is no limiter. Compiled for both, everything that
renders would be compiled twice."""


@compiled
def limit(state: LimiterState, block: FloatArray) -> None:
    """Limit a block (channel, block_size) in place."""
    is_changed, silenced = _limit(state, block, np.float32(state.ceiling), np.float32(state.safe))
    state.counts[0] = is_changed or silenced > 0
    state.counts[1] += silenced


@compiled
def _limit(state: LimiterState, block: FloatArray, ceiling: np.float32, safe: np.float32) -> tuple[bool, int]:
    """Limit a block in place. Returns whether it would have been too loud, and how many samples were silenced."""
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
        for channel in range(channels):
            copy(block[channel], signal[channel, before:])
        _find_peaks(signal, state.table, peak)
        is_loud = bool(_largest(peak) > ceiling)
    for channel in range(channels):
        copy(block[channel, size - before :], signal[channel])
    if not is_loud and gain[0] == 1:
        return False, silenced
    if not is_loud:
        peak[:] = 0
    _follow(peak, ceiling, state.keep, state.hold, gain, state.held)
    for step in range(gain.size - 1):
        change = gain[step + 1] - gain[step]
        for n in range(_STEP):
            factor = np.float32(gain[step] + change * ((n + 1) / _STEP))
            if step == 0:
                # guard: a peak at the beginning of a block is held
                factor = min(factor, ceiling / max(peak[n], ceiling))
            for channel in range(channels):
                block[channel, step * _STEP + n] *= factor
    return True, silenced


@compiled
def _largest(values: FloatArray) -> Any:
    largest = values[0]
    for value in values:
        largest = max(largest, value)
    return largest


@compiled
def _is_within(samples: FloatArray, limit: np.float32) -> bool:
    """Whether the magnitudes of all samples are within the limit; a NaN is not."""
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
    """Raise each value of `peak` to at least the magnitude of the sample."""
    for i in range(peak.size):
        peak[i] = max(peak[i], abs(samples[i]))


@compiled
def _silence_what_is_not_finite(block: FloatArray) -> int:
    silenced = 0
    for channel in range(block.shape[0]):
        for n in range(block.shape[1]):
            if not np.isfinite(block[channel, n]):
                silenced += 1
                block[channel, n] = 0
    return silenced


@compiled
def _find_peaks(signal: FloatArray, table: FloatArray, peak: FloatArray) -> None:
    """Write to `peak` (sample,) the largest magnitude over all channels, at each sample and between it and its
    neighbours, as far as these are known."""
    size = peak.size
    ahead = _TAPS // 2
    between = np.zeros(size, np.float32)  # starts `ahead` samples before the block
    read = np.zeros(size, np.float32)
    peak[:] = 0
    for channel in range(signal.shape[0]):
        _raise_to(signal[channel, signal.shape[1] - size :], peak)
        for phase in range(table.shape[0]):
            _interpolate(signal[channel], table[phase], read)
            _raise_to(read, between)
    known = size - ahead
    _raise_to(between[ahead:], peak[:known])
    _raise_to(between[ahead - 1 :], peak[: known + 1])


@compiled
def _follow(peak: FloatArray, ceiling: np.float32, keep: float, hold: int, gain: DoubleArray, held: IntArray) -> None:
    """Compute the gain at the ends of steps from the gain at the beginning of the block."""
    steps = gain.size - 1
    for step in range(steps):
        allowed = float(ceiling) / max(float(ceiling), float(_largest(peak[step * _STEP : (step + 1) * _STEP])))
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
