"""Errors of fields that were trained on fractions of the training pairs, over several seeds, as in the paper's figure
of the grid's use (Luo et al., NeurIPS 2022): `nafir-train fractions`.

All runs of a field make as many steps as `epochs` passes over all training pairs, whatever their fraction, and all are
scored on the same held-out pairs, heard whole. Folders: OUT/FIELD-PERCENT-SEED/ holds the run, and `scored.json` when
it is scored; OUT/fractions.json holds all.
"""

import json
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.progress import Progress

from server.core.errors import NafirError
from training.baselines.held_out import HeldOut, open_held_out
from training.bundling.export import export
from training.evaluation.evaluate import FLOOR, evaluate
from training.evaluation.fields import field_columns
from training.evaluation.methods import floor_columns
from training.learning.runs import Configuration, configure
from training.learning.train import train
from training.simulation.responses import SimulatedResponses, open_responses

SCORED, ALL = "scored.json", "fractions.json"
_YAWS = 1


class FractionsError(NafirError):
    """A comparison of fractions that is not possible."""


@dataclass(frozen=True)
class Effort:
    """epochs: of all pairs; points: of each response that a `naf` trains on per step; pairs: held-out pairs that are
    scored."""

    epochs: int = 1
    points: int = 100
    pairs: int = 20


@dataclass(frozen=True)
class Trial:
    """A field trained on `percent` of the training pairs."""

    field: str
    percent: float
    seed: int

    @property
    def folder(self) -> str:
        return f"{self.field}-{self.percent:g}-{self.seed}"


@dataclass(frozen=True)
class Scored:
    """A trial, its number of passes over its pairs, and its mean errors by metric, as far as they could be measured."""

    trial: Trial
    epochs: int
    errors: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self.trial), "epochs": self.epochs, "errors": self.errors}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Scored":
        return cls(Trial(values["field"], values["percent"], values["seed"]), values["epochs"], values["errors"])


@dataclass(frozen=True)
class Fractions:
    """All scored trials on one dataset, and the errors of the floor: what two simulations of the pairs differ by. That
    is no limit: a field that has learned from many noisy responses is nearer to one of them than another of the same
    pair is, because its own noise is less."""

    data: str
    effort: Effort
    floor: dict[str, float]
    scored: tuple[Scored, ...]

    def to_json(self) -> dict[str, Any]:
        return {
            "data": self.data,
            **asdict(self.effort),
            "floor": self.floor,
            "scored": [each.to_json() for each in self.scored],
        }

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Fractions":
        effort = Effort(values["epochs"], values["points"], values["pairs"])
        return cls(values["data"], effort, values["floor"], tuple(map(Scored.from_json, values["scored"])))


def trials(fields: Iterable[str], percents: Iterable[float], seeds: int, first_seed: int = 0) -> list[Trial]:
    """All combinations, seed by seed, so that an interrupted comparison has whole curves. Raises FractionsError for a
    fraction that is none."""
    fields, percents = list(fields), list(percents)
    for percent in percents:
        if not 0 < percent <= 100:
            raise FractionsError(f"--fractions: {percent:g} is not a percentage above 0, up to 100")
    return [
        Trial(field, percent, seed)
        for seed in range(first_seed, first_seed + seeds)
        for percent in percents
        for field in fields
    ]


def configuration_of(trial: Trial, effort: Effort) -> Configuration:
    """The configuration of a trial: a run on half of the pairs passes over them twice as often."""
    share = trial.percent / 100
    points = effort.points if trial.field.startswith("naf") else None
    return configure(
        trial.field, points=points, seed=trial.seed, share=share, epochs=max(1, round(effort.epochs / share))
    )


def measure_fractions(
    data: Path, output: Path, chosen: Sequence[Trial], effort: Effort, progress: Progress
) -> Fractions:
    """Train and score every trial that is not scored yet, and write OUT/fractions.json after each.

    Raises FractionsError for measured data or an output folder of another effort, and what training raises.
    """
    responses = open_responses(data)
    if not isinstance(responses, SimulatedResponses):
        raise FractionsError(f"{data}: holds measured responses; fractions are compared on a simulated scene")
    output.mkdir(parents=True, exist_ok=True)
    _require_same_effort(output, effort)
    task = progress.add_task("fractions", total=len(chosen))
    with open_held_out(data) as everything:
        held_out = everything.sample(pairs=effort.pairs, yaws=_YAWS, seed=0)
        floor = _errors_of_floor(held_out)
        scored: list[Scored] = []
        for trial in chosen:
            progress.update(task, description=trial.folder)
            scored.append(_score(responses, held_out, output / trial.folder, trial, effort, progress))
            found = Fractions(held_out.name, effort, floor, tuple(scored))
            (output / ALL).write_text(json.dumps(found.to_json(), indent=1) + "\n")
            progress.advance(task)
    return found


def _require_same_effort(output: Path, effort: Effort) -> None:
    if not (output / ALL).exists():
        return
    before = Fractions.from_json(json.loads((output / ALL).read_text())).effort
    if before != effort:
        raise FractionsError(f"{output}: was measured with {before}; choose an empty folder")


def _score(
    responses: SimulatedResponses, held_out: HeldOut, run: Path, trial: Trial, effort: Effort, progress: Progress
) -> Scored:
    if (run / SCORED).exists():
        return Scored.from_json(json.loads((run / SCORED).read_text()))
    configuration = configuration_of(trial, effort)
    train(responses, run, configuration, progress)
    with tempfile.TemporaryDirectory() as folder:
        bundle = export(responses, [run], Path(folder) / "bundle", checked=False, progress=progress)
        (column,) = field_columns([bundle], held_out)
        (result,) = evaluate(held_out, [replace(column, name=trial.folder)], timed=False).results
    errors = {name: summary.mean for name, summary in result.summaries.items() if summary.mean is not None}
    scored = Scored(trial, configuration.epochs, errors)
    (run / SCORED).write_text(json.dumps(scored.to_json()) + "\n")
    return scored


def _errors_of_floor(held_out: HeldOut) -> dict[str, float]:
    columns = floor_columns(held_out)
    if not columns:
        return {}
    summaries = evaluate(held_out, columns, timed=False).of(FLOOR).summaries
    return {name: summary.mean for name, summary in summaries.items() if summary.mean is not None}
