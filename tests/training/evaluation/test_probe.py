import json

import numpy as np
import onnx
import pytest
from PIL import Image

from server.field.graph import INPUTS, OUTPUTS, PATH
from server.field.runtime import open_session
from tests.training.told_paths import in_tiny
from training.baselines.held_out import EvaluationError, open_held_out
from training.evaluation.probe import HIDDEN, HiddenFeatures, probe, with_hidden_output
from training.evaluation.probe_figure import draw_probe


@pytest.fixture(scope="module")
def model(tiny_bundle) -> onnx.ModelProto:
    (data,) = tiny_bundle.models.values()
    return onnx.load_model_from_string(data)


@pytest.fixture(scope="module")
def poses():
    random = np.random.default_rng(0)
    listener, emitter = random.uniform((0.5, 0.5, 1.2), (3.5, 2.5, 1.8), (2, 60, 3))
    values = listener, emitter, random.uniform(-3, 3, 60), in_tiny(listener, emitter)
    return {name: value.astype(np.float32) for name, value in zip((*INPUTS, PATH), values, strict=True)}


@pytest.fixture(scope="module")
def probing(tiny_bundle, dataset):
    with open_held_out(dataset.folder) as held_out:
        return probe(tiny_bundle, held_out)


def test_the_graph_says_what_it_said_and_its_answer_is_linear_in_what_it_hides(model, poses):
    answers = open_session(model.SerializeToString()).run(list(OUTPUTS), poses)
    *same, hidden = open_session(with_hidden_output(model).SerializeToString()).run([*OUTPUTS, HIDDEN], poses)
    for answer, again in zip(answers, same, strict=True):
        np.testing.assert_array_equal(answer, again)
    log_magnitude = answers[0].reshape(len(hidden), -1)
    free = log_magnitude.min(axis=0) > log_magnitude.min() + 1e-3  # the rest lies on the floor of silence
    design = np.column_stack([hidden, np.ones(len(hidden))])
    assert design.shape[1] < len(design) / 2
    _, residual, rank, _ = np.linalg.lstsq(design, log_magnitude[:, free], rcond=None)
    assert rank == design.shape[1]
    assert free.sum() > 1_000
    assert residual.max() < 1e-6 * np.square(log_magnitude[:, free]).sum(axis=0).max()


def layers(inputs, width):
    """Two linear layers of known weights over points (.., 3): nodes, initializers and the weights."""
    random = np.random.default_rng(7)
    first, last = random.standard_normal((3, width)), random.standard_normal((width, 2))
    nodes = [
        onnx.helper.make_node("MatMul", [inputs, "first"], ["product"]),
        onnx.helper.make_node("Relu", ["product"], ["activation"]),
        onnx.helper.make_node("Cast", ["last_half"], ["last"], to=onnx.TensorProto.FLOAT),
        onnx.helper.make_node("MatMul", ["activation", "last"], ["answer"]),
    ]
    weights = [
        onnx.numpy_helper.from_array(first.astype(np.float32), "first"),
        onnx.numpy_helper.from_array(last.astype(np.float16), "last_half"),
    ]
    return nodes, weights, first


def value(name, *shape):
    return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)


def model_of(graph):
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)


def test_a_field_that_answers_point_by_point_hides_the_mean_over_points(poses):
    """The same layers in one graph over all poses, and in a scan over them, pose by pose."""
    points = np.stack([poses["listener"], poses["emitter"], 2 * poses["listener"]], axis=1)  # (pose, point, 3)
    nodes, weights, first = layers("points", 8)
    whole = onnx.helper.make_graph(
        nodes, "g", [value("points", "batch", 3, 3)], [value("answer", "batch", 3, 2)], weights
    )
    expected = np.maximum(points @ first, 0)
    hidden = open_session(with_hidden_output(model_of(whole)).SerializeToString()).run([HIDDEN], {"points": points})[0]
    np.testing.assert_allclose(hidden, expected, rtol=1e-4, atol=1e-5)

    of_pose = onnx.helper.make_graph(nodes, "pose", [value("points", 3, 3)], [value("answer", 3, 2)], weights)
    scan = onnx.helper.make_node("Scan", ["all_points"], ["answers"], body=of_pose, num_scan_inputs=1)
    outer = onnx.helper.make_graph([scan], "g", [value("all_points", "batch", 3, 3)], [value("answers", "batch", 3, 2)])
    session = open_session(with_hidden_output(model_of(outer)).SerializeToString())
    answers, hidden = session.run(["answers", HIDDEN], {"all_points": points})
    assert answers.shape == (60, 3, 2)
    np.testing.assert_allclose(hidden, expected.mean(axis=1), rtol=1e-4, atol=1e-5)


def test_a_graph_without_layers_is_refused():
    nodes = [onnx.helper.make_node("Relu", ["listener"], ["out"])]
    graph = onnx.helper.make_graph(nodes, "g", [value("listener", "batch", 3)], [value("out", "batch", 3)])
    with pytest.raises(EvaluationError, match="no linear layer"):
        with_hidden_output(model_of(graph))


def test_a_graph_of_integers_is_refused():
    """Its last layers are not to be seen, and an earlier one would be taken for them."""
    nodes, weights, _ = layers("points", 8)
    integers = onnx.helper.make_node("MatMulInteger", ["bytes", "byte_weights"], ["sums"])
    inputs = [
        value("points", "batch", 3, 3),
        onnx.helper.make_tensor_value_info("bytes", onnx.TensorProto.INT8, [1, 2]),
    ]
    weights.append(onnx.numpy_helper.from_array(np.ones((2, 2), np.int8), "byte_weights"))
    graph = onnx.helper.make_graph([*nodes, integers], "g", inputs, [value("answer", "batch", 3, 2)], weights)
    with pytest.raises(EvaluationError, match="integers"):
        with_hidden_output(model_of(graph))


def test_features_do_not_depend_on_how_many_poses_are_asked_for(tiny_bundle, poses):
    features = HiddenFeatures(tiny_bundle, "factorised")
    values = [np.tile(value, (3, *(1,) * (value.ndim - 1))) for value in list(poses.values())[:3]]
    together = features.of(*values)
    assert len(together) == 180
    np.testing.assert_allclose(together[170:171], features.of(*(value[170:171] for value in values)), atol=1e-5)


def test_distances_are_those_of_the_plan(probing, dataset):
    for place, distance in zip(probing.places, probing.distance_m, strict=True):
        expected = min(place[0], 4 - place[0], place[1], 3 - place[1])
        assert distance == pytest.approx(expected)
    assert len(probing.places) == len(dataset.probes)
    assert len(probing.true_map_m) == len(probing.decoded_map_m) == 20 * 15


def test_what_was_decoded_is_told_and_drawn(probing, tmp_path):
    told = json.loads(json.dumps(probing.to_json(), allow_nan=False))
    assert told["explained_variance"].keys() == {"features", "mfcc"}
    draw_probe(probing, tmp_path / "probe.png")
    with Image.open(tmp_path / "probe.png") as picture:
        assert picture.size[0] > picture.size[1] > 200


def test_what_cannot_be_probed_is_refused(tiny_bundle, dataset):
    with open_held_out(dataset.folder) as held_out, pytest.raises(EvaluationError, match="no 'other', but factorised"):
        probe(tiny_bundle, held_out, field="other")
