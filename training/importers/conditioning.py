"""What is done to every response on its way in, whatever its layout, and what is found out about it.

Responses are `(channel, sample)`.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import soxr

from server.acoustics.decay import onset_sample
from server.acoustics.decibels import power_to_db
from server.errors import NafirError
from training.dataset import SPEED_OF_SOUND
from training.importers.report import ImportReport
from training.responses import Measurement

NEAREST_M = 0.01
"""Closer, and an emitter is where the listener is: no field is asked for that."""

_DIRECT_S = 0.0025
_ASIDE = 0.5  # sine of the smallest angle from the median plane at which the ears are asked
_TOLD_APART_DB = 1.0


class SourceError(NafirError):
    """A source that an importer cannot read at all; names the file and the field at fault."""

    def __init__(self, path: object, field: str, problem: str) -> None:
        super().__init__(f"{path}: {field}: {problem}")


@dataclass(frozen=True)
class Conditioning:
    """latency_samples: delay of the measuring equipment at the source's rate, taken off the start (zeros are put
    before the start where it is negative). sample_rate: to resample to; None keeps the source's. duration_s: where
    to end."""

    latency_samples: int = 0
    sample_rate: int | None = None
    duration_s: float | None = None

    def applied(self, measurement: Measurement) -> Measurement:
        response, rate = measurement.response, measurement.sample_rate
        if self.latency_samples >= 0:
            response = response[:, self.latency_samples :]
        else:
            response = np.pad(response, ((0, 0), (-self.latency_samples, 0)))
        if self.sample_rate is not None and rate != self.sample_rate and response.shape[1] > 0:
            # In float64: soxr then keeps what lies below -100 dB, where decays end.
            resampled = soxr.resample(response.T.astype(np.float64), rate, self.sample_rate, quality="VHQ")
            # An impulse response samples a filter: at another rate the same filter needs another scale.
            response, rate = resampled.T * (rate / self.sample_rate), self.sample_rate
        if self.duration_s is not None:
            response = response[:, : round(self.duration_s * rate)]
        return replace(measurement, response=np.asarray(response, dtype=np.float32), sample_rate=rate)


def conditioned(
    named: Iterable[tuple[str, Measurement]], conditioning: Conditioning, report: ImportReport
) -> Iterator[Measurement]:
    """Measurements fit to be stored; those that are not are skipped with their name. When all are through, the report
    tells when their direct sound arrives and, of two channels, whether they are those of ears in that order."""
    arrivals: list[float] = []
    ears: list[bool] = []
    for name, raw in named:
        measurement = conditioning.applied(raw)
        response = measurement.response
        distance = float(np.linalg.norm(np.subtract(measurement.emitter, measurement.listener)))
        if not np.isfinite([*measurement.listener, *measurement.emitter, measurement.yaw]).all():
            report.skip(name, "pose not finite")
        elif distance < NEAREST_M:
            report.skip(name, "emitter where the listener is")
        elif response.shape[1] == 0:
            report.skip(name, "empty")
        elif not np.isfinite(response).all():
            report.skip(name, "samples not finite")
        elif not response.any(axis=-1).all():
            report.skip(name, "silent")
        else:
            arrival_s = int(onset_sample(response).min()) / measurement.sample_rate
            arrivals.append(1e3 * (arrival_s - distance / SPEED_OF_SOUND))
            agrees = ears_agree(measurement)
            if agrees is not None:
                ears.append(agrees)
            yield measurement
    if arrivals:
        early, middle, late = np.percentile(arrivals, [10, 50, 90])
        report.note(
            f"sound arrives {middle:.2f} ms (median; {early:.2f} to {late:.2f} for 80 %) after distance / 343 m/s"
        )
    if ears:
        report.note(f"the ear turned to the emitter is the louder one in {np.mean(ears):.0%} of {len(ears)} responses")


def ears_agree(measurement: Measurement) -> bool | None:
    """Whether the direct sound is louder at the ear that is turned to the emitter; None where that cannot be said:
    one channel, an emitter near the median plane, or ears that are equally loud."""
    if len(measurement.response) != 2:
        return None
    offset = np.subtract(measurement.emitter, measurement.listener)
    to_left = float(-np.sin(measurement.yaw) * offset[0] + np.cos(measurement.yaw) * offset[1])
    if abs(to_left) < _ASIDE * np.linalg.norm(offset):
        return None
    start = int(onset_sample(measurement.response).min())
    head = measurement.response[:, start : start + round(_DIRECT_S * measurement.sample_rate)]
    left_db, right_db = power_to_db(np.sum(np.square(head, dtype=np.float64), axis=-1))
    if abs(left_db - right_db) < _TOLD_APART_DB:
        return None
    return bool((left_db > right_db) == (to_left > 0))


def positions(path: object, field: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(point, 3) checked; raises SourceError for another shape or type."""
    array = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise SourceError(path, field, f"is {array.dtype} of shape {array.shape}, not (points, 3) numbers")
    return array.astype(np.float64)
