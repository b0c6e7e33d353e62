"""Room acoustic parameters of impulse responses.

Axes: impulse responses are `(..., channel, sample)`, channel 0 = left; every leading axis is a batch. Results are
float64 in seconds or dB, one per channel, or one per response if two ears are compared. All are broadband.

Each function raises `UnmeasurableError` if the parameter of one of the responses cannot be measured. `measure` computes
all parameters of large batches and marks such entries as missing instead.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.decay import ONSET_THRESHOLD_DB, EnergyDecay, energy_decay, onset_sample
from server.acoustics.decibels import power_to_db
from server.acoustics.fast_length import next_fast_length

__all__ = [
    "ONSET_THRESHOLD_DB",
    "RoomParameters",
    "UnmeasurableError",
    "clarity_db",
    "direct_to_reverberant_db",
    "early_decay_time_s",
    "energy_decay_db",
    "interaural_cross_correlation",
    "interaural_time_difference_s",
    "level_db",
    "measure",
    "onset_sample",
    "reverberation_time_s",
]

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

# The direct sound lasts until 2.5 ms after the largest sample near its expected arrival (Zahorik, J. Acoust. Soc. Am.
# 112, 2110, 2002). The lead covers the rise of an HRIR to its peak.
DIRECT_SOUND_S = 0.0025
DIRECT_LEAD_S = 0.001
DIRECT_SEARCH_S = 0.003
_DIRECT_PEAK_S = 0.001
"""Longest time from the onset of the direct sound to its largest sample. At the far ear an early reflection soon after
may be louder."""
BETWEEN_EARS_S = 0.001
"""Part of the direct sound, after its peak at the nearer ear, that the ITD is measured in. Reflections follow it."""
LAG_LIMIT_S = 0.001  # ISO 3382-1 B.2: interaural lags within +-1 ms
EARLY_S = 0.080  # ISO 3382-1 B.2: IACC early
CLARITY_S = 0.050  # ISO 3382-1 A.2.3: C50
START_DB = -5.0  # ISO 3382-1 5.3.3: where the evaluation of a reverberation time begins
DECAY_DB = 30.0
"""The fall of the decay curve that reverberation times are measured over: T30."""
EARLY_DECAY_DB = 10.0  # ISO 3382-1 A.2.2
LOWPASS_HZ = 3000.0  # Katz and Noisternig, J. Acoust. Soc. Am. 135, 3530, 2014
_UPSAMPLING = 16


class UnmeasurableError(ValueError):
    """The parameter cannot be measured: the response is silent, too short, too noisy or lacks the energy in
    question."""


@dataclass(frozen=True)
class RoomParameters:
    """Parameters of a batch of responses. NaN marks an entry that cannot be measured; `missing` counts them.

    Shapes are `(..., channel)`. The last three compare two ears: they are `(...)`, and NaN for one channel.
    """

    onset_s: _Floats
    level_db: _Floats
    reverberation_time_s: _Floats
    early_decay_time_s: _Floats
    clarity_db: _Floats
    direct_to_reverberant_db: _Floats
    interaural_cross_correlation: _Floats
    early_interaural_cross_correlation: _Floats
    interaural_time_difference_s: _Floats

    def missing(self) -> dict[str, int]:
        return {name: int(np.isnan(values).sum()) for name, values in vars(self).items()}


def measure(
    ir: npt.ArrayLike, sample_rate: float, *, decay_db: float = DECAY_DB, onset: npt.ArrayLike | None = None
) -> RoomParameters:
    """All parameters of responses to one microphone or to two ears, `(..., channel, sample)`.

    `onset` `(..., channel)`, in samples, is the expected arrival of the direct sound to within 3 ms, from geometry or
    from a reference. The direct-to-reverberant ratio and the interaural time difference need it; without it the onset
    is detected. Raises ValueError for other numbers of channels and for values that are not finite.
    """
    responses = np.asarray(ir)
    if responses.ndim < 2 or responses.shape[-2] not in {1, 2}:
        raise ValueError(f"a response has one channel or is binaural, not {responses.shape}")
    binaural = responses.shape[-2] == 2
    between_ears = np.full(responses.shape[:-2], np.nan)
    decay = energy_decay(responses, sample_rate)
    direct = _direct_sample(responses, decay.onset if onset is None else onset, sample_rate)
    return RoomParameters(
        onset_s=np.where(decay.onset >= 0, decay.onset / sample_rate, np.nan),
        level_db=_level_db(responses),
        reverberation_time_s=_decay_time_s(decay, sample_rate, START_DB, START_DB - decay_db),
        early_decay_time_s=_decay_time_s(decay, sample_rate, 0.0, -EARLY_DECAY_DB),
        clarity_db=_clarity_db(decay, sample_rate, CLARITY_S),
        direct_to_reverberant_db=_direct_to_reverberant_db(responses, decay, direct, sample_rate, DIRECT_SOUND_S),
        interaural_cross_correlation=(
            _iacc(responses, decay.onset, sample_rate, 0.0, None) if binaural else between_ears
        ),
        early_interaural_cross_correlation=(
            _iacc(responses, decay.onset, sample_rate, 0.0, EARLY_S) if binaural else between_ears
        ),
        interaural_time_difference_s=_itd_s(responses, direct, sample_rate) if binaural else between_ears,
    )


def energy_decay_db(ir: npt.ArrayLike, sample_rate: float) -> _Floats:
    """Energy decay curve `(..., channel, sample)`, 0 dB at the onset, -inf after the end of the response."""
    decay = energy_decay(ir, sample_rate)
    _require(decay.onset >= 0, "energy decay: the response is silent")
    start = np.take_along_axis(decay.energy, decay.onset[..., np.newaxis], axis=-1)
    return power_to_db(decay.energy / start)


def reverberation_time_s(ir: npt.ArrayLike, sample_rate: float, *, decay_db: float = DECAY_DB) -> _Floats:
    """Reverberation time `(..., channel)`: least squares line through the decay curve from -5 dB down by `decay_db`.

    30 dB gives T30, 20 dB gives T20, both extrapolated to 60 dB (ISO 3382-1:2009, 5.3.3). A response whose curve does
    not reach the lower limit 10 dB above the noise is unmeasurable; a shorter range is never used instead.
    """
    decay = energy_decay(ir, sample_rate)
    values = _decay_time_s(decay, sample_rate, START_DB, START_DB - decay_db)
    known = f"the decay is known down to {np.max(decay.lowest_db):.1f} dB only"
    return _present(values, f"T{decay_db:g}: needs {START_DB - decay_db:g} dB of decay; {known}")


def early_decay_time_s(ir: npt.ArrayLike, sample_rate: float) -> _Floats:
    """Early decay time `(..., channel)`: the line from 0 to -10 dB, extrapolated to 60 dB (ISO 3382-1:2009, A.2.2)."""
    values = _decay_time_s(energy_decay(ir, sample_rate), sample_rate, 0.0, -EARLY_DECAY_DB)
    return _present(values, "EDT: the curve has no slope from 0 to -10 dB above the noise")


def clarity_db(ir: npt.ArrayLike, sample_rate: float, *, early_s: float = CLARITY_S) -> _Floats:
    """Early-to-late index `(..., channel)`: C50, or C80 with `early_s` = 0.080 (ISO 3382-1:2009, A.2.3)."""
    values = _clarity_db(energy_decay(ir, sample_rate), sample_rate, early_s)
    return _present(values, f"clarity: no energy later than {early_s * 1e3:g} ms, or none earlier")


def direct_to_reverberant_db(
    ir: npt.ArrayLike, sample_rate: float, *, onset: npt.ArrayLike | None = None, direct_s: float = DIRECT_SOUND_S
) -> _Floats:
    """Direct-to-reverberant energy ratio `(..., channel)`.

    The direct sound lasts from 1 ms before its peak to `direct_s` after it; everything later is reverberation. The peak
    is sought within 3 ms of `onset`, in samples, which broadcasts to `(..., channel)`. Without `onset` the first
    arrival is taken, which is right only if that is the direct sound.
    """
    responses = np.asarray(ir)
    decay = energy_decay(responses, sample_rate)
    direct = _direct_sample(responses, decay.onset if onset is None else onset, sample_rate)
    values = _direct_to_reverberant_db(responses, decay, direct, sample_rate, direct_s)
    return _present(values, "direct-to-reverberant ratio: no direct sound, or nothing after it")


def level_db(ir: npt.ArrayLike) -> _Floats:
    """Energy of the response `(..., channel)` in dB re 1."""
    return _present(_level_db(np.asarray(ir)), "level: the response is silent")


def interaural_cross_correlation(
    ir: npt.ArrayLike, sample_rate: float, *, start_s: float = 0.0, end_s: float | None = None
) -> _Floats:
    """Interaural cross-correlation coefficient `(...)` of binaural responses, 0 to 1 (ISO 3382-1:2009, B.2).

    It is the largest magnitude of the normalised interaural cross-correlation function within +-1 ms. Time counts from
    the earlier of the two onsets: `end_s` = 0.080 gives IACC early, `start_s` = 0.080 IACC late.
    """
    responses = _binaural(ir)
    values = _iacc(responses, onset_sample(responses), sample_rate, start_s, end_s)
    return _present(values, "interaural cross-correlation: an ear is silent in this interval")


def interaural_time_difference_s(
    ir: npt.ArrayLike, sample_rate: float, *, onset: npt.ArrayLike | None = None
) -> _Floats:
    """Interaural time difference `(...)` of the direct sound, within +-1 ms; positive when the left ear leads.

    It is the lag of the largest interaural cross-correlation of the direct sound below 3 kHz (Katz and Noisternig
    2014), to a fraction of a sample.
    """
    responses = _binaural(ir)
    direct = _direct_sample(responses, onset_sample(responses) if onset is None else onset, sample_rate)
    return _present(_itd_s(responses, direct, sample_rate), "interaural time difference: an ear hears no direct sound")


def _require(condition: npt.ArrayLike, reason: str) -> None:
    holds = np.asarray(condition)
    if not holds.all():
        raise UnmeasurableError(f"{reason} ({holds.size - int(holds.sum())} of {holds.size})")


def _present(values: _Floats, reason: str) -> _Floats:
    # guard: a parameter that is missing is told
    _require(~np.isnan(values), reason)
    return values


def _binaural(ir: npt.ArrayLike) -> npt.NDArray[np.generic]:
    responses = np.asarray(ir)
    if responses.ndim < 2 or responses.shape[-2] != 2:
        raise ValueError(f"a binaural response is (..., 2, sample), not {responses.shape}")
    return responses


def _direct_sample(responses: npt.NDArray[np.generic], onset: npt.ArrayLike, sample_rate: float) -> _Integers:
    """`(..., channel)` index of the peak of the first sound within 3 ms of the expected onset; -1 if there is none."""
    expected = np.broadcast_to(np.asarray(onset, dtype=np.int64), responses.shape[:-1]).reshape(-1)
    reach, length = round(DIRECT_SEARCH_S * sample_rate), round(_DIRECT_PEAK_S * sample_rate)
    peaks = np.full(len(expected), -1)
    for row, (at, response) in enumerate(zip(expected, responses.reshape(len(expected), -1), strict=True)):
        start = max(int(at) - reach, 0)
        nearby = np.abs(response[start : int(at) + reach + 1])
        # guard: direct sound is sought where there are samples
        if at >= 0 and len(nearby) and nearby.max() > 0.0:
            first = int(onset_sample(nearby))
            peaks[row] = start + first + int(np.argmax(nearby[first : first + length + 1]))
    return peaks.reshape(responses.shape[:-1])


def _level_db(responses: npt.NDArray[np.generic]) -> _Floats:
    # guard: levels are squared in double precision
    levels = power_to_db(np.square(responses, dtype=np.float64).sum(axis=-1))
    # guard: silence has no level
    return np.where(np.isfinite(levels), levels, np.nan)


def _rows(decay: EnergyDecay) -> tuple[_Floats, _Integers]:
    return decay.energy.reshape(-1, decay.energy.shape[-1]), decay.onset.reshape(-1)


def _decay_time_s(decay: EnergyDecay, sample_rate: float, upper_db: float, lower_db: float) -> _Floats:
    energy, onset = _rows(decay)
    times = np.full(len(energy), np.nan)
    # guard: a decay is measured as far as it is known
    for row in np.flatnonzero((onset >= 0) & (decay.lowest_db.reshape(-1) <= lower_db)):
        curve = energy[row, onset[row] :]
        rising = curve[::-1]  # searchsorted needs a rising curve
        start = len(curve) - int(np.searchsorted(rising, curve[0] * 10.0 ** (upper_db / 10.0), side="right"))
        stop = len(curve) - int(np.searchsorted(rising, curve[0] * 10.0 ** (lower_db / 10.0), side="left"))
        count = stop - start
        # guard: two points make a line
        if count < 2:
            continue
        centred = np.arange(count) - (count - 1) / 2.0
        slope = float(centred @ power_to_db(curve[start:stop])) / (count * (count * count - 1) / 12.0)
        # guard: what does not fall has no reverberation time
        if slope < 0.0:
            times[row] = -60.0 / (slope * sample_rate)
    return times.reshape(decay.onset.shape)


def _clarity_db(decay: EnergyDecay, sample_rate: float, early_s: float) -> _Floats:
    energy, onset = _rows(decay)
    values = np.full(len(energy), np.nan)
    split = onset + round(early_s * sample_rate)
    for row in np.flatnonzero((onset >= 0) & (split < energy.shape[-1])):
        late = energy[row, split[row]]
        early = energy[row, onset[row]] - late
        # guard: clarity needs early and late energy
        if early > 0.0 and late > 0.0:
            values[row] = power_to_db(early / late)
    return values.reshape(decay.onset.shape)


def _direct_to_reverberant_db(
    responses: npt.NDArray[np.generic], decay: EnergyDecay, direct_at: _Integers, sample_rate: float, direct_s: float
) -> _Floats:
    energy, _ = _rows(decay)
    rows = responses.reshape(energy.shape)
    values = np.full(len(energy), np.nan)
    lead, length = round(DIRECT_LEAD_S * sample_rate), round(direct_s * sample_rate)
    for row, at in enumerate(direct_at.reshape(-1)):
        stop = int(at) + length
        # guard: what follows the direct sound is within the response
        if at < 0 or stop >= energy.shape[-1]:
            continue
        direct = np.square(rows[row, max(int(at) - lead, 0) : stop], dtype=np.float64).sum()
        reverberant = energy[row, stop]
        # guard: a ratio needs what is direct and what is not
        if direct > 0.0 and reverberant > 0.0:
            values[row] = power_to_db(direct / reverberant)
    return values.reshape(decay.onset.shape)


def _iacc(
    responses: npt.NDArray[np.generic], onset: _Integers, sample_rate: float, start_s: float, end_s: float | None
) -> _Floats:
    ears = responses.reshape(-1, 2, responses.shape[-1])
    starts = onset.reshape(-1, 2).min(axis=-1) + round(start_s * sample_rate)
    length = ears.shape[-1] if end_s is None else round((end_s - start_s) * sample_rate)
    lags = round(LAG_LIMIT_S * sample_rate)
    values = np.full(len(ears), np.nan)
    for row in np.flatnonzero(onset.reshape(-1, 2).min(axis=-1) >= 0):
        segment = ears[row, :, starts[row] : starts[row] + length].astype(np.float64)
        energies = np.square(segment).sum(axis=-1)
        if segment.shape[-1] == 0 or energies.min() <= 0.0:
            continue
        size = next_fast_length(segment.shape[-1] + lags)
        left, right = np.fft.rfft(segment, size, axis=-1)
        correlation = np.fft.irfft(np.conj(left) * right, size)
        within = np.concatenate([correlation[: lags + 1], correlation[-lags:]])
        values[row] = min(float(np.abs(within).max() / np.sqrt(energies[0] * energies[1])), 1.0)
    return values.reshape(onset.shape[:-1])


def _itd_s(responses: npt.NDArray[np.generic], direct_at: _Integers, sample_rate: float) -> _Floats:
    ears = responses.reshape(-1, 2, responses.shape[-1])
    peaks = direct_at.reshape(-1, 2)
    lead, lags = round(DIRECT_LEAD_S * sample_rate), round(LAG_LIMIT_S * sample_rate)
    length = lead + round(BETWEEN_EARS_S * sample_rate) + lags
    size = next_fast_length(length + lags)
    frequencies = np.fft.rfftfreq(size, 1.0 / sample_rate)
    # The low-pass falls as a raised cosine over an octave. A steep one would ring for longer than the window.
    lowpass = 0.5 + 0.5 * np.cos(np.pi * np.clip(frequencies / LOWPASS_HZ - 1.0, 0.0, 1.0))
    values = np.full(len(ears), np.nan)
    for row, arrivals in enumerate(peaks):
        if arrivals.min() < 0:
            continue
        # The louder ear is the nearer one, and its peak is the more reliable of the two.
        nearer = int(np.argmax(np.abs(ears[row, [0, 1], arrivals])))
        start = max(int(arrivals[nearer]) - lead, 0)
        left, right = np.fft.rfft(ears[row, :, start : start + length].astype(np.float64), size, axis=-1) * lowpass
        spectrum = np.conj(left) * right
        if not np.abs(spectrum).max() > 0.0:
            continue
        correlation = np.fft.irfft(spectrum, size * _UPSAMPLING)
        reach = lags * _UPSAMPLING
        within = np.concatenate([correlation[-reach:], correlation[: reach + 1]])
        values[row] = (int(np.argmax(within)) - reach) / (sample_rate * _UPSAMPLING)
    return values.reshape(direct_at.shape[:-1])
