"""Errors of estimated impulse responses against references.

Errors are magnitudes, one per pair of binaural responses `(...)`. Errors of per-ear parameters are averaged over the
two ears. NaN marks a pair in which the parameter could not be measured at some ear of either response; `summarise`
counts those.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from server.acoustics.decay import NOISE_MARGIN_DB, ONSET_THRESHOLD_DB
from server.acoustics.room_parameters import (
    BETWEEN_EARS_S,
    CLARITY_S,
    DECAY_DB,
    DIRECT_LEAD_S,
    DIRECT_SEARCH_S,
    DIRECT_SOUND_S,
    EARLY_DECAY_DB,
    EARLY_S,
    LAG_LIMIT_S,
    LOWPASS_HZ,
    START_DB,
    RoomParameters,
)

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Definition:
    """What a metric means, in words for tables. over: the part of the response that counts. failures: what becomes of
    pairs in which it cannot be measured."""

    formula: str
    over: str
    band: str = "all of it"
    failures: str = "left out of the mean, and counted"
    source: str


@dataclass(frozen=True)
class Metric:
    """A description of an error: its key, its label in tables, its unit, whether it needs the direct sound or two ears,
    and what it means."""

    name: str
    label: str
    unit: str
    needs_direct_sound: bool = False
    needs_two_ears: bool = False
    definition: Definition = field(kw_only=True)


@dataclass(frozen=True, kw_only=True)
class ParameterMetric(Metric):
    """The error of a room parameter; `error` takes the parameters of the reference and of the estimate."""

    error: Callable[[RoomParameters, RoomParameters], _Floats]


def _over_ears(parameter: str, *, scale: float = 1.0) -> Callable[[RoomParameters, RoomParameters], _Floats]:
    """An error function: the absolute difference of `parameter`, mean over both ears, times `scale` (1e3 gives ms for
    seconds)."""

    def error(reference: RoomParameters, estimate: RoomParameters) -> _Floats:
        difference = np.abs(getattr(estimate, parameter) - getattr(reference, parameter))
        return scale * np.asarray(difference.mean(axis=-1))

    return error


def _between_ears(parameter: str, *, scale: float = 1.0) -> Callable[[RoomParameters, RoomParameters], _Floats]:
    def error(reference: RoomParameters, estimate: RoomParameters) -> _Floats:
        return np.asarray(scale * np.abs(getattr(estimate, parameter) - getattr(reference, parameter)))

    return error


def _reverberation_time_error(reference: RoomParameters, estimate: RoomParameters) -> _Floats:
    relative = np.abs(estimate.reverberation_time_s / reference.reverberation_time_s - 1.0)
    return np.asarray(100.0 * relative.mean(axis=-1))


_MEAN = "mean over channels of the absolute difference of"
_ONSET = f"the onset, the first sample within {-ONSET_THRESHOLD_DB:g} dB of the largest"
_CURVE = (
    "backward integral of squared pressure, from which noise has been subtracted, with the energy beyond its end added "
    "(Guski and Vorlander, Acta Acust. 100, 2014)"
)
_DIRECT = f"the largest sample within {1e3 * DIRECT_SEARCH_S:g} ms of the reference's onset"

SPECTRAL_LOSS = Metric(
    "spectral_loss",
    "spectral loss",
    "ln",
    definition=Definition(
        formula="mean over channels, frequencies and frames of the absolute difference of ln(magnitude + floor)",
        over="the whole response",
        failures="there are none",
        source="Luo et al., NeurIPS 2022, whose windows and floor are others",
    ),
)
# All errors that `parameter_errors` returns, in the order of tables.
PARAMETER_METRICS = (
    ParameterMetric(
        "t60",
        "T60",
        "%",
        error=_reverberation_time_error,
        definition=Definition(
            formula="mean over channels of |T60 / T60 of the reference - 1|; T60 is 60 dB over the slope of a least "
            "squares line through the decay curve",
            over=f"{START_DB:g} to {START_DB - DECAY_DB:g} dB of the curve ({_CURVE})",
            failures=f"left out of the mean, and counted, if a curve does not fall so far {NOISE_MARGIN_DB:g} dB above "
            "the noise; never a shorter range",
            source="ISO 3382-1:2009, 5.3.3 (T30)",
        ),
    ),
    ParameterMetric(
        "edt",
        "EDT",
        "ms",
        error=_over_ears("early_decay_time_s", scale=1e3),
        definition=Definition(
            formula=f"{_MEAN} EDT; EDT is 60 dB over the slope of a least squares line",
            over=f"0 to {-EARLY_DECAY_DB:g} dB of the curve of T60, from {_ONSET}",
            source="ISO 3382-1:2009, A.2.2",
        ),
    ),
    ParameterMetric(
        "c50",
        "C50",
        "dB",
        error=_over_ears("clarity_db"),
        definition=Definition(
            formula=f"{_MEAN} C50 = 10 lg(energy until {1e3 * CLARITY_S:g} ms / energy after it)",
            over=f"from {_ONSET}, on the curve of T60",
            source="ISO 3382-1:2009, A.2.3",
        ),
    ),
    ParameterMetric(
        "drr",
        "DRR",
        "dB",
        needs_direct_sound=True,
        error=_over_ears("direct_to_reverberant_db"),
        definition=Definition(
            formula=f"{_MEAN} 10 lg(direct energy / energy of all that follows)",
            over=f"direct: from {1e3 * DIRECT_LEAD_S:g} ms before to {1e3 * DIRECT_SOUND_S:g} ms after {_DIRECT}",
            failures="left out of the mean, and counted; so are pairs out of sight, where that is known",
            source="Zahorik, J. Acoust. Soc. Am. 112, 2110 (2002)",
        ),
    ),
    ParameterMetric(
        "iacc",
        "IACC",
        "",
        needs_two_ears=True,
        error=_between_ears("interaural_cross_correlation"),
        definition=Definition(
            formula="absolute difference of IACC, the largest magnitude of the normalised interaural cross-correlation "
            f"within {1e3 * LAG_LIMIT_S:g} ms",
            over="from the earlier of two onsets to the end",
            source="ISO 3382-1:2009, B.2",
        ),
    ),
    ParameterMetric(
        "iacc_early",
        "IACC early",
        "",
        needs_two_ears=True,
        error=_between_ears("early_interaural_cross_correlation"),
        definition=Definition(
            formula="as IACC", over=f"the first {1e3 * EARLY_S:g} ms from the onset", source="ISO 3382-1:2009, B.2"
        ),
    ),
    ParameterMetric(
        "level",
        "level",
        "dB",
        error=_over_ears("level_db"),
        definition=Definition(
            formula=f"{_MEAN} 10 lg(energy)", over="the whole response", source="ISO 3382-1:2009, A.2.1 (strength G)"
        ),
    ),
    ParameterMetric(
        "itd",
        "ITD",
        "us",
        needs_direct_sound=True,
        needs_two_ears=True,
        error=_between_ears("interaural_time_difference_s", scale=1e6),
        definition=Definition(
            formula="absolute difference of ITD, the lag of the largest interaural cross-correlation within "
            f"{1e3 * LAG_LIMIT_S:g} ms, to a fraction of a sample",
            over=f"from {1e3 * DIRECT_LEAD_S:g} ms before to {1e3 * BETWEEN_EARS_S:g} ms after the peak of the direct "
            "sound at the nearer ear",
            band=f"below {LOWPASS_HZ:g} Hz",
            failures="left out of the mean, and counted; so are pairs out of sight, where that is known",
            source="Katz and Noisternig, J. Acoust. Soc. Am. 135, 3530 (2014)",
        ),
    ),
    ParameterMetric(
        "onset",
        "onset",
        "ms",
        error=_over_ears("onset_s", scale=1e3),
        definition=Definition(
            formula=f"{_MEAN} the time of {_ONSET}", over="the whole response", source="ISO 3382-1:2009, A.3.4"
        ),
    ),
)


def parameter_errors(reference: RoomParameters, estimate: RoomParameters) -> dict[str, _Floats]:
    """The error `(...)` of each of PARAMETER_METRICS, in its unit."""
    return {metric.name: metric.error(reference, estimate) for metric in PARAMETER_METRICS}


def spectral_loss(reference: npt.ArrayLike, estimate: npt.ArrayLike) -> _Floats:
    """The mean absolute difference `(...)` of log-magnitude spectrograms `(..., channel, frequency, frame)`.

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
    """The mean and median of `count` measured errors; None if there are none. `missing` is the number of errors that
    could not be measured."""

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
