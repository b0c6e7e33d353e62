"""A trained field to a scene bundle. The graph is checked against torch before anything is written."""

import io
import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
import torch
from onnx import numpy_helper

from server.errors import NafirError
from server.field.graph import INPUTS, OUTPUTS
from server.field.runtime import open_session
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import ARRAYS_FILE, Bounds, CodecParameters, FieldFile, Manifest, QualityLevel
from training.dataset import SPEED_OF_SOUND, Dataset
from training.models.cells import Cells
from training.models.factorised import ExportedField
from training.models.frozen_noise import even_noise
from training.models.targets import LEAD_SAMPLES
from training.train import load_field

MODEL_FILE = "factorised.onnx"

_OPSET = 18
_HALVE_ABOVE_BYTES = 16_384
_CHECK_POSES = 64
# float16 weights are the only difference; phases of uncertain bins may turn, so frequency is compared where it matters.
_TOLERANCE = {"log_magnitude": 0.05, "phase_certainty": 0.02, "interaural_coherence": 0.02}
_PHASE_TOLERANCE = 0.05


class ExportError(NafirError):
    """An exported graph that does not compute what the trained field computes."""


def export(dataset: Dataset, run: Path, folder: Path) -> Bundle:
    """Writes the bundle of a finished run. Raises RunError for an unfinished one and ExportError for a graph that
    disagrees."""
    field, cells, configuration = load_field(dataset, run)
    module = ExportedField(field, cells).eval()
    model = halve_weights(to_onnx(module, dataset))
    _check(model, module, dataset, configuration.seed)
    noise = even_noise(cells.codec, np.random.default_rng([configuration.seed, 6]))
    arrays = io.BytesIO()
    np.savez(arrays, frozen_noise=noise)
    files = {MODEL_FILE: model.SerializeToString(), ARRAYS_FILE: arrays.getvalue()}
    return write_bundle(folder, _manifest(dataset, cells, configuration.shape.rank, files), files)


def to_onnx(module: ExportedField, dataset: Dataset) -> onnx.ModelProto:
    """The graph with a free batch axis, and nothing in it but the graph."""
    poses = tuple(torch.from_numpy(array) for array in _poses(dataset, 2, seed=0))
    batch = torch.export.Dim("batch")
    with warnings.catch_warnings():
        # PyTorch's exporter about its own pytrees, and about the one name that all three batch axes share.
        warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning)
        warnings.filterwarnings("ignore", r"# The axis name: batch will not be used", UserWarning)
        program = torch.onnx.export(
            module,
            poses,
            input_names=list(INPUTS),
            output_names=list(OUTPUTS),
            dynamic_shapes={name: {0: batch} for name in INPUTS},
            opset_version=_OPSET,
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        # The exporter notes call stacks, with paths of the machine it ran on: no scene should carry those.
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    return model


def halve_weights(model: onnx.ModelProto) -> onnx.ModelProto:
    """Stores large float32 constants as float16, cast back as the graph is loaded: half the bundle, the same
    arithmetic."""
    graph = model.graph
    casts = []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.nbytes < _HALVE_ABOVE_BYTES:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}_half"], [name], to=onnx.TensorProto.FLOAT))
    for position, node in enumerate(casts):
        graph.node.insert(position, node)
    onnx.checker.check_model(model)
    return model


def _poses(dataset: Dataset, count: int, seed: int) -> tuple[npt.NDArray[np.float32], ...]:
    """Random listener, emitter and yaw among the probes' neighbourhoods."""
    rng = np.random.default_rng(seed)
    chosen = rng.integers(0, len(dataset.probes), (2, count))
    listener, emitter = (dataset.probes[side] + rng.uniform(-0.05, 0.05, (count, 3)) for side in chosen)
    yaw = rng.uniform(-np.pi, np.pi, count)
    return listener.astype(np.float32), emitter.astype(np.float32), yaw.astype(np.float32)


def _check(model: onnx.ModelProto, module: ExportedField, dataset: Dataset, seed: int) -> None:
    session = open_session(model.SerializeToString())
    poses = _poses(dataset, _CHECK_POSES, seed)
    found = dict(zip(OUTPUTS, session.run(list(OUTPUTS), dict(zip(INPUTS, poses, strict=True))), strict=True))
    with torch.no_grad():
        expected = dict(zip(OUTPUTS, (out.numpy() for out in module(*map(torch.from_numpy, poses))), strict=True))
    for name, tolerance in _TOLERANCE.items():
        difference = float(np.max(np.abs(found[name] - expected[name])))
        if not difference < tolerance:
            raise ExportError(
                f"{name}: the exported graph differs from torch by {difference:.3g}, more than {tolerance}"
            )
    phases = [np.cumsum(outputs["instantaneous_frequency"], axis=-1) for outputs in (found, expected)]
    weight = np.minimum(found["phase_certainty"], expected["phase_certainty"]) ** 2
    difference = float(np.mean(np.abs(np.exp(1j * phases[0]) - np.exp(1j * phases[1])) * weight))
    if not difference < _PHASE_TOLERANCE:
        raise ExportError(f"instantaneous_frequency: the exported graph's phase differs from torch by {difference:.3g}")


def _manifest(dataset: Dataset, cells: Cells, rank: int, files: dict[str, bytes]) -> Manifest:
    scene, codec = dataset.scene, cells.codec
    low, high = np.min(scene.geometry.corners, axis=0), np.max(scene.geometry.corners, axis=0)
    return Manifest(
        id=scene.id,
        name=scene.name,
        description=scene.description,
        geometry=scene.geometry,
        bounds=Bounds(
            minimum=(float(low[0]), float(low[1]), scene.probes.heights_m[0]),
            maximum=(float(high[0]), float(high[1]), scene.probes.heights_m[1]),
        ),
        speed_of_sound=SPEED_OF_SOUND,
        air=scene.air,
        start=scene.start,
        codec=CodecParameters(
            sample_rate=codec.sample_rate,
            n_fft=codec.n_fft,
            hop=codec.hop,
            samples=codec.samples,
            lead_samples=LEAD_SAMPLES,
            known_frames=cells.known_frames,
            log_floor=codec.log_floor,
        ),
        fields={"factorised": FieldFile(file=MODEL_FILE, architecture="factorised", rank=rank)},
        levels=(QualityLevel(name="standard", field="factorised"),),
        files=dict.fromkeys(files, "0" * 64),
    )
