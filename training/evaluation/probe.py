"""A probe of what a field has learned about walls: the distance from the listener to the nearest wall, decoded linearly
from its hidden features, compared with decoding from MFCC of the true responses (Luo et al., NeurIPS 2022, section
4.4).

Rows are pairs of probes, places are their listeners. If a field predicts point by point in time and frequency, the
features of a pose are the mean over all points. Metres, radians.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from server.acoustics.geometry import FloorPlan
from server.field.graphs import graph_of
from server.field.runtime import open_session
from server.scene.bundle import Bundle
from training.baselines.held_out import EvaluationError, HeldOut, require_same_scene
from training.evaluation.decoding import FOLDS, Decoding, RidgeRegression, decode
from training.evaluation.mfcc import mfcc

_Floats = npt.NDArray[np.float64]
Track = Callable[[Sequence[int], str], Iterable[int]]

HIDDEN = "hidden_features"
_PRODUCTS = {"MatMul", "Gemm"}
_MOST_AXES = 3  # of a layer's input; products that convert bands and frames have more
_CHUNK = 64
_YAWS = 2
_MAPPED_EMITTERS = 4
_SPACING_M = 0.2


def with_hidden_output(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return the graph with an additional output HIDDEN: the input of its last linear layer.

    Raises EvaluationError for a graph without one, for example with integer weights.
    """
    model = onnx.shape_inference.infer_shapes(model)
    scan = next((node for node in model.graph.node if node.op_type == "Scan"), None)
    graph = model.graph if scan is None else next(entry.g for entry in scan.attribute if entry.name == "body")
    tensor, axes = _last_layer_input(graph)
    if scan is None:
        graph.node.append(helper.make_node("Identity", [tensor], [HIDDEN]))
    else:
        # Inside a scan, features are averaged for each pose, to save memory.
        graph.initializer.append(numpy_helper.from_array(np.arange(axes - 1), f"{HIDDEN}_axes"))
        graph.node.append(helper.make_node("ReduceMean", [tensor, f"{HIDDEN}_axes"], [f"{HIDDEN}_of_pose"], keepdims=0))
        graph.output.append(helper.make_tensor_value_info(f"{HIDDEN}_of_pose", TensorProto.FLOAT, None))
        scan.output.append(HIDDEN)
    model.graph.output.append(helper.make_tensor_value_info(HIDDEN, TensorProto.FLOAT, None))
    return model


def _last_layer_input(graph: onnx.GraphProto) -> tuple[str, int]:
    """The name and the number of axes of the input of the last product with constant weights."""
    constant = {tensor.name for tensor in graph.initializer}
    axes = {value.name: len(value.type.tensor_type.shape.dim) for value in (*graph.value_info, *graph.input)}
    last: tuple[str, int] | None = None
    if any(node.op_type == "MatMulInteger" for node in graph.node):
        raise EvaluationError("probe: the graph's weights are integers; probe the float32 field of the same run")
    for node in graph.node:
        if node.op_type == "Constant" or (node.input and all(name in constant for name in node.input)):
            constant.update(node.output)
        elif node.op_type in _PRODUCTS and node.input[1] in constant:
            given = node.input[0]
            if given in axes and axes[given] <= _MOST_AXES:
                last = given, axes[given]
    if last is None:
        raise EvaluationError("probe: the graph has no linear layer with constant weights")
    return last


class HiddenFeatures:
    """Computes the features of poses with one of a bundle's fields."""

    def __init__(self, bundle: Bundle, field: str) -> None:
        model = onnx.load_model_from_string(bundle.models[bundle.manifest.fields[field].file])
        self._session = open_session(with_hidden_output(model).SerializeToString())
        self._graph = graph_of(bundle, field, self._session)

    def of(self, listeners: _Floats, emitters: _Floats, yaws: _Floats) -> _Floats:
        """Compute features (B, feature) for listeners (B, 3), emitters (B, 3) and yaws (B,)."""
        features = []
        for start in range(0, len(yaws), _CHUNK):
            part = slice(start, start + _CHUNK)
            (hidden,) = self._session.run([HIDDEN], self._graph.feed(listeners[part], emitters[part], yaws[part]))
            features.append(hidden.reshape(len(yaws[part]), -1, hidden.shape[-1]).mean(axis=1, dtype=np.float64))
        return np.concatenate(features)


@dataclass(frozen=True)
class ProbeResult:
    """The result of a probe. places: (place, 3) listeners; distance_m: (place,) to the nearest wall, in plan. The map
    has cells (cell, 2) in the room, at steps of spacing_m, with their true distances and those decoded from the field's
    features."""

    field: str
    plan: FloorPlan
    places: _Floats
    distance_m: _Floats
    features: Decoding
    coefficients: Decoding
    cells: _Floats
    spacing_m: float
    true_map_m: _Floats
    decoded_map_m: _Floats

    def to_json(self) -> dict[str, object]:
        return {
            "field": self.field,
            "places": len(self.places),
            "explained_variance": {
                name: {"mean": decoding.mean, "standard_deviation": decoding.spread}
                for name, decoding in (("features", self.features), ("mfcc", self.coefficients))
            },
            "mean_error_m": {
                name: float(np.abs(decoding.predicted - self.distance_m).mean())
                for name, decoding in (("features", self.features), ("mfcc", self.coefficients))
            },
        }


def probe(
    bundle: Bundle,
    held_out: HeldOut,
    *,
    field: str | None = None,
    emitters: int | None = None,
    seed: int = 0,
    track: Track = lambda steps, _: steps,
) -> ProbeResult:
    """Decode the distance to the nearest wall at each probe of the dataset from the features of a field (by default
    that of the first quality level), for `emitters` random probes as emitters, or all.

    Raises EvaluationError for measured data, whose walls are unknown, for too few probes, and for a field that the
    bundle lacks or that has no features; DatasetError if the bundle is of another scene.
    """
    dataset = held_out.simulated
    if dataset is None:
        raise EvaluationError(f"{held_out.name}: a probe needs a simulated scene, whose walls are known")
    require_same_scene(bundle, dataset)
    name = bundle.manifest.levels[0].field if field is None else field
    if name not in bundle.manifest.fields:
        raise EvaluationError(f"--field: {bundle.folder} has no {name!r}, but {', '.join(bundle.manifest.fields)}")
    places = dataset.probes
    if len(places) <= FOLDS:
        raise EvaluationError(f"{held_out.name}: {len(places)} probes are too few to decode from")
    hidden = HiddenFeatures(bundle, name)
    yaw_indices = np.linspace(0, len(held_out.yaws), _YAWS, endpoint=False).astype(int)
    rng = np.random.default_rng([seed, 12])
    count = len(places) if emitters is None else min(emitters, len(places))
    features, coefficients, place = [], [], []
    for emitter in track(sorted(int(number) for number in rng.choice(len(places), count, replace=False)), "probing"):
        others = np.flatnonzero(np.arange(len(places)) != emitter)
        features.append(_features(hidden, places[others], places[emitter], held_out.yaws[yaw_indices]))
        for listener in others:
            response = held_out.pairs.response(emitter * len(places) + int(listener))[yaw_indices]
            coefficients.append(mfcc(response, held_out.sample_rate).mean(axis=(0, 1)).ravel())
        place.append(others)
    rows, at = np.concatenate(features), np.concatenate(place)
    distance_m = dataset.plan.wall_distance_m(places)
    cells = _cells(dataset.plan)
    heights = np.full((len(cells), 1), float(np.median(places[:, 2])))
    mapped = [
        _features(hidden, np.concatenate([cells, heights], axis=-1), places[emitter], held_out.yaws[yaw_indices])
        for emitter in rng.choice(len(places), min(_MAPPED_EMITTERS, len(places)), replace=False)
    ]
    reader = RidgeRegression.fit(rows, distance_m[at])
    return ProbeResult(
        name,
        dataset.plan,
        places,
        distance_m,
        decode(rows, at, distance_m, seed=seed),
        decode(np.stack(coefficients), at, distance_m, seed=seed),
        cells,
        _SPACING_M,
        dataset.plan.wall_distance_m(np.concatenate([cells, heights], axis=-1)),
        np.mean([reader.predict(of_emitter) for of_emitter in mapped], axis=0),
    )


def _features(hidden: HiddenFeatures, listeners: _Floats, emitter: _Floats, yaws: _Floats) -> _Floats:
    """(listener, feature) features, mean over yaws."""
    positions, heads = np.repeat(listeners, len(yaws), axis=0), np.tile(yaws, len(listeners))
    features = hidden.of(positions, np.broadcast_to(emitter, positions.shape), heads)
    return np.asarray(features.reshape(len(listeners), len(yaws), -1).mean(axis=1))


def _cells(plan: FloorPlan) -> _Floats:
    """(cell, 2) centres of the cells of a grid over the plan that are in the room."""
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    x, y = (np.arange(a + _SPACING_M / 2, b, _SPACING_M) for a, b in zip(low, high, strict=True))
    cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return cells[plan.contains(np.concatenate([cells, np.zeros((len(cells), 1))], axis=-1))]
