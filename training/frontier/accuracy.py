"""Errors of a quality level on a sample of a dataset's pairs, by default of the held-out pairs.

Axes: entries are (pair, yaw); responses (yaw, ear, sample).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import in_jnd
from server.acoustics.codec import Codec
from server.acoustics.doors import Openness
from server.acoustics.metrics import SPECTRAL_LOSS, parameter_errors, spectral_loss
from server.acoustics.room_parameters import RoomParameters, measure
from server.field.field import AcousticField
from training.baselines.states import ByState
from training.data.dataset import TAKES, Dataset, Half
from training.frontier.heard_by_bus import full_response
from training.simulation.references import References

_STEP_M = 0.05

_Floats = npt.NDArray[np.float64]
_Responses = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Entry:
    """One pair with its reference at a few head orientations."""

    emitter: npt.NDArray[np.float64]
    listener: npt.NDArray[np.float64]
    yaws: npt.NDArray[np.float64]
    visible: bool
    reference: _Responses
    reflected: _Responses
    """The part of the reference that a field predicts, without direct sound and first reflections."""
    repeat: _Responses | None
    """The second simulation of a held-out pair."""
    parameters: RoomParameters
    openness: Openness | None = None
    """How far doors are open; None where none moves."""


@dataclass(frozen=True)
class Errors:
    """Mean errors by metric in their units, the same in JND, and for each pair (pair,) the mean of those in JND.

    `missing` is the share of audible errors that could not be measured; they are in no mean. `steps` are the largest
    changes over a centimetre, in JND by metric, as far as they were measured.
    """

    errors: dict[str, float]
    audible: dict[str, float]
    by_pair: _Floats
    missing: float
    steps: dict[str, float] = field(default_factory=dict)

    @classmethod
    def mean(cls, of: Sequence[Self]) -> Self:
        """The mean of several measurements of the same sample, with the `steps` of the first."""

        def over(dictionaries: list[dict[str, float]]) -> dict[str, float]:
            return {name: math.fsum(each[name] for each in dictionaries) / len(of) for name in dictionaries[0]}

        return cls(
            over([each.errors for each in of]),
            over([each.audible for each in of]),
            np.asarray(np.mean([each.by_pair for each in of], axis=0)),
            math.fsum(each.missing for each in of) / len(of),
            of[0].steps,
        )


class Estimate:
    """Whole responses of a field, as its level is heard. If its phase iteration starts from the previous response, each
    pose is computed after its neighbour, as on a walk."""

    def __init__(self, field: AcousticField) -> None:
        self._whole = ByState(field, full_response)
        self._is_warm = field.level.phase.warm

    def __call__(self, entry: Entry) -> _Responses:
        listeners, emitters = (np.tile(end, (len(entry.yaws), 1)) for end in (entry.listener, entry.emitter))
        whole = self._whole.at(entry.openness)
        if self._is_warm:
            whole.impulse_responses(listeners + np.array([_STEP_M, 0.0, 0.0]), emitters, entry.yaws)
        return whole.impulse_responses(listeners, emitters, entry.yaws)


@dataclass(frozen=True)
class Scores:
    """Errors in JND by (pair, metric), NaN where they could not be measured, and for each pair (pair,) the share that
    could not be measured."""

    errors: _Floats
    missing_shares: _Floats

    @classmethod
    def joined(cls, parts: Sequence["Scores"]) -> "Scores":
        return cls(
            np.concatenate([part.errors for part in parts]), np.concatenate([part.missing_shares for part in parts])
        )

    @classmethod
    def unmeasurable(cls, pairs: int) -> "Scores":
        """The scores if no response is finite."""
        return cls(np.full((pairs, 1), np.inf), np.ones(pairs))

    @property
    def missing(self) -> float:
        return float(np.mean(self.missing_shares))

    @property
    def mean(self) -> float:
        """The mean over metrics of each metric's mean over pairs."""
        is_known = np.isfinite(self.errors).any(axis=0)
        return float(np.mean(np.nanmean(self.errors[:, is_known], axis=0))) if is_known.any() else math.inf

    def behind(self, best: "Scores") -> float:
        """By how many standard errors the mean error is greater than the best one's, over the pairs that both have;
        infinite if nothing could be measured."""
        if not np.isfinite(self.mean):
            return math.inf
        difference = np.nanmean(self.errors - best.errors, axis=-1)
        difference = difference[np.isfinite(difference)]
        if len(difference) < 2:
            return 0.0
        return float(np.mean(difference) / max(np.std(difference, ddof=1) / np.sqrt(len(difference)), 1e-12))


class SampledPairs:
    """A sample of `pairs` pairs at `yaws` evenly spaced orientations, or all if there are fewer: of the pairs that are
    trained on, of those that are held out, or of one half of these."""

    def __init__(
        self,
        dataset: Dataset,
        codec: Codec,
        *,
        pairs: int,
        yaws: int,
        seed: int,
        held_out: bool = True,
        half: Half | None = None,
    ) -> None:
        self._codec = codec
        self._sample_rate = dataset.sample_rate
        rng = np.random.default_rng([seed, 7])
        all_pairs = dataset.pairs(held_out=held_out) if half is None else dataset.held_out_half(half)
        chosen = all_pairs[np.sort(rng.choice(len(all_pairs), min(pairs, len(all_pairs)), replace=False))]
        yaw_indices = np.unique(np.linspace(0, len(dataset.yaws), yaws, endpoint=False).astype(int))
        heads = dataset.yaws[yaw_indices]
        first, second = (References(dataset, take, heads=heads) for take in TAKES)
        self.entries = []
        for emitter, listener in chosen.tolist():
            ends = dataset.probes[emitter], dataset.probes[listener]
            reference = first.complete(emitter, listener)
            entry = Entry(
                *ends,
                yaws=heads,
                visible=bool(dataset.is_visible(np.array([[emitter, listener]]))[0]),
                reference=reference,
                reflected=first.reflected(emitter, listener),
                repeat=second.complete(emitter, listener) if held_out else None,
                parameters=measure(reference, self._sample_rate),
                openness=tuple(dataset.states.openness[emitter].tolist()) if dataset.doors else None,
            )
            self.entries.append(entry)

    @property
    def size(self) -> tuple[int, int]:
        """The number of pairs, and of orientations of each."""
        return len(self.entries), len(self.entries[0].yaws)

    def errors_of(self, estimate: Callable[[Entry], _Responses]) -> Errors:
        """`estimate` gives (yaw, ear, sample) whole responses for an entry."""
        by_entry: list[dict[str, _Floats]] = []
        audible_by_entry: list[dict[str, _Floats]] = []
        for entry in self.entries:
            errors, audible = self._compare(entry, estimate(entry))
            by_entry.append(errors)
            audible_by_entry.append(audible)
        return Errors(
            _means(by_entry), _means(audible_by_entry), _pair_means(audible_by_entry), _missing(audible_by_entry)
        )

    def scores_of(self, estimate: Callable[[Entry], _Responses], numbers: npt.NDArray[np.int64]) -> "Scores":
        """Audible errors of the entries with these `numbers`. This takes a third of the time of `errors_of`, since it
        leaves out the spectral loss."""
        entries = [self.entries[number] for number in numbers]
        audible = [in_jnd(self._differences(entry, estimate(entry)), entry.parameters) for entry in entries]
        return Scores(
            np.array([[_mean(values) for values in entry.values()] for entry in audible]),
            np.array([_missing([entry]) for entry in audible]),
        )

    def floor(self) -> Errors:
        """The errors of a second simulation of the same held-out pairs."""

        def second(entry: Entry) -> _Responses:
            assert entry.repeat is not None
            return entry.repeat

        return self.errors_of(second)

    def _compare(self, entry: Entry, estimate: _Responses) -> tuple[dict[str, _Floats], dict[str, _Floats]]:
        errors = self._differences(entry, estimate)
        spectrograms = (self._codec.log_magnitude(self._codec.transform(ir)) for ir in (entry.reference, estimate))
        errors[SPECTRAL_LOSS.name] = spectral_loss(*spectrograms)
        return errors, in_jnd(errors, entry.parameters)

    def _differences(self, entry: Entry, estimate: _Responses) -> dict[str, _Floats]:
        """Errors of room parameters."""
        onset = np.round(np.nan_to_num(entry.parameters.onset_s) * self._sample_rate).astype(np.int64)
        errors = parameter_errors(entry.parameters, measure(estimate, self._sample_rate, onset=onset))
        if not entry.visible:
            errors["drr"] = np.full_like(errors["drr"], np.nan)
            errors["itd"] = np.full_like(errors["itd"], np.nan)
        return errors


def _means(entries: list[dict[str, _Floats]]) -> dict[str, float]:
    """Means over all values that could be measured. A metric without any is left out."""
    stacked = {name: np.concatenate([entry[name].ravel() for entry in entries]) for name in entries[0]}
    return {name: float(np.nanmean(values)) for name, values in stacked.items() if np.isfinite(values).any()}


def _mean(values: _Floats) -> float:
    """The mean of the values that could be measured."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan


def _missing(entries: list[dict[str, _Floats]]) -> float:
    """The share of values that could not be measured."""
    return float(np.mean(np.isnan(np.concatenate([values.ravel() for entry in entries for values in entry.values()]))))


def _pair_means(entries: list[dict[str, _Floats]]) -> _Floats:
    means = []
    for entry in entries:
        values = np.stack([np.ravel(errors) for errors in entry.values()])
        means.append(float(np.nanmean(values)) if np.isfinite(values).any() else np.nan)
    return np.array(means)
