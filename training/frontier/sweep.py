"""The sweep: measures every candidate level, and writes the Pareto-optimal ones into the bundle.

Errors are measured level by level, several at a time, and stored in a file, so that an interrupted sweep can be
resumed. Times are measured at the end, for all levels in one run.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.progress import Progress

from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import ARRAYS_FILE, Accuracy, Cost, FrontierPoint, QualityLevel
from training.baselines.held_out import require_same_scene
from training.baselines.moved_nodes import with_moved_nodes
from training.data.dataset import Dataset, Half
from training.frontier.accuracy import Errors, Estimate, SampledPairs
from training.frontier.bound import TruePhase
from training.frontier.cost import SEGMENT_S, cost_of, measure, memory_mb, one_core
from training.frontier.points import Point, default_among, eligible, offered_points, pareto
from training.frontier.steps import largest_steps
from training.parallel.jobs import ALL_CORES, IsOver, Job, Jobs

_FORMAT = 5
"""Must change whenever the same graph comes to give other responses: older stored errors are then measured again."""
HALVES: tuple[Half, ...] = get_args(Half)
_OFFSETS = 4
_STEPS = 60


@dataclass(frozen=True)
class Frontier:
    """All measured points, the Pareto-optimal ones (`best`, quickest first), the default, and the repeatability floor.
    Points are chosen by one half of the held-out pairs. All errors are of the other half, of which `pairs` were
    measured."""

    scene: str
    pairs: int
    yaws: int
    points: tuple[Point, ...]
    best: tuple[Point, ...]
    default: Point
    floor: Errors
    block_ms: float
    offered: tuple[Point, ...]
    """The points that a bundle should offer as quality levels, the default first."""

    @property
    def heard_by_clients(self) -> tuple[Point, ...]:
        """The bus of first order of the default's field, if it was measured: clients that render a scene themselves
        turn and decode the same ambisonic responses (`server/web/nafir/field/`)."""
        field = self.default.level.field
        return tuple(point for point in self.points if point.level.bus == 1 and point.level.field == field)

    def to_json(self) -> dict[str, Any]:
        """Plain values for `json.dumps`."""
        best = {point.level.name for point in self.best}
        offered = {point.level.name for point in self.offered}
        return {
            "scene": self.scene,
            "pairs": self.pairs,
            "yaws": self.yaws,
            "default": self.default.level.name,
            "block_ms": self.block_ms,
            "floor": {"errors": self.floor.errors, "errors_jnd": self.floor.audible},
            "points": [
                {
                    **point.level.model_dump(mode="json", exclude={"accuracy", "cost"}),
                    **point.cost.model_dump(mode="json"),
                    "errors": point.accuracy.errors,
                    "errors_jnd": dict(point.audible),
                    "audible_error_jnd": point.audible_error,
                    "steps_jnd": point.accuracy.steps,
                    "missing": point.missing,
                    "is_pareto_optimal": point.level.name in best,
                    "is_offered": point.level.name in offered,
                    "is_bound": point.bound,
                    "predicts": point.predicts,
                }
                for point in sorted(self.points, key=lambda point: point.cost.ms_mean)
            ],
        }


@dataclass(frozen=True)
class Effort:
    """How much is measured, and what the default level may cost.

    Errors are of held-out `pairs` at `yaws` orientations each: one half chooses the levels, and the errors of the other
    half are reported. Times are of a walk of `walk_s` seconds. A level that computes every response anew computes only
    some of them, for about `budget_s`.

    The default level is chosen among those whose response takes at most `default_ms`, and if there are levels of
    directions, among these only. It is one of the quickest that are about as accurate as the most accurate.
    """

    pairs: int = 80
    yaws: int = 3
    walk_s: float = 300.0
    budget_s: float = 10.0
    default_ms: float = 2.5
    seed: int = 0


def sweep(
    bundle: Bundle,
    dataset: Dataset,
    levels: Sequence[QualityLevel],
    folder: Path,
    effort: Effort,
    progress: Progress,
    *,
    jobs: Jobs = ALL_CORES,
) -> Frontier:
    """Measures `levels` of the bundle on the dataset's held-out pairs. Results are stored in `folder` as they come.
    Errors are measured in `jobs`, a level each; times are measured here, so that they are of one machine.

    Raises DatasetError if dataset and bundle are of different scenes.
    """
    require_same_scene(bundle, dataset)
    folder.mkdir(parents=True, exist_ok=True)
    trial = with_levels(bundle, levels, folder / "trial")
    samples = {half: _sample(dataset, trial, half, effort) for half in HALVES}
    floors = {half: sample.floor() for half, sample in samples.items()}
    errors = _accuracies(trial, samples, levels, folder / "accuracy.json", effort, jobs, progress)
    task = progress.add_task("timing", total=math.ceil(effort.walk_s / SEGMENT_S))
    with one_core():
        times = measure(
            FieldsByLevel.load(trial),
            walk_s=effort.walk_s,
            budget_s=effort.budget_s,
            seed=effort.seed,
            advance=lambda: progress.advance(task),
        )
    first_of_field = {level.field: level.name for level in reversed(levels)}
    memory = memory_mb(trial.folder, list(first_of_field.values()))
    costs = {
        level.name: cost_of(trial, level, times[level.name], memory[first_of_field[level.field]]) for level in levels
    }

    def points_of(half: Half) -> list[Point]:
        sample, floor = samples[half], floors[half]
        points = []
        for level in levels:
            point = _point(level, costs[level.name], errors[level.name][half], floor, sample)
            predicts = trial.manifest.fields[level.field].predicts
            points.append(dataclasses.replace(point, predicts=predicts))
        return points

    candidates, points = points_of("choice"), points_of("report")
    reported = {point.level.name: point for point in points}
    missing = floors["choice"].missing
    best, measurable = pareto(candidates, missing=missing), eligible(candidates, missing=missing)
    default = default_among(measurable, ms=effort.default_ms)
    offered = offered_points(measurable, best, default, ms=effort.default_ms)
    sample, floor = samples["report"], floors["report"]
    points.append(_true_phase(trial, points[0], sample, floor))
    codec = trial.manifest.codec
    return Frontier(
        bundle.id,
        *sample.size,
        tuple(points),
        tuple(reported[point.level.name] for point in best),
        reported[default.level.name],
        floor,
        block_ms=256 / codec.sample_rate * 1000,
        offered=tuple(reported[point.level.name] for point in offered),
    )


def with_levels(bundle: Bundle, levels: Sequence[QualityLevel], folder: Path) -> Bundle:
    """Writes the bundle to `folder`, its own or another one, with these levels in place of its own, and without the
    fields that none of them uses."""
    manifest = bundle.manifest
    fields = {name: file for name, file in manifest.fields.items() if name in {level.field for level in levels}}
    names = {ARRAYS_FILE, *(file.file for file in fields.values())}
    files = {name: (bundle.folder / name).read_bytes() for name in manifest.files if name in names}
    offered = manifest.model_copy(
        update={"levels": tuple(levels), "fields": fields, "files": {name: manifest.files[name] for name in files}}
    )
    written = write_bundle(folder, offered, files)
    for name in manifest.files.keys() - files.keys():
        (folder / name).unlink(missing_ok=True)
    return written


def record(bundle: Bundle, frontier: Frontier, folder: Path) -> Bundle:
    """Writes the bundle to `folder`, its own or another one, with the levels that it should offer, and records all
    Pareto-optimal points, and what a client hears that renders the scene itself."""
    fields = bundle.manifest.fields
    offered = [point.level for point in frontier.offered]
    kept = {point.level.name: point.level for point in (*frontier.best, *frontier.heard_by_clients)}
    points = []
    for level in kept.values():
        if level not in offered:
            file = fields[level.field]
            points.append(FrontierPoint(level=level, architecture=file.architecture, rank=file.rank))
    measured = bundle.manifest.model_copy(update={"frontier": tuple(points)})
    return with_levels(dataclasses.replace(bundle, manifest=measured), offered, folder)


def _point(level: QualityLevel, cost: Cost, errors: Errors, floor: Errors, sample: SampledPairs) -> Point:
    pairs, yaws = sample.size
    accuracy = Accuracy(pairs=pairs, yaws=yaws, errors=errors.errors, floor=floor.errors, steps=errors.steps)
    measured = level.model_copy(update={"accuracy": accuracy, "cost": cost})
    return Point(measured, errors.audible, errors.by_pair, errors.missing)


def _true_phase(trial: Bundle, first: Point, sample: SampledPairs, floor: Errors) -> Point:
    """The point that the first level would have if it knew the phase of every bin, drawn at that level's cost."""
    errors = sample.errors_of(TruePhase(AcousticField.load(trial, level=first.level.name)))
    level = first.level.model_copy(update={"name": f"{first.level.name}-true-phase"})
    return dataclasses.replace(_point(level, first.cost, errors, floor, sample), bound=True)


def _sample(dataset: Dataset, trial: Bundle, half: Half, effort: Effort) -> SampledPairs:
    pairs, codec = math.ceil(effort.pairs / len(HALVES)), trial.manifest.codec.codec
    return SampledPairs(dataset, codec, pairs=pairs, yaws=effort.yaws, seed=effort.seed, half=half)


def _accuracies(
    trial: Bundle,
    samples: Mapping[Half, SampledPairs],
    levels: Sequence[QualityLevel],
    path: Path,
    effort: Effort,
    jobs: Jobs,
    progress: Progress,
) -> dict[str, dict[Half, Errors]]:
    """Errors by level and half. Those that `path` has for the same graph, noise and sample are not measured again."""
    kept: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    task = progress.add_task("accuracy", total=len(levels))
    keys = {level.name: _key(trial, level, effort) for level in levels}
    missing = [name for name, key in keys.items() if key not in kept]
    progress.advance(task, len(levels) - len(missing))

    wanted = [Job(f"scene {trial.id}, level {name}", name) for name in missing]
    with closing(jobs.run(_measure_level, _Measurement(trial, samples, effort.seed), wanted)) as measured:
        for name, found in measured:
            kept[keys[name]] = found
            path.write_text(json.dumps(kept))
            progress.update(task, advance=1, description=f"accuracy  {name}")
    return {
        name: {half: Errors(**{**kept[key][half], "by_pair": np.array(kept[key][half]["by_pair"])}) for half in HALVES}
        for name, key in keys.items()
    }


@dataclass(frozen=True)
class _Measurement:
    """What the measurement of every level needs."""

    trial: Bundle
    samples: Mapping[Half, SampledPairs]
    seed: int


def _measure_level(of: _Measurement, name: str, _: IsOver) -> dict[str, Any]:
    """The errors of a level by half, in plain values for `json.dumps`."""
    field = AcousticField.load(of.trial, level=name)
    found = {half: asdict(_errors(field, sample, of.seed)) for half, sample in of.samples.items()}
    steps = largest_steps(field, count=_STEPS, seed=of.seed)
    return {
        half: {**of_half, "by_pair": of_half["by_pair"].tolist(), "steps": steps} for half, of_half in found.items()
    }


def _errors(field: AcousticField, sample: SampledPairs, seed: int) -> Errors:
    """The errors of a level. Where it reuses responses, they are the mean over several positions of its nodes."""
    if not field.kind.reuses_responses:
        return sample.errors_of(Estimate(field))
    rng = np.random.default_rng([seed, 12])
    measured = [sample.errors_of(Estimate(with_moved_nodes(field, rng))) for _ in range(_OFFSETS)]
    return Errors.mean(measured)


def _key(trial: Bundle, level: QualityLevel, effort: Effort) -> str:
    manifest = trial.manifest
    depends_on = [manifest.files[name] for name in (manifest.fields[level.field].file, ARRAYS_FILE)]
    return json.dumps([_FORMAT, level.model_dump(mode="json"), depends_on, effort.pairs, effort.yaws, effort.seed])
