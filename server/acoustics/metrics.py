"""Errors of estimated impulse responses against references.

Errors are magnitudes, one per pair of binaural responses `(...)`. Errors of per-ear parameters are averaged over the
two ears. NaN marks a pair in which the parameter could not be measured at some ear of either response; `summarise`
counts those.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.room_parameters import RoomParameters

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Metric:
    """A description of an error: its key, its label in tables, its unit, and whether it needs the direct sound."""

    name: str
    label: str
    unit: str
    needs_direct_sound: bool = False


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


SPECTRAL_LOSS = Metric("spectral_loss", "spectral loss", "ln")
# All errors that `parameter_errors` returns, in the order of tables.
PARAMETER_METRICS = (
    ParameterMetric("t60", "T60", "%", error=_reverberation_time_error),
    ParameterMetric("edt", "EDT", "ms", error=_over_ears("early_decay_time_s", scale=1e3)),
    ParameterMetric("c50", "C50", "dB", error=_over_ears("clarity_db")),
    ParameterMetric("drr", "DRR", "dB", needs_direct_sound=True, error=_over_ears("direct_to_reverberant_db")),
    ParameterMetric("iacc", "IACC", "", error=_between_ears("interaural_cross_correlation")),
    ParameterMetric("iacc_early", "IACC early", "", error=_between_ears("early_interaural_cross_correlation")),
    ParameterMetric("level", "level", "dB", error=_over_ears("level_db")),
    ParameterMetric(
        "itd", "ITD", "us", needs_direct_sound=True, error=_between_ears("interaural_time_difference_s", scale=1e6)
    ),
    ParameterMetric("onset", "onset", "ms", error=_over_ears("onset_s", scale=1e3)),
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
