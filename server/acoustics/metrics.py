"""Errors of estimated impulse responses against references.

Errors are magnitudes, one per pair of binaural responses `(...)`. Errors of per-ear parameters are averaged over the
two ears. NaN marks a pair in which the parameter could not be measured at some ear of either response; `summarise`
counts those.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.room_parameters import RoomParameters

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Metric:
    """Description of an error: its key, its label in tables, its unit, and whether it needs the direct sound."""

    name: str
    label: str
    unit: str
    needs_direct_sound: bool = False


SPECTRAL_LOSS = Metric("spectral_loss", "spectral loss", "ln")
# All errors that `parameter_errors` returns, in the order of tables.
PARAMETER_METRICS = (
    Metric("t60", "T60", "%"),
    Metric("edt", "EDT", "ms"),
    Metric("c50", "C50", "dB"),
    Metric("drr", "DRR", "dB", needs_direct_sound=True),
    Metric("iacc", "IACC", ""),
    Metric("iacc_early", "IACC early", ""),
    Metric("level", "level", "dB"),
    Metric("itd", "ITD", "us", needs_direct_sound=True),
    Metric("onset", "onset", "ms"),
)


def parameter_errors(reference: RoomParameters, estimate: RoomParameters) -> dict[str, _Floats]:
    """Error of each of PARAMETER_METRICS, `(...)`, in its unit."""

    def over_ears(reference_values: _Floats, estimated_values: _Floats) -> _Floats:
        return np.asarray(np.abs(estimated_values - reference_values).mean(axis=-1))

    relative = np.abs(estimate.reverberation_time_s / reference.reverberation_time_s - 1.0)
    return {
        "t60": np.asarray(100.0 * relative.mean(axis=-1)),
        "edt": 1e3 * over_ears(reference.early_decay_time_s, estimate.early_decay_time_s),
        "c50": over_ears(reference.clarity_db, estimate.clarity_db),
        "drr": over_ears(reference.direct_to_reverberant_db, estimate.direct_to_reverberant_db),
        "iacc": np.abs(estimate.interaural_cross_correlation - reference.interaural_cross_correlation),
        "iacc_early": np.abs(
            estimate.early_interaural_cross_correlation - reference.early_interaural_cross_correlation
        ),
        "level": over_ears(reference.level_db, estimate.level_db),
        "itd": 1e6 * np.abs(estimate.interaural_time_difference_s - reference.interaural_time_difference_s),
        "onset": 1e3 * over_ears(reference.onset_s, estimate.onset_s),
    }


def spectral_loss(reference: npt.ArrayLike, estimate: npt.ArrayLike) -> _Floats:
    """Mean absolute difference `(...)` of log-magnitude spectrograms `(..., channel, frequency, frame)`.

    Logarithms are natural, with the codec's floor, as in Luo et al. (NeurIPS 2022): 0.1 is about 0.9 dB. Raises
    ValueError if the shapes differ or a value is not finite.
    """
    reference_log, estimate_log = np.asarray(reference), np.asarray(estimate)
    if reference_log.shape != estimate_log.shape:
        raise ValueError(f"spectrograms of {reference_log.shape} and {estimate_log.shape} cannot be compared")
    loss = np.abs(estimate_log - reference_log).mean(axis=(-3, -2, -1), dtype=np.float64)
    if not np.all(np.isfinite(loss)):
        raise ValueError("a spectrogram has values that are not finite")
    return np.asarray(loss)


@dataclass(frozen=True)
class Summary:
    """Mean and median of `count` measured errors; None if there are none. `missing` errors could not be measured."""

    mean: float | None
    median: float | None
    count: int
    missing: int


def summarise(errors: npt.ArrayLike) -> Summary:
    values = np.asarray(errors, dtype=np.float64).reshape(-1)
    present = values[~np.isnan(values)]
    missing = len(values) - len(present)
    if len(present) == 0:
        return Summary(None, None, 0, missing)
    return Summary(float(present.mean()), float(np.median(present)), len(present), missing)
