"""A table over scenes: errors of the default level of each bundle, beside the paper's network (for late reverberation
and for complete responses), the nearest response and the repeatability floor, with times.

It is made from the files that `nafir-train evaluate --json` writes for each scene.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from server.acoustics.metrics import Metric
from server.core.errors import NafirError
from training.evaluation.evaluate import FLOOR, METRICS, ONE_SIMULATION
from training.evaluation.fields import INTEGRATED
from training.evaluation.methods import MEAN_SPECTROGRAM
from training.evaluation.report import short
from training.learning.record import TrainingRecord

TIMES = "times.jsonl"
"""The file with the time of each step, beside the results of a scene."""

NAF, NAF_WHOLE, NEAREST = "naf", "naf-whole", "nearest"
_NETWORKS = tuple(f"{network}{phase}" for network in (NAF, "naf-expected", NAF_WHOLE) for phase in ("", INTEGRATED))
"""The rows of the paper's network: trained on draws, as in the paper, on expected values, and on whole responses; each
with the phase of noise and with its own."""
_MEANS = (MEAN_SPECTROGRAM, f"{MEAN_SPECTROGRAM}-whole")
_NOT_METHODS = {ONE_SIMULATION, FLOOR}


class ResultError(NafirError):
    """The file is not the evaluation of a bundle."""


@dataclass(frozen=True)
class Method:
    """The results of one method: mean errors by metric, as far as they could be measured; for each metric the methods
    with a significantly smaller error; and milliseconds per response."""

    errors: Mapping[str, float]
    surpassed_by: Mapping[str, Sequence[str]]
    ms: float | None
    storage_bytes: int | None

    @property
    def megabytes(self) -> float:
        """The stored data in MB; NaN if nothing is stored."""
        return math.nan if self.storage_bytes is None else self.storage_bytes / 1e6


@dataclass(frozen=True)
class SceneResult:
    """The results of one scene. `methods` has them by the name of a method in the table; that of the default level is
    `level`."""

    scene: str
    pairs: int
    visible_pairs: int
    yaws: int
    draws: int
    level: str
    methods: Mapping[str, Method]
    trained: Mapping[str, TrainingRecord]
    """How far the networks of the table were trained, by row."""

    @classmethod
    def read(cls, path: Path) -> "SceneResult":
        """Read the JSON of an evaluation. Raises ResultError."""
        try:
            values = json.loads(path.read_text())
            columns: dict[str, dict[str, Any]] = values["columns"]
            fields = [name for name, column in columns.items() if column["kind"] == "field"]
            nafs = {name: _network(name, columns[name]["method"]) for name in fields if columns[name]["method"]}
            ours = next(name for name in fields if name not in nafs)
            # With several bundles, columns are named by folder and level.
            level = ours.split()[-1]
            names = {ours: level}
            for name, method in nafs.items():
                if method in _NETWORKS and method not in names.values():  # only the first of several
                    names[name] = method
            methods = {names.get(name, name): _method(column, names) for name, column in columns.items()}
            trained = {
                names.get(name, name): TrainingRecord(**column["training"])
                for name, column in columns.items()
                if column.get("training") and not name.endswith(INTEGRATED)
            }
            scene = str(values["data"]).removesuffix(" (simulated)")
            drawn = values["pairs"], values["visible_pairs"], values["yaws"], values.get("draws", 1)
            return cls(scene, *drawn, level, methods, {name: trained[name] for name in _NETWORKS if name in trained})
        except OSError as exc:
            raise ResultError(f"{path}: cannot be read: {exc.strerror}") from exc
        except StopIteration as exc:
            raise ResultError(f"{path}: holds no level of a factorised field") from exc
        except (ValueError, KeyError, TypeError) as exc:
            raise ResultError(f"{path}: not what nafir-train evaluate --json writes: {exc!r}") from exc

    @property
    def ours(self) -> Method:
        return self.methods[self.level]

    def to_json(self) -> dict[str, Any]:
        return {
            "scene": self.scene,
            "pairs": self.pairs,
            "visible_pairs": self.visible_pairs,
            "yaws": self.yaws,
            "draws": self.draws,
            "level": self.level,
            "worse_than": {naf: self.worse_than(naf) for naf in (NAF, NAF_WHOLE) if naf in self.methods},
            "trained": {name: asdict(record) for name, record in self.trained.items()},
            "methods": {
                name: {"errors": dict(method.errors), "ms": method.ms, "storage_bytes": method.storage_bytes}
                for name, method in self.methods.items()
            },
        }

    def worse_than(self, other: str) -> list[str]:
        """The metrics in which the default level has a significantly larger error than `other`."""
        return [name for name, surpassing in self.ours.surpassed_by.items() if other in surpassing]

    def larger_than(self, other: str) -> list[str]:
        """The metrics in which the default level has a larger mean error than `other`, significantly or not."""
        theirs = self.methods[other].errors
        return [name for name, error in self.ours.errors.items() if error > theirs.get(name, math.inf)]


def _network(column: str, method: str) -> str:
    """The name in the table of one of the paper's networks, from its column of an evaluation and its method."""
    return f"{method}{INTEGRATED}" if column.endswith(INTEGRATED) else method


def _method(column: Mapping[str, Any], names: Mapping[str, str]) -> Method:
    metrics = column["metrics"]
    return Method(
        {name: summary["mean"] for name, summary in metrics.items() if summary["mean"] is not None},
        {name: [names.get(other, other) for other in summary["surpassed_by"]] for name, summary in metrics.items()},
        column["ms"],
        column["storage_bytes"],
    )


def markdown(results: Sequence[SceneResult]) -> str:
    """The table as Markdown, with a row for each scene and method. Bold marks the best of the default level, the
    paper's network and the nearest response, and every method that is not worse by two standard errors of the
    difference over pairs. Then follow means over the scenes, with the smallest in bold, and for each scene the metrics
    in which the paper's network is better.

    Raises ResultError if scenes are compared with medians of different numbers of draws.
    """
    if len(drawn := sorted({result.draws for result in results})) > 1:
        numbers = " and ".join(map(str, drawn))
        raise ResultError(f"some scenes are compared with {numbers} draws: evaluate all with the same --draws")
    heads = [f"{metric.label} ({metric.unit})" if metric.unit else metric.label for metric in METRICS]
    lines = [
        "| scene | method | " + " | ".join([*heads, "MB", "ms"]) + " |",
        "| --- | --- |" + " ---: |" * (len(heads) + 2),
    ]
    for result in results:
        for name in _shown(result):
            method = result.methods[name]
            cells = [_cell(result, name, metric) for metric in METRICS]
            first = result.scene if method is result.ours else ""
            cells += [_number(method.megabytes), _number(_finite(method.ms))]
            lines.append(f"| {first} | {name} | " + " | ".join(cells) + " |")
    if len(results) > 1:
        lines += _mean_rows(results)
    return "\n".join([*lines, "", *_remarks(results)])


def _shown(result: SceneResult) -> list[str]:
    names = (result.level, *_NETWORKS, *_MEANS, NEAREST, ONE_SIMULATION, FLOOR)
    return [name for name in names if name in result.methods]


def _cell(result: SceneResult, name: str, metric: Metric) -> str:
    error = result.methods[name].errors.get(metric.name, math.nan)
    compared = [other for other in _shown(result) if other not in _NOT_METHODS]
    best = min(compared, key=lambda other: result.methods[other].errors.get(metric.name, math.inf))
    is_bold = name in compared and best not in result.methods[name].surpassed_by.get(metric.name, ())
    return _number(error, is_bold=is_bold)


def _number(value: float, *, is_bold: bool = False) -> str:
    """The value as text; empty for NaN."""
    if not math.isfinite(value):
        return ""
    return f"**{short(value)}**" if is_bold else short(value)


def _finite(value: float | None) -> float:
    return math.nan if value is None else value


def _mean_rows(results: Sequence[SceneResult]) -> list[str]:
    """Rows of means over the scenes, for methods that all scenes have."""
    means: dict[str, list[float]] = {}
    for name in _shown(results[0]):
        of_scenes = [result.ours if name == results[0].level else result.methods.get(name) for result in results]
        methods = [method for method in of_scenes if method is not None]
        if len(methods) < len(results):
            continue
        values = [[method.errors.get(metric.name, math.nan) for method in methods] for metric in METRICS]
        values += [[method.megabytes for method in methods], [_finite(method.ms) for method in methods]]
        means[name] = [math.fsum(column) / len(column) for column in values]
    compared = [of_name for name, of_name in means.items() if name not in _NOT_METHODS]
    smallest = [min(filter(math.isfinite, column), default=math.nan) for column in zip(*compared, strict=True)]
    rows: list[str] = []
    for name, of_name in means.items():
        cells = [
            _number(mean, is_bold=number < len(METRICS) and name not in _NOT_METHODS and mean == smallest[number])
            for number, mean in enumerate(of_name)
        ]
        first, shown = ("mean", "default level") if not rows else ("", name)
        rows.append(f"| {first} | {shown} | " + " | ".join(cells) + " |")
    return rows


def _remarks(results: Sequence[SceneResult]) -> list[str]:
    remarks = []
    for result in results:
        comparisons = "; ".join(_beside(result, naf) for naf in (NAF, NAF_WHOLE) if naf in result.methods)
        if not comparisons:
            continue
        orientations = "1 orientation" if result.yaws == 1 else f"{result.yaws} orientations"
        drawn = f"{result.pairs} pairs, {result.visible_pairs} in sight, {orientations}"
        if result.draws > 1:
            drawn += f", medians of {result.draws} draws"
        remarks.append(f"- {result.scene} ({drawn}): {comparisons}.")
        remarks += [f"    - {name}: {record.sentence()}." for name, record in result.trained.items()]
    return remarks


def _beside(result: SceneResult, naf: str) -> str:
    worse, larger = result.worse_than(naf), result.larger_than(naf)
    significant = ", ".join(metric.label for metric in METRICS if metric.name in worse)
    others = ", ".join(metric.label for metric in METRICS if metric.name in larger and metric.name not in worse)
    if significant:
        text = f"errs more than {naf} in {significant}"
        text += f", and in {others} not by more than chance" if others else ""
    else:
        text = f"errs no more than {naf} in any metric"
        text += f" but {others}, and there not by more than chance" if others else ""
    naf_ms, ms = result.methods[naf].ms, result.ours.ms
    return text if naf_ms is None or ms is None else f"{text}, {short(naf_ms / ms)} times as fast"


@dataclass(frozen=True)
class StepTime:
    """The seconds that one step of one scene took, summed over interrupted parts."""

    step: str
    wall_s: float
    cpu_s: float


def step_times(log: Path) -> list[StepTime]:
    """The times in a log of `training.cli.stopwatch`, in order of first appearance. Raises ResultError."""
    totals: dict[str, list[float]] = {}
    try:
        for line in log.read_text().splitlines():
            values = json.loads(line)
            wall_s, cpu_s = totals.get(values["step"], [0.0, 0.0])
            totals[values["step"]] = [wall_s + values["wall_s"], cpu_s + values["cpu_s"]]
    except OSError as exc:
        raise ResultError(f"{log}: cannot be read: {exc.strerror}") from exc
    except (ValueError, KeyError, TypeError) as exc:
        raise ResultError(f"{log}: not what training.cli.stopwatch writes: {exc!r}") from exc
    return [StepTime(step, *seconds) for step, seconds in totals.items()]


def times_markdown(times: Mapping[str, Sequence[StepTime]]) -> str:
    """The times as a Markdown table, with a row for each scene and a column for each step: minutes of wall time, CPU
    minutes in parentheses, and sums."""
    steps = list(dict.fromkeys(step.step for of_scene in times.values() for step in of_scene))
    rows = {scene: {step.step: step for step in of_scene} for scene, of_scene in times.items()}
    lines = ["| minutes | " + " | ".join([*steps, "all"]) + " |", "| --- |" + " ---: |" * (len(steps) + 1)]
    for scene, of_scene in rows.items():
        cells = [_minutes([of_scene[step]]) if step in of_scene else "" for step in steps]
        lines.append(f"| {scene} | " + " | ".join([*cells, _minutes(list(of_scene.values()))]) + " |")
    everything = [step for of_scene in times.values() for step in of_scene]
    sums = [_minutes([step for step in everything if step.step == name]) for name in steps]
    return "\n".join([*lines, "| all | " + " | ".join([*sums, _minutes(everything)]) + " |"])


def _minutes(steps: Sequence[StepTime]) -> str:
    wall, cpu = (sum(getattr(step, name) for step in steps) / 60 for name in ("wall_s", "cpu_s"))
    return f"{wall:.1f} ({cpu:.1f})"
