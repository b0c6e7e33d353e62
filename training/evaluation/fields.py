"""The fields of scene bundles as columns of an evaluation; also writes measured errors into the bundle."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx

from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.rendering.hrtf import kemar
from server.responses.full_response import FullResponse
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import Accuracy, QualityLevel
from training.baselines.held_out import EvaluationError, HeldOut, Responses, require_same_scene
from training.baselines.moved_nodes import with_moved_nodes
from training.baselines.states import ByState
from training.evaluation.evaluate import METRICS, Column, Evaluation, Source
from training.learning.record import RECORD, TrainingRecord

INTEGRATED = "-integrated"
"""The end of the names of levels and rows whose phase is what a network has learned, in place of noise."""
_LATTICE_POSITIONS = 8
"""The number of random positions of a lattice, which are used for held-out pairs in turn."""


def field_columns(bundles: Sequence[Bundle], held_out: HeldOut) -> list[Column]:
    """Make a column for each quality level of each bundle, named by level, or by bundle folder if there are several
    bundles.

    Raises DatasetError or EvaluationError if a bundle does not fit the data.
    """
    columns = []
    for bundle in bundles:
        if held_out.simulated is not None:
            require_same_scene(bundle, held_out.simulated)
        levels = FieldsByLevel.load(bundle)
        for level, field in levels.items():
            file = bundle.manifest.fields[field.level.field]
            columns.append(
                Column(
                    _name(bundle, level, several=len(bundles) > 1, levels=len(levels)),
                    field_source(field, held_out),
                    "field",
                    storage_bytes=len(bundle.models[file.file]) + bundle.frozen_noise.nbytes,
                    method=_method(file.architecture),
                    training=training_of(bundle, file.file),
                )
            )
    return columns


def _method(architecture: str) -> str:
    """The name of the architecture in tables, ours and published ones. A variant of a network has its own name, so that
    it does not stand beside figures of another network."""
    return architecture if architecture.startswith("naf") else ""


def training_of(bundle: Bundle, file: str) -> TrainingRecord | None:
    """How far the network of a graph was trained; None if the graph does not say."""
    graph = onnx.load_model_from_string(bundle.models[file])
    entries = {entry.key: entry.value for entry in graph.metadata_props}
    return TrainingRecord.from_json(entries[RECORD]) if RECORD in entries else None


def field_source(field: AcousticField, held_out: HeldOut) -> Source:
    """Complete responses as the server renders them: direct sound and first reflections are added, unless the field
    includes them. Nodes whose responses are reused are moved between pairs."""
    codec = field.bundle.manifest.codec.codec
    if codec.sample_rate != held_out.sample_rate:
        raise EvaluationError(
            f"{field.bundle.folder}: is for {codec.sample_rate} Hz, {held_out.name} for {held_out.sample_rate} Hz"
        )
    if field.channels != held_out.channels:
        raise EvaluationError(
            f"{field.bundle.folder}: has {field.channels} channels, {held_out.name} has {held_out.channels}"
        )
    rng = np.random.default_rng(_LATTICE_POSITIONS)
    is_moved = field.kind.reuses_responses
    fields = [with_moved_nodes(field, rng) for _ in range(_LATTICE_POSITIONS)] if is_moved else [field]
    filters = held_out.filters or kemar(held_out.sample_rate)
    wholes = [ByState(moved, partial(FullResponse, filters=filters)) for moved in fields]
    listeners, emitters = held_out.listeners, held_out.emitters

    def source(index: int, yaw_indices: npt.NDArray[np.integer]) -> Responses:
        shape = (len(yaw_indices), 3)
        responses = (
            wholes[index % len(wholes)]
            .at(held_out.openness(index))
            .impulse_responses(
                np.broadcast_to(listeners[index], shape),
                np.broadcast_to(emitters[index], shape),
                held_out.yaws[yaw_indices],
            )
        )
        return of_length(responses, held_out.samples)

    return source


def record_accuracy(bundle: Bundle, evaluation: Evaluation) -> Bundle:
    """Write the measured errors of each quality level into the bundle's manifest. `evaluation` must be of this bundle
    alone."""
    floor = {} if evaluation.floor is None else _means(evaluation, evaluation.floor.name)

    def measured(level: QualityLevel) -> QualityLevel:
        accuracy = Accuracy(
            pairs=evaluation.pairs,
            yaws=evaluation.yaws,
            errors=_means(evaluation, level.name),
            floor=floor,
            steps={} if level.accuracy is None else level.accuracy.steps,
        )
        return level.model_copy(update={"accuracy": accuracy})

    levels = tuple(measured(level) for level in bundle.manifest.levels)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    return write_bundle(bundle.folder, bundle.manifest.model_copy(update={"levels": levels}), files)


def _means(evaluation: Evaluation, column: str) -> dict[str, float]:
    summaries = evaluation.of(column).summaries
    return {metric.name: mean for metric in METRICS if (mean := summaries[metric.name].mean) is not None}


def _name(bundle: Bundle, level: str, *, several: bool, levels: int) -> str:
    if not several:
        return level
    folder = Path(bundle.folder).resolve().name
    return folder if levels == 1 else f"{folder} {level}"


def of_length(responses: npt.NDArray[np.float32], samples: int) -> npt.NDArray[np.float32]:
    """Cut or pad the responses with zeros to `samples`, because a measurement may be longer than the training
    responses."""
    kept = responses[..., :samples]
    return np.pad(kept, ((0, 0), (0, 0), (0, samples - kept.shape[-1])))
