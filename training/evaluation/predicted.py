"""Writes predictions of methods of ours for a benchmark, in the form in which it reads those of others."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import soundfile

from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle
from training.baselines.held_out import HeldOut, require_same_scene
from training.evaluation.benchmark_data import BenchmarkData, Group
from training.evaluation.evaluate import Source
from training.evaluation.fields import field_source
from training.evaluation.methods import method_columns
from training.evaluation.predictions import SUFFIXES, PredictionError

_Step = tuple[Group, Source, int]
Track = Callable[[list[_Step]], Iterable[_Step]]
MakeSource = Callable[[HeldOut], Source]


def of_method(name: str) -> MakeSource:
    """A baseline by its name, which learns from the training part of the split. Raises EvaluationError when it is used
    if there is none of that name."""
    return lambda held_out: method_columns([name], held_out)[0].source


def of_bundle(bundle: Bundle, level: str | None) -> MakeSource:
    """A quality level of a bundle; the default one if none is named."""
    field = FieldsByLevel.load(bundle).choose(level)

    def source(held_out: HeldOut) -> Source:
        if held_out.simulated is not None:
            require_same_scene(bundle, held_out.simulated)
        return field_source(field, held_out)

    return source


def write_predictions(
    data: BenchmarkData, make_source: MakeSource, folder: Path, *, suffix: str = ".wav", track: Track = iter
) -> int:
    """Writes a file for each test response and returns their number. Files of an earlier run are replaced.

    Raises PredictionError for a method without an answer, and EvaluationError or DatasetError for one that does not
    work with these data.
    """
    assert suffix in SUFFIXES
    steps = [
        (each, source, at)
        for each in data.groups()
        for source in [make_source(each.held_out)]
        for at in range(len(each.held_out))
    ]
    count = 0
    for group, source, index in track(steps):
        yaws = group.held_out.yaw_indices
        answer = source(index, yaws)
        names = [group.names(index, int(yaw)) for yaw in yaws]
        if answer is None:
            raise PredictionError(f"{names[0]}: the method has no estimate for this pair: choose another")
        for name, response in zip(names, answer, strict=True):
            _write(folder / f"{name}{suffix}", np.asarray(response, dtype=np.float32), group.held_out.sample_rate)
            count += 1
    return count


def _write(path: Path, response: npt.NDArray[np.float32], sample_rate: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    if path.suffix == ".npy":
        with partial.open("wb") as file:
            np.save(file, response)
    else:
        soundfile.write(partial, response.T, sample_rate, subtype="FLOAT", format="WAV")
    partial.replace(path)


def listed(data: BenchmarkData) -> Iterator[list[str]]:
    """Rows of a table of all test responses: names, places in metres, yaws in degrees. The first row has headings."""
    yield ["name", *(f"{end}_{axis}" for end in ("listener", "emitter") for axis in "xyz"), "yaw_deg"]
    for case in data.cases:
        for name, pose in zip(case.names, case.poses(), strict=True):
            yaw_deg = np.degrees(pose.yaw)
            yield [name, *(f"{value:.6g}" for value in (*pose.listener, *pose.emitter, yaw_deg))]
