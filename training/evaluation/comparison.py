"""Definitions of errors: what is compared, how, and in words, one object each.

The project's own are those of `nafir-train evaluate`; `training.evaluation.literature` has those of others.
"""

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.metrics import PARAMETER_METRICS, SPECTRAL_LOSS, Definition, parameter_errors, spectral_loss
from server.acoustics.room_parameters import RoomParameters, measure
from training.evaluation.evaluate import SPECTRAL_FLOOR, SPECTRAL_WINDOW_S, spectral_codec

Responses = npt.NDArray[np.floating]
Floats = npt.NDArray[np.float64]

OURS = "Nafir"


@dataclass(frozen=True)
class Comparison:
    """A reference and an estimate of it, `(row, channel, sample)` float32, of one pair of places. `in_sight` says
    whether the direct sound can be heard."""

    reference: Responses
    estimate: Responses
    sample_rate: int
    in_sight: bool = True

    @property
    def channels(self) -> int:
        return int(self.reference.shape[-2])

    @cached_property
    def both(self) -> tuple[Floats, Floats]:
        """Reference and estimate in double precision."""
        return self.reference.astype(np.float64), self.estimate.astype(np.float64)

    @cached_property
    def parameter_errors(self) -> dict[str, Floats]:
        """As `training.evaluation.evaluate` measures them."""
        reference = measure(self.reference, self.sample_rate)
        onset = np.round(np.nan_to_num(reference.onset_s, nan=0.0) * self.sample_rate).astype(np.int64)
        estimate: RoomParameters = measure(self.estimate, self.sample_rate, onset=onset)
        return parameter_errors(reference, estimate)


@dataclass(frozen=True, kw_only=True)
class Metric:
    """An error by one definition. quantity: what it is an error of. by: whose definition it is. error: of each row, NaN
    where it cannot be measured. counted_as: what takes the place of NaN in the mean; None leaves it out. channels: the
    least number that it needs."""

    name: str
    quantity: str
    by: str
    unit: str
    definition: Definition
    error: Callable[[Comparison], Floats]
    counted_as: float | None = None
    channels: int = 1

    @property
    def label(self) -> str:
        return f"{self.quantity}, {self.by}"

    def to_json(self) -> dict[str, object]:
        return {
            "name": self.name,
            "quantity": self.quantity,
            "by": self.by,
            "unit": self.unit,
            "counted_as": self.counted_as,
            **asdict(self.definition),
        }


def digest(metrics: Iterable[Metric]) -> str:
    """SHA-256 of all definitions in words. Results with other definitions cannot be compared."""
    return hashlib.sha256(json.dumps([metric.to_json() for metric in metrics]).encode()).hexdigest()


def _own_spectral_loss(compared: Comparison) -> Floats:
    codec = spectral_codec(compared.sample_rate, compared.reference.shape[-1])
    reference, estimate = (
        codec.log_magnitude(codec.transform(response)) for response in (compared.reference, compared.estimate)
    )
    return spectral_loss(reference, estimate)


def _of_parameter(name: str, *, needs_direct_sound: bool) -> Callable[[Comparison], Floats]:
    def error(compared: Comparison) -> Floats:
        if needs_direct_sound and not compared.in_sight:
            return np.full(len(compared.reference), np.nan)
        return compared.parameter_errors[name]

    return error


OWN_METRICS: tuple[Metric, ...] = (
    Metric(
        name=SPECTRAL_LOSS.name,
        quantity=SPECTRAL_LOSS.label,
        by=OURS,
        unit=SPECTRAL_LOSS.unit,
        definition=Definition(
            formula=f"{SPECTRAL_LOSS.definition.formula}; periodic Hann windows of the power of two that is nearest to "
            f"{1e3 * SPECTRAL_WINDOW_S:g} ms, a hop of a quarter, zeros around the response; the floor is "
            f"{SPECTRAL_FLOOR:g}",
            over=SPECTRAL_LOSS.definition.over,
            failures=SPECTRAL_LOSS.definition.failures,
            source=SPECTRAL_LOSS.definition.source,
        ),
        error=_own_spectral_loss,
    ),
    *(
        Metric(
            name=metric.name,
            quantity=metric.label,
            by=OURS,
            unit=metric.unit,
            definition=metric.definition,
            error=_of_parameter(metric.name, needs_direct_sound=metric.needs_direct_sound),
            channels=2 if metric.needs_two_ears else 1,
        )
        for metric in PARAMETER_METRICS
    ),
)
