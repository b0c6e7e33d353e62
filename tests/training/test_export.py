from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from server.field.runtime import open_session
from training import export as export_module
from training.export import INPUTS, MODEL_FILE, OUTPUTS, ExportError, export
from training.graphs import halve_weights
from training.models.factorised import ExportedField
from training.responses import SimulatedResponses
from training.train import load_learner


@pytest.fixture(scope="module")
def session(tiny_bundle):
    return open_session(tiny_bundle.models[MODEL_FILE])


def poses(count, seed=1):
    rng = np.random.default_rng(seed)
    ends = (rng.uniform((0.4, 0.4, 1.2), (3.6, 2.6, 1.8), (count, 3)) for _ in range(2))
    return [array.astype(np.float32) for array in (*ends, rng.uniform(-3, 3, count))]


def answer(session, arrays):
    return dict(zip(OUTPUTS, session.run(list(OUTPUTS), dict(zip(INPUTS, arrays, strict=True))), strict=True))


def test_the_graph_computes_what_torch_does(session, dataset, run):
    learner = load_learner(SimulatedResponses(dataset), run)
    arrays = poses(40)
    with torch.no_grad():
        expected = [
            out.numpy() for out in ExportedField(learner.field, learner.cells).eval()(*map(torch.from_numpy, arrays))
        ]
    found = answer(session, arrays)
    np.testing.assert_allclose(found["log_magnitude"], expected[0], atol=0.03)
    np.testing.assert_allclose(found["phase_certainty"], expected[2], atol=0.01)
    np.testing.assert_allclose(found["interaural_coherence"], expected[3], atol=0.01)
    phasors = [
        certainty * np.exp(1j * np.cumsum(frequency, axis=-1))
        for frequency, certainty in ((found["instantaneous_frequency"], found["phase_certainty"]), expected[1:3])
    ]
    np.testing.assert_allclose(phasors[0], phasors[1], atol=0.03)


def test_poses_in_a_batch_do_not_meet(session):
    arrays = poses(9)
    together = answer(session, arrays)
    for row in range(9):
        alone = answer(session, [array[row : row + 1] for array in arrays])
        for name in ("log_magnitude", "phase_certainty", "interaural_coherence"):
            np.testing.assert_allclose(alone[name][0], together[name][row], atol=1e-4)


@pytest.mark.parametrize("name", INPUTS)
def test_the_batch_axis_is_free(session, name):
    entry = next(entry for entry in session.get_inputs() if entry.name == name)
    assert isinstance(entry.shape[0], str)


def test_the_graph_tells_nothing_of_the_machine_it_was_made_on(tiny_bundle):
    data = tiny_bundle.models[MODEL_FILE]
    for secret in (str(Path(export_module.__file__).parent), "site-packages", "stack_trace", "Traceback"):
        assert secret.encode() not in data


def two_weights(large):
    """y = x @ large + small, the first large enough to be halved."""
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "large"], ["xl"]), helper.make_node("Add", ["xl", "small"], ["y"])],
        "two",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["B", large.shape[0]])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["B", large.shape[1]])],
        [
            numpy_helper.from_array(large, "large"),
            numpy_helper.from_array(np.full(large.shape[1], 1 / 3, np.float32), "small"),
        ],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def test_halving_keeps_weights_within_float16():
    large = np.random.default_rng(0).standard_normal((128, 128)).astype(np.float32)
    model = two_weights(large)
    size = len(model.SerializeToString())
    halved = halve_weights(model)
    assert len(halved.SerializeToString()) < 0.6 * size
    session = open_session(halved.SerializeToString())
    (read,) = session.run(["y"], {"x": np.eye(128, dtype=np.float32)})
    np.testing.assert_allclose(read - np.float32(1 / 3), large, rtol=2**-11, atol=1e-6)


def test_small_weights_stay_as_they_are():
    halved = halve_weights(two_weights(np.ones((128, 128), np.float32)))
    (small,) = [numpy_helper.to_array(t) for t in halved.graph.initializer if t.name == "small"]
    np.testing.assert_array_equal(small, np.full(128, 1 / 3, np.float32))


def scaled_up(data, name):
    """The graph with its largest weight, the basis, damaged."""
    model = onnx.load_from_string(data)
    tensor = next(t for t in model.graph.initializer if t.name.startswith(name))
    values = numpy_helper.to_array(tensor).astype(np.float32)
    tensor.CopyFrom(numpy_helper.from_array((1.5 * values).astype(np.float16), tensor.name))
    return model


def test_a_graph_that_disagrees_is_not_written(dataset, run, tiny_bundle, tmp_path, monkeypatch):
    damaged = scaled_up(tiny_bundle.models[MODEL_FILE], "_field.basis")
    monkeypatch.setattr(export_module, "to_onnx", lambda *_, **__: damaged)
    with pytest.raises(ExportError, match="differs from torch"):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_a_field_of_numbers_too_large_for_float16_is_not_written(dataset, run, tiny_bundle, tmp_path, monkeypatch):
    model = onnx.load_from_string(tiny_bundle.models[MODEL_FILE])
    tensor = next(t for t in model.graph.initializer if t.name.startswith("_field.mean"))
    values = numpy_helper.to_array(tensor).astype(np.float32)
    values[0] = np.inf
    tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), tensor.name))
    monkeypatch.setattr(export_module, "to_onnx", lambda *_, **__: model)
    with pytest.raises(ExportError):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_the_manifest_describes_the_scene(tiny_bundle, dataset):
    manifest, scene = tiny_bundle.manifest, dataset.scene
    assert manifest.geometry == scene.geometry
    assert manifest.codec.samples == dataset.samples
    assert manifest.codec.sample_rate == dataset.sample_rate
    probes = dataset.probes
    assert (probes >= manifest.bounds.minimum).all()
    assert (probes <= manifest.bounds.maximum).all()
    for position in (manifest.start.listener, manifest.start.emitter):
        tiny_bundle.require_inside(position, "start")
