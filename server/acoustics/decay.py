"""Energy decay of an impulse response, by backward integration up to the end of the measurable decay.

Axes: impulse responses are `(..., sample)`; every leading axis is a batch. Energies are linear, float64.

The energy decay curve E(t) is the energy that arrives after t (Schroeder, J. Acoust. Soc. Am. 37, 409, 1965;
ISO 3382-1:2009, 5.3.3). Background noise lifts its end, and truncation bends it down. Both are estimated from powers in
10 ms windows, by iterating between a noise estimate and a line through the late decay (Lundeby et al., Acustica 81,
344, 1995). The integral stops where that line meets the noise; the noise power is subtracted (Chu, J.
Acoust. Soc. Am. 63, 1444, 1978) and the energy of the exponential beyond the end is added, the combination that Guski
and Vorlander (Acta Acust. 100, 320, 2014) found least biased.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import db_to_power, power_to_db

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

ONSET_THRESHOLD_DB = -20.0
_WINDOW_S = 0.010
_TAIL_SHARE = 0.1  # the part of the response that serves as the first noise estimate
NOISE_MARGIN_DB = 10.0  # ISO 3382-1 5.3.3: noise at least 10 dB below the range that is evaluated
_FIT_RANGE_DB = 20.0
_NOTHING_DB = -120.0  # relative to the largest sample; below it, float16 storage leaves only rounding errors
_NOISE_EXCESS = 1.25  # ratio of the power in the tail to the power of the fitted decay
_ITERATIONS = 5


@dataclass(frozen=True)
class EnergyDecay:
    """The energy decay curves of a batch of responses.

    energy: (..., sample), never rising. onset: (...), in samples; -1 where the response is silent.

    lowest_db: (...), the level relative to the onset down to which the curve may be evaluated. It is 10 dB above the
    noise, or the level at the end of the response if there is no noise. If no decay can be distinguished from noise,
    the whole response counts as noise with the level of its end; a response that is noise throughout has 0.
    """

    energy: _Floats
    onset: _Integers
    lowest_db: _Floats


def onset_sample(ir: npt.ArrayLike, *, threshold_db: float = ONSET_THRESHOLD_DB) -> _Integers:
    """(...) the first sample within `threshold_db` of the largest (ISO 3382-1:2009, A.3.4: 20 dB); -1 where the
    response is silent.

    Raises ValueError for a response that is empty or not finite.
    """
    magnitude = np.abs(np.asarray(ir))
    # guard: responses without samples are not measured
    if magnitude.shape[-1] == 0:
        raise ValueError("an impulse response needs at least one sample")
    peak = magnitude.max(axis=-1)
    # guard: responses that are not finite are not measured
    if not np.all(np.isfinite(peak)):  # max propagates NaN
        raise ValueError("the impulse response has samples that are not finite")
    threshold = peak * np.float64(10.0 ** (threshold_db / 20.0))
    first = np.argmax(magnitude >= threshold[..., np.newaxis], axis=-1)
    # guard: what is silent has no onset
    return np.where(peak > 0.0, first, -1).astype(np.int64)


def energy_decay(ir: npt.ArrayLike, sample_rate: float) -> EnergyDecay:
    """The energy decay of each response `(..., sample)`; before the onset the curve is flat.

    Raises ValueError for a response that is empty or not finite.
    """
    responses = np.asarray(ir)
    shape = responses.shape
    onset = onset_sample(responses).reshape(-1)
    # guard: energies are squared in double precision
    power = np.square(responses.reshape(-1, shape[-1]), dtype=np.float64)
    end, noise, beyond, lowest_power = _ends(power, onset, max(1, round(_WINDOW_S * sample_rate)))

    for row in range(len(power)):
        power[row, end[row] :] = 0.0
        if noise[row] > 0.0:
            power[row, : end[row]] -= noise[row]
    energy = np.cumsum(power[:, ::-1], axis=-1)[:, ::-1]
    for row in range(len(energy)):
        energy[row, : end[row]] += beyond[row]
        if noise[row] > 0.0:  # subtracting noise can make the curve rise locally
            # guard: a decay curve that noise was taken off never rises
            energy[row] = np.maximum.accumulate(energy[row, ::-1])[::-1]
        start = max(onset[row], 0)
        energy[row, :start] = energy[row, start]
    total = energy[np.arange(len(energy)), np.maximum(onset, 0)]
    with np.errstate(invalid="ignore", divide="ignore"):
        lowest_db = np.where(total > 0.0, power_to_db(lowest_power / total), 0.0)
    return EnergyDecay(energy.reshape(shape), onset.reshape(shape[:-1]), np.minimum(lowest_db, 0.0).reshape(shape[:-1]))


def _ends(power: _Floats, onset: _Integers, window: int) -> tuple[_Integers, _Floats, _Floats, _Floats]:
    """Find where the decay of each row `(row, sample)` of squared pressure ends.

    Returns the end of integration (samples), the noise power per sample, the energy beyond the end, and the lowest
    energy of the decay curve that may be evaluated.
    """
    rows, samples = power.shape
    audible = power > power.max(axis=-1, keepdims=True) * db_to_power(_NOTHING_DB)
    last = samples - np.argmax(audible[:, ::-1], axis=-1)  # a zero-padded response ends at its last sample
    end = last.astype(np.int64)
    noise = np.zeros(rows)
    beyond = np.zeros(rows)
    lowest = np.zeros(rows)
    blocks = samples // window
    block_power = power[:, : blocks * window].reshape(rows, blocks, window).mean(axis=-1)
    levels = power_to_db(block_power)
    for row in range(rows):
        first, stop = -(-max(int(onset[row]), 0) // window), int(last[row]) // window
        # guard: a short response has no tail
        if onset[row] < 0 or stop - first < 4:  # silent, or an impulse without a late decay
            continue
        tail = _tail(block_power[row, first:stop], levels[row, first:stop])
        if tail is None:
            # The end of the response may be noise or a truncated decay. In both cases, noise with the level of the end,
            # from the onset on, is an upper bound.
            late = block_power[row, stop - max(1, round(_TAIL_SHARE * (stop - first))) : stop].mean()
            # guard: what does not decay may be noise
            lowest[row] = late * (last[row] - onset[row]) * db_to_power(NOISE_MARGIN_DB)
            continue
        decay_per_sample = tail.decay_db / window * np.log(10.0) / 10.0
        at = last[row] / window - first - 0.5
        if tail.noise_power > 0.0:
            crossing = (tail.level_db - float(power_to_db(tail.noise_power))) / tail.decay_db
            at = min(crossing, at)
            end[row] = max(round((first + at + 0.5) * window), int(onset[row]) + 1)
        noise[row] = tail.noise_power
        beyond[row] = db_to_power(tail.level_db - tail.decay_db * at) / decay_per_sample
        # guard: a decay is told from noise with a margin
        lowest[row] = max(beyond[row], noise[row] / decay_per_sample * db_to_power(NOISE_MARGIN_DB))
    return end, noise, beyond, lowest


@dataclass(frozen=True)
class _Tail:
    """A line through the late decay of one response. Windows are counted from the first whole one after the onset."""

    level_db: float  # of the line at window 0
    decay_db: float  # fall per window, positive
    noise_power: float  # 0 if the response ends before noise is visible


def _tail(block_power: _Floats, levels_db: _Floats) -> _Tail | None:
    """The late decay, by Lundeby's iteration over windows `(window,)`; None if the late response does not decay."""
    count = _after_last(block_power > 0.0)
    if count == 0:  # all energy lies before the first whole window or after the last
        return None
    block_power, levels_db = block_power[:count], levels_db[:count]
    tail_start = count - max(1, round(_TAIL_SHARE * count))
    noise_start = tail_start
    tail: _Tail | None = None
    for _ in range(_ITERATIONS):
        observed = float(block_power[noise_start:].mean())
        reference_db = float(power_to_db(observed)) + NOISE_MARGIN_DB
        stop = _after_last(levels_db >= reference_db)
        start = min(_after_last(levels_db >= reference_db + _FIT_RANGE_DB), max(stop - 3, 0))
        line = _line(levels_db[start:stop])
        if line is None:
            return tail
        decay_db = -line[0]
        level_db = line[1] + decay_db * start
        decayed = float(db_to_power(level_db - decay_db * np.arange(noise_start, count)).mean())
        # Power above the line is noise if it exceeds the scatter of the windows.
        tail = _Tail(level_db, decay_db, observed - decayed if observed > _NOISE_EXCESS * decayed else 0.0)
        noise_from = int(np.ceil((level_db - reference_db + 2.0 * NOISE_MARGIN_DB) / decay_db))
        moved_to = max(min(noise_from, tail_start), 0)
        if moved_to == noise_start:
            break
        noise_start = moved_to
    return tail


def _after_last(condition: npt.NDArray[np.bool_]) -> int:
    hits = np.flatnonzero(condition)
    return int(hits[-1]) + 1 if len(hits) else 0


def _line(levels_db: _Floats) -> tuple[float, float] | None:
    """(slope, intercept) of a least-squares line over the window index; None if it does not fall."""
    # guard: a window of zeros has no level
    finite = np.flatnonzero(np.isfinite(levels_db))  # a window of exact zeros has no level
    # guard: a line through fewer than three windows is none
    if len(finite) < 3:
        return None
    centred = finite - finite.mean()
    levels = levels_db[finite]
    slope = float(centred @ levels / (centred @ centred))
    return (slope, float(levels.mean() - slope * finite.mean())) if slope < 0.0 else None
