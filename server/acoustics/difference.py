"""Audible difference of two impulse responses of the same pair of places, in just-noticeable differences (JND).

Responses are (channel, sample) of one microphone or two ears. Both have the same sample rate and length, and sample 0
is the same moment. Thresholds are those of `server.acoustics.audibility`.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import JND_THRESHOLDS, ratio_in_jnd
from server.acoustics.decibels import power_to_db
from server.acoustics.room_parameters import DIRECT_SOUND_S, RoomParameters, measure

_Floats = npt.NDArray[np.float64]

MOST_JND = 100.0
"""Largest difference reported, for instance where one response is silent."""

_LEAD_S = 0.001
_EARLY_S = 0.050
_SILENCE = 1e-12  # of a direct sound at a metre
_THIRDS_HZ = 1000 * 2 ** (np.arange(-9, 14) / 3)
_AUDIBLE_BAND_DB = 30.0  # under the loudest third of an octave, in proportion to its width
# A decay time is compared only below these DRRs. Above them the direct sound dominates the first 10 dB of the decay
# (EDT), or the reverberation is too weak to measure (T60).
_DECAY_DRR_DB = {"edt": 8.0, "t60": 21.0}


def audible_difference(
    reference: npt.ArrayLike, other: npt.ArrayLike, sample_rate: int, *, onset_s: float
) -> dict[str, float]:
    """Difference by parameter, in JND: `level`, `spectrum`, `drr`, `c50`; `edt` and `t60` if both responses have them;
    and with two ears `iacc`, `itd`, `ild`. Each is that of the ear that differs more.

    `onset_s` is when the direct sound arrives by geometry. Raises ValueError for responses that are not finite or
    differ in shape.
    """
    pair = [np.asarray(response, dtype=np.float64) for response in (reference, other)]
    if pair[0].shape != pair[1].shape or pair[0].ndim != 2:
        raise ValueError(f"responses of {pair[0].shape} and {pair[1].shape} cannot be compared")
    energies = [np.sum(response**2, axis=-1) + _SILENCE for response in pair]
    levels_db = [power_to_db(energy) for energy in energies]
    differences = {
        "level": _most(levels_db[1] - levels_db[0], "level"),
        "spectrum": _spectral_difference(pair[0], pair[1], sample_rate) / JND_THRESHOLDS["spectrum"].amount,
    }
    ratios_db = {}
    for name, until_s in (("drr", DIRECT_SOUND_S), ("c50", _EARLY_S)):
        ratios_db[name] = [_ratio_db(response, sample_rate, onset_s, until_s) for response in pair]
        places = [ratio_in_jnd(name, ratio_db) for ratio_db in ratios_db[name]]
        differences[name] = float(np.max(np.abs(places[1] - places[0])))
    onset = round(onset_s * sample_rate)
    measured = [measure(response, sample_rate, onset=np.full(len(response), onset)) for response in pair]
    for name, limit_db in _DECAY_DRR_DB.items():
        if max(float(ratio_db.max()) for ratio_db in ratios_db["drr"]) < limit_db:
            before, after = (_decay_s(parameters, name) for parameters in measured)
            differences[name] = _most(100 * (after / before - 1), name)
    if len(pair[0]) == 2:
        ild_db = [level_db[0] - level_db[1] for level_db in levels_db]
        iacc = [parameters.interaural_cross_correlation for parameters in measured]
        itd_us = [1e6 * parameters.interaural_time_difference_s for parameters in measured]
        differences["ild"] = _most(ild_db[1] - ild_db[0], "ild")
        differences["iacc"] = _most(iacc[1] - iacc[0], "iacc")
        differences["itd"] = _most(itd_us[1] - itd_us[0], "itd")
    return {name: min(jnd, MOST_JND) for name, jnd in differences.items() if np.isfinite(jnd)}


def _most(difference: npt.ArrayLike, name: str) -> float:
    """The greatest difference over the ears, in JND; NaN if one of them cannot be measured."""
    return float(np.max(np.abs(np.asarray(difference)))) / JND_THRESHOLDS[name].amount


def _decay_s(parameters: RoomParameters, name: str) -> _Floats:
    return parameters.early_decay_time_s if name == "edt" else parameters.reverberation_time_s


def _ratio_db(response: _Floats, sample_rate: int, onset_s: float, until_s: float) -> _Floats:
    """(channel,) ratio in dB of the energy up to `until_s` after the onset to the energy after that."""
    start = max(0, round((onset_s - _LEAD_S) * sample_rate))
    stop = round((onset_s + until_s) * sample_rate)
    first, rest = (np.sum(part**2, axis=-1) + _SILENCE for part in (response[:, start:stop], response[:, stop:]))
    return power_to_db(first / rest)


def _spectral_difference(reference: _Floats, other: _Floats, sample_rate: int) -> float:
    """Greatest level difference in dB over all audible third-octave bands."""
    frequency = np.fft.rfftfreq(reference.shape[-1], 1 / sample_rate)
    thirds_hz = _THIRDS_HZ[sample_rate / 2 > _THIRDS_HZ * 2 ** (1 / 6)]
    edges_hz = thirds_hz[:, None] * np.array([2 ** (-1 / 6), 2 ** (1 / 6)])
    bounds = np.searchsorted(frequency, edges_hz)
    wide = bounds[:, 1] > bounds[:, 0]
    spectra = []
    for response in (reference, other):
        power = np.abs(np.fft.rfft(response)) ** 2
        below = np.concatenate([np.zeros((len(power), 1)), np.cumsum(power, axis=-1)], axis=-1)
        width = np.maximum(bounds[:, 1] - bounds[:, 0], 1)
        spectra.append(power_to_db((below[:, bounds[:, 1]] - below[:, bounds[:, 0]]) / width + _SILENCE))
    loudest_db = np.max(np.maximum(*spectra), axis=-1, keepdims=True)
    is_audible = (np.maximum(*spectra) > loudest_db - _AUDIBLE_BAND_DB) & wide
    return float(np.max(np.where(is_audible, np.abs(spectra[1] - spectra[0]), 0.0)))
