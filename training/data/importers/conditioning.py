"""Conditions imported responses, in the same way for every layout, and checks them.

Responses are `(channel, sample)`.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import soxr

from server.core.errors import NafirError
from server.scene.limits import FEWEST_SAMPLES, HIGHEST_RATE_HZ, LOWEST_RATE_HZ, MOST_SAMPLES
from training.data.importers.evidence import ContradictionError, Evidence, swap_ears
from training.data.importers.report import ImportReport
from training.data.responses import Measurement

NEAREST_M = 0.01
"""A response is skipped if its emitter is closer to the listener than this: no field is asked for such a pair."""

_Place = tuple[float, float, float]


class SourceError(NafirError):
    """A source that an importer cannot read at all. The message names the file and the field at fault."""

    def __init__(self, path: object, field: str, problem: str) -> None:
        super().__init__(f"{path}: {field}: {problem}")


@dataclass(frozen=True)
class Conditioning:
    """How to change responses and positions on import.

    latency_samples: delay of the measuring equipment at the source's rate, removed from the start (if negative, zeros
    are put before the start). sample_rate: rate to resample to; None keeps the source's. duration_s: where responses
    end. position_scale: metres per unit of length in the source. mirror: the axis whose coordinates change sign.
    swap_ears: the source's second channel is the left ear. accept_ears: import even if the ears contradict the
    positions.
    """

    latency_samples: int = 0
    sample_rate: int | None = None
    duration_s: float | None = None
    position_scale: float = 1.0
    mirror: Literal["x", "y"] | None = None
    swap_ears: bool = False
    accept_ears: bool = False

    def apply(self, measurement: Measurement) -> Measurement:
        if self.swap_ears:
            measurement = swap_ears(measurement)
        response, rate = measurement.response, measurement.sample_rate
        if self.latency_samples >= 0:
            response = response[:, self.latency_samples :]
        else:
            response = np.pad(response, ((0, 0), (-self.latency_samples, 0)))
        if self.sample_rate is not None and rate != self.sample_rate and response.shape[1] > 0:
            # In float64, because soxr then keeps the end of the decay, below -100 dB.
            resampled = soxr.resample(response.T.astype(np.float64), rate, self.sample_rate, quality="VHQ")
            # An impulse response is a sampled filter: the same filter at another rate needs another scale.
            response, rate = resampled.T * (rate / self.sample_rate), self.sample_rate
        if self.duration_s is not None:
            response = response[:, : round(self.duration_s * rate)]
        return replace(
            measurement,
            listener=self._place(measurement.listener),
            emitter=self._place(measurement.emitter),
            response=np.asarray(response, dtype=np.float32),
            sample_rate=rate,
        )

    def _place(self, position: _Place) -> _Place:
        if self.position_scale == 1.0 and self.mirror is None:
            return position
        x, y, z = (float(coordinate) * self.position_scale for coordinate in position)
        return (-x if self.mirror == "x" else x), (-y if self.mirror == "y" else y), z


def condition(
    named: Iterable[tuple[str, Measurement]],
    conditioning: Conditioning,
    report: ImportReport,
    *,
    source: object = "source",
) -> Iterator[Measurement]:
    """Yields the conditioned measurements; those that cannot be stored are skipped and named in the report.

    At the end, the report says how far the responses agree with their positions (`training.data.importers.evidence`).
    Raises SourceError if they contradict each other.
    """
    evidence = Evidence(conditioning.latency_samples, conditioning.accept_ears)
    for name, raw in named:
        measurement = conditioning.apply(raw)
        reason = _reason_to_skip(measurement)
        if reason is not None:
            report.skip(name, reason)
            continue
        evidence.add(measurement, source_rate=raw.sample_rate)
        yield measurement
    try:
        evidence.judge(report)
    except ContradictionError as exc:
        raise SourceError(source, exc.field, str(exc)) from exc


def within_limits(measurements: Iterable[Measurement], source: object) -> Iterator[Measurement]:
    """Yields the measurements. Raises SourceError at the first that a bundle could not hold, and at the end if all are
    too short."""
    longest = 0
    for measurement in measurements:
        samples, rate = measurement.response.shape[1], measurement.sample_rate
        _require_rate(source, rate)
        if samples > MOST_SAMPLES:
            problem = (
                f"have {samples} samples, and a bundle holds {MOST_SAMPLES}: give --duration-s "
                f"{MOST_SAMPLES / rate:g} or less, or a lower --sample-rate"
            )
            raise SourceError(source, "responses", problem)
        longest = max(longest, samples)
        yield measurement
    if 0 < longest < FEWEST_SAMPLES:
        problem = f"have {longest} samples at most, and a bundle needs {FEWEST_SAMPLES}"
        raise SourceError(source, "responses", f"{problem}: give a longer --duration-s, or a higher --sample-rate")


def _reason_to_skip(measurement: Measurement) -> str | None:
    """Why a measurement cannot be stored; None if it can."""
    response = measurement.response
    if not np.isfinite([*measurement.listener, *measurement.emitter, measurement.yaw]).all():
        return "pose not finite"
    if np.linalg.norm(np.subtract(measurement.emitter, measurement.listener)) < NEAREST_M:
        return "emitter where the listener is"
    if response.shape[1] == 0:
        return "empty"
    if not np.isfinite(response).all():
        return "samples not finite"
    return None if response.any(axis=-1).all() else "silent"


def _require_rate(source: object, rate: int) -> None:
    if LOWEST_RATE_HZ <= rate <= HIGHEST_RATE_HZ:
        return
    problem = (
        f"is {rate} Hz, and a bundle holds {LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ} Hz: "
        f"give --sample-rate {LOWEST_RATE_HZ if rate < LOWEST_RATE_HZ else HIGHEST_RATE_HZ}, or another of these"
    )
    raise SourceError(source, "sample_rate", problem)


def positions(path: object, field: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(point, 3) float64. Raises SourceError for another shape or type."""
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise SourceError(path, field, f"is {array.dtype} of shape {array.shape}, not (points, 3) numbers")
    return array.astype(np.float64)
