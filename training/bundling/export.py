"""Writes fields to a scene bundle: trained fields, and measured responses themselves. Every graph is checked against
torch before anything is written."""

import io
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
import onnx
import torch
from rich.progress import Progress
from torch import nn

from server.acoustics.cells import Axis
from server.acoustics.codec import Codec
from server.core.errors import NafirError
from server.field.directional_graph import DIRECTIONAL_INPUTS, DIRECTIONS, LOG_MAGNITUDE
from server.field.graph import INPUTS, OPENNESS, OUTPUTS, PATH, RESPONSE
from server.field.runtime import open_session
from server.health.check import Effort, Health, check, check_fields
from server.health.findings import LAWS
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import ARRAYS_FILE, AcceptedLaw, CodecParameters, FieldFile, Phase, QualityLevel
from training.baselines.held_out import measured_pairs
from training.baselines.shaped import ShapedNearest
from training.bundling.data_reference import reference_of
from training.bundling.graphs import halve_weights, pose_by_pose, to_int8, to_onnx, with_metadata, with_weights
from training.bundling.manifests import Fields, measured_manifest, mesh_files, simulated_manifest
from training.bundling.noise import choose_noise
from training.bundling.shaped_graph import ShapedNearestGraph
from training.data.levels.level_scene import LevelScene
from training.data.responses import FILE, ImportedDataset, ResponseSet
from training.evaluation.fields import INTEGRATED
from training.learning.basis import BasisLearner
from training.learning.directional import DirectionalLearner
from training.learning.factorised import FactorisedLearner
from training.learning.learner import Learner
from training.learning.naf import NafLearner
from training.learning.record import RECORD
from training.learning.runs import Configuration, record_of
from training.learning.train import load_learner
from training.models.basis_field import BasisField
from training.models.directional import ExportedDirections, ExportedDirectionsOfDoors
from training.models.factorised import ExportedField
from training.models.frozen_noise import even_noise
from training.models.naf_graph import NafGraph
from training.models.site import Site
from training.models.targets import LEAD_SAMPLES, codec_of
from training.simulation.responses import SimulatedResponses

Precision = Literal["float32", "int8"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
MODEL_FILE = "factorised.onnx"
DEFAULT_LEVEL = "standard"
SHAPED_NEAREST = "shaped-nearest"
EFFORT = Effort()
"""The effort of the health check that a bundle must pass."""

_OF_A_BASIS = ("factorised", "directional")
_CHECK_POSES = {**dict.fromkeys(_OF_A_BASIS, 64), "naf": 2, SHAPED_NEAREST: 8}
_INT8_LEAST_WEIGHTS = 100_000
_TRUNCATION_POSES = 3000
# Rounding of weights is the only difference. Phases of uncertain bins may change, so frequency is compared where phase
# is certain. Tolerances are for the largest difference in float32 (float16 weights), and the root mean square in int8.
# Those of a response are in its standard deviations: half precision of a network of full width errs by 0.003 of them.
_TOLERANCES: dict[Precision, dict[str, float]] = {
    "float32": {OUTPUTS[0]: 0.05, OUTPUTS[2]: 0.02, OUTPUTS[3]: 0.02, DIRECTIONS: 0.02, RESPONSE: 1e-2},
    "int8": {OUTPUTS[0]: 0.1, OUTPUTS[2]: 0.05, OUTPUTS[3]: 0.05, DIRECTIONS: 0.05, RESPONSE: 0.05},
}
_PHASE_TOLERANCE: dict[Precision, float] = {"float32": 0.05, "int8": 0.2}
TABLED_TOLERANCE = 1e-4
"""Largest difference in log-magnitude between the plain and the tabled graph of a `naf`."""


class ExportError(NafirError):
    """A field that does not fit into the bundle, or an exported graph whose results differ from the trained field's."""


@dataclass(frozen=True)
class _Variants:
    """The forms in which each run is written: `ranks` for fields with a basis, `exact_tables` for a `naf`."""

    precisions: Sequence[Precision]
    ranks: Sequence[int]
    exact_tables: bool


@dataclass(frozen=True)
class _Exported:
    """A checked graph and what the manifest says about it; `order` if it predicts directions."""

    name: str
    model: onnx.ModelProto
    architecture: str
    rank: int | None
    codec: CodecParameters
    order: int | None = None
    doors: tuple[str, ...] = ()

    @property
    def learns_phase(self) -> bool:
        """Whether it predicts a phase throughout, with which its responses can be heard in place of noise."""
        return self.architecture.startswith("naf") and self.codec.known_frames > 0


def export(
    responses: ResponseSet,
    runs: Sequence[Path],
    folder: Path,
    *,
    precisions: Sequence[Precision] = ("float32",),
    ranks: Sequence[int] = (),
    exact_tables: bool = False,
    accepted: Mapping[str, str] | None = None,
    checked: bool = True,
    progress: Progress | None = None,
) -> Bundle:
    """Writes finished runs on one scene as the fields of one bundle, each in every precision. The first field is the
    default. Levels of directional fields make the tail in octave bands. A `naf` of spectrograms has two levels: with
    the phase of frozen noise, and with the phase that it has learned. Factorised and directional fields are also
    written at each lower one of `ranks`, with the least loss. With `exact_tables`, a `naf` is also written with less
    arithmetic for the same numbers. In place of a run, the folder of measured responses stands for the field that needs
    no training, `ShapedNearest`, in one precision.

    Fields of a simulated scene leave direct sound and first reflections to the server. Fields of measured responses
    include them, and so does `naf-whole`. If the first field of a simulated scene is factorised or directional, the
    best of several draws of frozen noise is chosen (`training.bundling.noise`); otherwise the noise is the first draw.

    The name of a factorised or directional field includes its width if that differs from the first one's.

    The fields are checked against the laws of `nafir check`, some of them relative to the data
    (`training.bundling.data_reference`), before the noise is chosen. `accepted` gives reasons, by name of a law, to
    offer the scene although its fields break the law. The manifest records those that they do break.

    Without `checked`, neither laws are checked nor is the best noise chosen. That is for evaluations alone, of fields
    that nobody will hear.

    Nothing is written if this raises RunError for an unfinished run; ExportError for a graph that differs from torch,
    a dataset folder that is not that of `responses` or not measured, fields of which only some include the direct
    sound, ranks, tables or precisions that apply to none of the fields, or a law that does not exist or cannot be
    accepted; or HealthError for fields that break a law of `nafir check`.
    """
    accepting = _accepting(accepted or {})
    variants = _Variants(precisions, ranks, exact_tables)
    # Making a graph takes a while, so everything that could be wrong with a field or an option is checked first.
    fields = [_opened(responses, place) for place in runs]
    _require_different(
        [_name_of(field, place, _usual_width(fields)) for field, place in zip(fields, runs, strict=True)]
    )
    whole = _hold_direct_sound(fields)
    _require_used(fields, variants)
    exported = _graphs(fields, runs, variants)
    seed = 0 if exported[0].architecture == SHAPED_NEAREST else Configuration.read(runs[0]).seed
    files, described = _contents(exported, precisions[0], seed)
    if isinstance(responses, SimulatedResponses):
        manifest = simulated_manifest(responses, described, whole=whole)
        if isinstance(responses.dataset.place, LevelScene):
            level, has_doors = responses.dataset.place, len(responses.dataset.doors) > 0
            files |= mesh_files(level, moving=has_doors)[1]
    else:
        assert isinstance(responses, ImportedDataset)
        manifest = measured_manifest(responses, described)
    if not checked:
        return write_bundle(folder, manifest, files)
    manifest = manifest.model_copy(update={"reference": reference_of(responses, manifest), "accepted": accepting})
    with tempfile.TemporaryDirectory() as trial:
        bundle = write_bundle(Path(trial), manifest, files)
        found = check_fields(bundle, EFFORT)
        # guard: noise is not chosen for ill fields
        found.health.require()
        if isinstance(responses, SimulatedResponses) and exported[0].architecture in _OF_A_BASIS:
            files[ARRAYS_FILE] = _arrays(choose_noise(bundle, responses.dataset, seed=seed, progress=progress))
            bundle = write_bundle(Path(trial), manifest, files)
        health = check(bundle, EFFORT, fields=found)
        # guard: ill bundles are not exported
        health.require()
    return write_bundle(folder, manifest.model_copy(update={"accepted": _needed(accepting, health)}), files)


def _graphs(
    fields: Sequence[Learner | ImportedDataset], places: Sequence[Path], variants: _Variants
) -> list[_Exported]:
    """All graphs of the fields. Raises ExportError for a graph that differs from torch, or two of the same name."""
    exported: list[_Exported] = []
    for field, place in zip(fields, places, strict=True):
        if isinstance(field, ImportedDataset):
            exported.append(_shaped(field))
            continue
        if isinstance(field, BasisLearner):
            graphs = _of_a_basis(field, Configuration.read(place), variants, _usual_width(fields))
        elif isinstance(field, NafLearner):
            graphs = _naf(field, Configuration.read(place), variants)
        else:
            raise TypeError(f"{type(field)} has no graph")
        record = record_of(place)
        exported += [replace(graph, model=with_metadata(graph.model, {RECORD: record.to_json()})) for graph in graphs]
    _require_different([each.name for each in exported])  # with lower ranks
    return exported


def _usual_width(fields: Sequence[Learner | ImportedDataset]) -> int:
    """The width of the first field with a basis, which names leave out; 0 if there is none."""
    return next((field.field.width for field in fields if isinstance(field, BasisLearner)), 0)


def _contents(exported: Sequence[_Exported], precision: Precision, seed: int) -> tuple[dict[str, bytes], Fields]:
    """The bundle's files but the manifest, and what the manifest says about them. `precision` is that of the first
    field; the frozen noise is a draw of this `seed`."""
    codec, names = exported[0].codec, [each.name for each in exported]
    # The default field is named by its kind alone, whatever its rank, unless it is quantised.
    titles = [exported[0].architecture if precision == "float32" else names[0], *names[1:]]
    files = {f"{title}.onnx": each.model.SerializeToString() for title, each in zip(titles, exported, strict=True)}
    fields = {
        title: FieldFile(
            file=f"{title}.onnx",
            architecture=each.architecture,
            rank=each.rank,
            codec=None if each.codec == codec else each.codec,
            predicts="ears" if each.order is None else "directions",
            order=each.order,
            doors=each.doors,
        )
        for title, each in zip(titles, exported, strict=True)
    }
    levels = []
    for number, (title, each) in enumerate(zip(titles, exported, strict=True)):
        tail: Literal["stft", "bands"] = "stft" if each.order is None else "bands"
        level = QualityLevel(name=title if number else DEFAULT_LEVEL, field=title, tail=tail)
        levels.append(level)
        if each.learns_phase:
            name = f"{level.name}{INTEGRATED}"
            levels.append(level.model_copy(update={"name": name, "phase": Phase(kind="integrated")}))
    files[ARRAYS_FILE] = _arrays(even_noise(codec.codec, np.random.default_rng([seed, 6])))
    return files, Fields(codec, fields, tuple(levels), dict.fromkeys(files, "0" * 64))


def _accepting(reasons: Mapping[str, str]) -> tuple[AcceptedLaw, ...]:
    known = [law.name for law in LAWS if law.can_be_accepted]
    for name, reason in reasons.items():
        if name not in known:
            raise ExportError(
                f"accept: {name}: is not a law that may be broken for a reason; those are {', '.join(known)}"
            )
        if not reason.strip():
            raise ExportError(f"accept: {name}: needs a reason, which the bundle keeps")
    return tuple(AcceptedLaw(law=name, reason=reason.strip()) for name, reason in reasons.items())


def _needed(accepting: tuple[AcceptedLaw, ...], health: Health) -> tuple[AcceptedLaw, ...]:
    """The accepted laws that the bundle does break."""
    broken = {finding.law.name for finding in health.accepted}
    return tuple(entry for entry in accepting if entry.law in broken)


def _arrays(noise: npt.NDArray[np.float32]) -> bytes:
    """The content of the bundle's file of arrays."""
    arrays = io.BytesIO()
    np.savez(arrays, frozen_noise=noise)
    return arrays.getvalue()


def _opened(responses: ResponseSet, place: Path) -> Learner | ImportedDataset:
    if not (place / FILE).is_file():
        if (place / "pairs.h5").is_file():
            raise ExportError(f"{place}: is a simulated dataset; train a field on it, and export the run")
        return load_learner(responses, place)
    if not isinstance(responses, ImportedDataset) or place.resolve() != responses.folder.resolve():
        raise ExportError(f"{place}: holds other responses than those of the other fields")
    return responses


def _name_of(field: Learner | ImportedDataset, place: Path, usual_width: int) -> str:
    if isinstance(field, ImportedDataset):
        return SHAPED_NEAREST
    configuration = Configuration.read(place)
    if isinstance(field, BasisLearner):
        return _sized_name(configuration.name, field.field, usual_width)
    return configuration.name


def _sized_name(kind: str, field: BasisField, usual_width: int) -> str:
    """The name of a field with a basis. It includes the width if that differs from the width of the bundle's first such
    field."""
    rank = len(field.basis)
    return f"{kind}-r{rank}" if field.width == usual_width else f"{kind}-w{field.width}-r{rank}"


def _hold_direct_sound(fields: Sequence[Learner | ImportedDataset]) -> bool:
    """Whether these fields of a simulated scene include the direct sound. Raises ExportError if only some do."""
    holding = [isinstance(field, NafLearner) and field.recipe.whole for field in fields]
    if any(holding) and not all(holding):
        raise ExportError("naf-whole holds the direct sound, other fields leave it out: export it to its own bundle")
    return all(holding)


def _require_used(fields: Sequence[Learner | ImportedDataset], variants: _Variants) -> None:
    """Raises ExportError for options that apply to none of the fields."""
    if variants.ranks and not any(isinstance(field, BasisLearner) for field in fields):
        raise ExportError("ranks: none of the runs is a field with a basis, and other fields have none; leave it out")
    if variants.exact_tables and not any(isinstance(field, NafLearner) for field in fields):
        raise ExportError("exact-tables: none of the runs is a naf, and other fields have none; leave it out")
    if list(variants.precisions) != ["float32"] and all(isinstance(field, ImportedDataset) for field in fields):
        raise ExportError("precision: measured responses themselves are stored in float32 only; leave it out")


def _require_different(names: list[str]) -> None:
    if duplicates := {name for name in names if names.count(name) > 1}:
        raise ExportError(f"{', '.join(sorted(duplicates))}: more than one run makes a field of that name")


@dataclass(frozen=True)
class _Form:
    """How fields of one kind with a basis become graphs."""

    module: type[ExportedField | ExportedDirections]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    known_frames: int
    order: int | None
    doors: tuple[str, ...] = ()


def _form_of(learner: BasisLearner) -> _Form:
    if isinstance(learner, FactorisedLearner):
        return _Form(ExportedField, (*INPUTS, PATH), _outputs(learner), learner.cells.known_frames, None)
    if isinstance(learner, DirectionalLearner):
        order = learner.recipe.order
        outputs = (LOG_MAGNITUDE, DIRECTIONS)[: 1 + (order > 0)]
        assert isinstance(learner.responses, SimulatedResponses)
        if doors := learner.responses.dataset.doors:
            inputs = (*DIRECTIONAL_INPUTS, PATH, OPENNESS)
            return _Form(ExportedDirectionsOfDoors, inputs, outputs, 0, order, doors)
        return _Form(ExportedDirections, (*DIRECTIONAL_INPUTS, PATH), outputs, 0, order)
    raise TypeError(f"{type(learner)} has no graph")


def _of_a_basis(
    learner: BasisLearner, configuration: Configuration, variants: _Variants, usual_width: int
) -> list[_Exported]:
    """All graphs of a run of a factorised or directional field, each checked."""
    form, cells, whole, kind = _form_of(learner), learner.cells, learner.field, configuration.name
    trained_at, poses = (
        _poses(learner.responses, count, configuration.seed, form.inputs)
        for count in (_TRUNCATION_POSES, _CHECK_POSES[kind])
    )
    lower = sorted({rank for rank in variants.ranks if rank < len(whole.basis)}, reverse=True)
    codec = _codec_parameters(cells.codec, form.known_frames, cells.all_frames)
    traced = to_onnx(form.module(whole, cells).eval(), _tensors(poses, 2), form.outputs, inputs=form.inputs)
    exported = []
    for field in (whole, *(whole.truncated(rank, *_tensors(trained_at, _TRUNCATION_POSES)) for rank in lower)):
        module = form.module(field, cells).eval()
        graph = traced if field is whole else with_weights(traced, module)
        for precision in variants.precisions:
            least_weights = min(_INT8_LEAST_WEIGHTS, field.basis.numel())
            small = to_int8(graph, least_weights=least_weights) if precision == "int8" else graph
            model = halve_weights(small)
            _check(model, module, poses, form.outputs, precision, inputs=form.inputs)
            name = f"{_sized_name(kind, field, usual_width)}{_suffix(precision)}"
            exported.append(_Exported(name, model, kind, len(field.basis), codec, form.order, form.doors))
    return exported


def _naf(learner: NafLearner, configuration: Configuration, variants: _Variants) -> list[_Exported]:
    """All graphs of a naf's run, each checked."""
    field = learner.field
    time_domain = field.shape.domain == "time"
    outputs = (RESPONSE,) if time_domain else _outputs(learner)
    codec = _codec_parameters(learner.codec, 0 if time_domain else learner.codec.frames)
    poses = _poses(learner.responses, _CHECK_POSES["naf"], configuration.seed)
    exported = []
    for tabled in (False, True)[: 1 + variants.exact_tables]:
        module = NafGraph(field, learner.codec, tabled=tabled).eval()
        graph = to_onnx(module, _tensors(poses, 1), outputs, free_batch=False)
        for precision in variants.precisions:
            small = to_int8(graph, least_weights=field.shape.width**2) if precision == "int8" else graph
            model = pose_by_pose(halve_weights(small))
            _check(model, module, poses, outputs, precision)
            name = f"{configuration.name}{'-tables' if tabled else ''}{_suffix(precision)}"
            exported.append(_Exported(name, model, configuration.name, None, codec))
    if variants.exact_tables:
        _check_tables(learner, poses)
    return exported


def _shaped(dataset: ImportedDataset) -> _Exported:
    measured = measured_pairs(dataset)
    shaped = ShapedNearest(measured.pairs, measured.delays_s, dataset.sample_rate)
    module = ShapedNearestGraph(shaped, measured.yaws, lead=LEAD_SAMPLES).eval()
    poses = _poses(dataset, _CHECK_POSES[SHAPED_NEAREST], seed=0)
    model = pose_by_pose(to_onnx(module, _tensors(poses, 1), (RESPONSE,), free_batch=False))
    _check(model, module, poses, (RESPONSE,), "float32")
    return _Exported(SHAPED_NEAREST, model, SHAPED_NEAREST, None, _codec_parameters(codec_of(dataset), 0))


def _suffix(precision: Precision) -> str:
    return "" if precision == "float32" else f"-{precision}"


def _outputs(learner: FactorisedLearner | NafLearner) -> tuple[str, ...]:
    """The outputs of a field. For one channel there is no coherence between ears."""
    return OUTPUTS[: 2 + learner.responses.channels]


def _codec_parameters(codec: Codec, known_frames: int, frames: Axis | None = None) -> CodecParameters:
    return CodecParameters(
        sample_rate=codec.sample_rate,
        n_fft=codec.n_fft,
        hop=codec.hop,
        samples=codec.samples,
        lead_samples=LEAD_SAMPLES,
        known_frames=known_frames,
        log_floor=codec.log_floor,
        frame_cells=None if frames is None else tuple(frames.widths.tolist()),
    )


def _poses(
    responses: ResponseSet, count: int, seed: int, inputs: tuple[str, ...] = tuple(INPUTS)
) -> tuple[npt.NDArray[np.float32], ...]:
    """Random poses near the measured ones, as the `inputs` of a graph."""
    rng = np.random.default_rng(seed)
    listener, emitter = (
        end[rng.integers(0, len(end), count)] + rng.uniform(-0.05, 0.05, (count, 3))
        for end in (responses.listener, responses.emitter)
    )
    yaw = rng.uniform(-np.pi, np.pi, count)
    given: dict[str, npt.NDArray[np.floating]] = {"listener": listener, "emitter": emitter, "yaw": yaw}
    openness = None
    if OPENNESS in inputs:
        assert isinstance(responses, SimulatedResponses)
        openness = given[OPENNESS] = responses.openness[rng.integers(0, len(responses.openness), count)]
    if PATH in inputs:
        given[PATH] = Site.of(responses).paths(listener, emitter, openness)
    return tuple(given[name].astype(np.float32) for name in inputs)


def _tensors(poses: tuple[npt.NDArray[np.float32], ...], count: int) -> tuple[torch.Tensor, ...]:
    return tuple(torch.from_numpy(part[:count]) for part in poses)


def _check(
    model: onnx.ModelProto,
    module: nn.Module,
    poses: tuple[npt.NDArray[np.float32], ...],
    outputs: tuple[str, ...],
    precision: Precision,
    *,
    inputs: tuple[str, ...] = tuple(INPUTS),
) -> None:
    session = open_session(model.SerializeToString())
    found = dict(zip(outputs, session.run(list(outputs), dict(zip(inputs, poses, strict=True))), strict=True))
    with torch.no_grad():
        # One pose at a time, because a batch of `naf` would not fit into memory.
        rows = [module(*(torch.from_numpy(part[row : row + 1]) for part in poses)) for row in range(len(poses[0]))]
    expected = {name: np.concatenate([row[number] for row in rows]) for number, name in enumerate(outputs)}
    for name, tolerance in _TOLERANCES[precision].items():
        if name not in outputs:
            continue
        error = np.abs(found[name] - expected[name])
        scale = np.std(expected[name]) if name == RESPONSE else 1.0
        difference = float(np.max(error) if precision == "float32" else np.sqrt(np.mean(error**2))) / scale
        if not difference < tolerance:
            raise ExportError(
                f"{name}: the exported graph differs from torch by {difference:.3g}, more than {tolerance}"
            )
    if "instantaneous_frequency" not in outputs:
        return
    phases = [np.cumsum(values["instantaneous_frequency"], axis=-1) for values in (found, expected)]
    weight = np.minimum(found["phase_certainty"], expected["phase_certainty"]) ** 2
    difference = float(np.mean(np.abs(np.exp(1j * phases[0]) - np.exp(1j * phases[1])) * weight))
    if not difference < _PHASE_TOLERANCE[precision]:
        raise ExportError(f"instantaneous_frequency: the exported graph's phase differs from torch by {difference:.3g}")


def _check_tables(learner: NafLearner, poses: tuple[npt.NDArray[np.float32], ...]) -> None:
    with torch.no_grad():
        plain, tabled = (
            NafGraph(learner.field, learner.codec, tabled=tabled)(*_tensors(poses, 1))[0] for tabled in (False, True)
        )
    difference = float((plain - tabled).abs().max())
    if not difference < TABLED_TOLERANCE:
        raise ExportError(f"exact tables: differ from the plain network by {difference:.3g}")
