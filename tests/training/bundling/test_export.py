import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from rich.progress import Progress

from server.field.fields_by_level import FieldsByLevel
from server.field.runtime import open_session
from tests.training.told_paths import in_tiny
from training.bundling import export as export_module
from training.bundling.export import INPUTS, MODEL_FILE, OUTPUTS, PATH, ExportError, export
from training.bundling.graphs import halve_weights, to_int8, to_onnx
from training.evaluation.fields import training_of
from training.learning.runs import Configuration, NafRecipe, record_of
from training.learning.train import load_learner, train
from training.models.factorised import ExportedField
from training.models.naf import NafShape
from training.models.naf_graph import NafGraph
from training.simulation.responses import SimulatedResponses


@pytest.fixture(scope="module")
def session(tiny_bundle):
    return open_session(tiny_bundle.models[MODEL_FILE])


def poses(count, seed=1):
    rng = np.random.default_rng(seed)
    ends = [rng.uniform((0.4, 0.4, 1.2), (3.6, 2.6, 1.8), (count, 3)) for _ in range(2)]
    return [array.astype(np.float32) for array in (*ends, rng.uniform(-3, 3, count), in_tiny(*ends))]


def answer(session, arrays):
    """The outputs by name; a naf is told no path."""
    given = dict(zip((*INPUTS, PATH), arrays, strict=True))
    feed = {each.name: given[each.name] for each in session.get_inputs()}
    return dict(zip(OUTPUTS, session.run(list(OUTPUTS), feed), strict=True))


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


def test_graphs_leave_the_logs_of_their_process_as_they_were(tiny_bundle):
    loggers = [logging.getLogger(name) for name in (None, "torch.onnx")]
    before = [logger.level for logger in loggers]
    assert before[0] == logging.WARNING
    to_onnx(torch.nn.Linear(3, 2).eval(), (torch.zeros(1, 3),), ("y",), free_batch=False)
    assert [logger.level for logger in loggers] == before
    to_int8(onnx.load_from_string(tiny_bundle.models[MODEL_FILE]), least_weights=1)
    assert [logger.level for logger in loggers] == before


def test_poses_in_a_batch_do_not_meet(session):
    arrays = poses(9)
    together = answer(session, arrays)
    for row in range(9):
        alone = answer(session, [array[row : row + 1] for array in arrays])
        for name in ("log_magnitude", "phase_certainty", "interaural_coherence"):
            np.testing.assert_allclose(alone[name][0], together[name][row], atol=1e-4)


@pytest.mark.parametrize("name", [*INPUTS, PATH])
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
    damaged = scaled_up(tiny_bundle.models[MODEL_FILE], "_basis")
    monkeypatch.setattr(export_module, "to_onnx", lambda *_, **__: damaged)
    with pytest.raises(ExportError, match="differs from torch"):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_a_field_of_numbers_too_large_for_float16_is_not_written(dataset, run, tiny_bundle, tmp_path, monkeypatch):
    model = onnx.load_from_string(tiny_bundle.models[MODEL_FILE])
    tensor = next(t for t in model.graph.initializer if t.name.startswith("_offset"))
    values = numpy_helper.to_array(tensor).astype(np.float32)
    values[0] = np.inf
    tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), tensor.name))
    monkeypatch.setattr(export_module, "to_onnx", lambda *_, **__: model)
    with pytest.raises(ExportError):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_overrides_of_the_scene_file_are_overrides_of_rendering(tiny_bundle, dataset):
    assert tiny_bundle.manifest.effects == dataset.scene.effects == {"early_reflections": True}


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


@pytest.fixture(scope="module")
def naf_run(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("naf") / "run"
    shape = NafShape(width=64, grid_features=4)
    configuration = Configuration.naf(shape, NafRecipe(points=60), epochs=4, batch=4, learning_rate=3e-3)
    train(SimulatedResponses(dataset), folder, configuration, Progress(disable=True))
    return folder


@pytest.fixture(scope="module")
def time_domain_run(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("time") / "run"
    configuration = Configuration.naf(NafShape(domain="time", width=16), NafRecipe(points=60), epochs=1, batch=4)
    train(SimulatedResponses(dataset), folder, configuration, Progress(disable=True))
    return folder


@pytest.fixture(scope="module")
def family(dataset, run, naf_run, tmp_path_factory):
    """A bundle of both kinds of fields in both precisions."""
    return export(
        SimulatedResponses(dataset),
        [run, naf_run],
        tmp_path_factory.mktemp("family") / "bundle",
        precisions=("float32", "int8"),
        exact_tables=True,
    )


def test_several_runs_become_fields_of_one_bundle(family):
    names = ["factorised", "factorised-r16-int8", "naf", "naf-int8", "naf-tables", "naf-tables-int8"]
    assert list(family.manifest.fields) == names
    of_noise = [level for level in family.manifest.levels if level.phase.kind == "frozen"]
    assert [level.name for level in of_noise] == ["standard", *names[1:]]
    assert [level.field for level in of_noise] == names
    fields = family.manifest.fields
    assert fields["factorised"].codec is None
    assert (fields["factorised"].rank, fields["naf"].rank) == (16, None)
    assert (fields["naf"].codec.n_fft, fields["naf"].codec.hop) == (512, 128)


def test_the_first_field_is_what_it_is_alone(family, tiny_bundle):
    assert family.models[MODEL_FILE] == tiny_bundle.models[MODEL_FILE]
    assert family.manifest.fields["factorised"] == tiny_bundle.manifest.fields["factorised"]
    assert family.manifest.levels[0] == tiny_bundle.manifest.levels[0]
    assert family.manifest.codec == tiny_bundle.manifest.codec


def test_a_naf_is_offered_with_the_phase_that_it_has_learned_too(family):
    learned = {level.name: level.field for level in family.manifest.levels if level.phase.kind == "integrated"}
    assert learned == {f"{name}-integrated": name for name in family.manifest.fields if name.startswith("naf")}
    levels = FieldsByLevel.load(family)
    noisy, own = (
        levels.choose(name).impulse_responses([(1.0, 1.0, 1.5)], [(3.0, 2.0, 1.5)], [0.3])[0].astype(float)
        for name in ("naf", "naf-integrated")
    )
    assert abs(np.corrcoef(noisy.ravel(), own.ravel())[0, 1]) < 0.5
    assert 0.1 < np.sum(own**2) / np.sum(noisy**2) < 10


def test_a_graph_says_how_far_it_was_trained(family, run, naf_run):
    assert training_of(family, "factorised.onnx") == record_of(run)
    assert training_of(family, "naf-tables-int8.onnx") == record_of(naf_run)
    assert record_of(naf_run).steps > 0


def test_the_papers_network_is_stored_in_half_precision_without_a_table_of_points(family, dataset, naf_run):
    """As fields with a basis are: two bytes for a weight and for a value of the normalisation, and little else."""
    field = load_learner(SimulatedResponses(dataset), naf_run).field
    values = sum(value.numel() for value in field.state_dict().values())
    assert 2 * values < len(family.models["naf.onnx"]) < 2.4 * values + 50_000


def test_all_of_them_are_heard(family):
    levels = FieldsByLevel.load(family)
    ends = [(1.0, 1.0, 1.5)], [(3.0, 2.0, 1.5)]
    responses = {name: field.impulse_responses(*ends, [0.3])[0] for name, field in levels.items()}
    assert all(np.isfinite(response).all() for response in responses.values())
    assert all(np.sum(response**2) > 0 for response in responses.values())
    # The same network, written in two ways.
    scale = np.abs(responses["naf"]).max()
    np.testing.assert_allclose(responses["naf-tables"], responses["naf"], atol=1e-3 * scale)


def _accept_any_health(monkeypatch):
    healthy = SimpleNamespace(require=lambda: None, accepted=())
    monkeypatch.setattr(export_module, "check_fields", lambda *_: SimpleNamespace(health=healthy))
    monkeypatch.setattr(export_module, "check", lambda *_, **__: healthy)


def test_a_field_in_the_time_domain_gives_responses(dataset, time_domain_run, tmp_path, monkeypatch):
    # A few steps of training make no field that is smooth enough for the health check.
    _accept_any_health(monkeypatch)
    bundle = export(SimulatedResponses(dataset), [time_domain_run], tmp_path / "bundle")
    assert list(bundle.manifest.fields) == ["naf-time-domain"]
    field = FieldsByLevel.load(bundle).default
    assert field.level.name == "standard"
    assert field.graph.gives_responses
    response = field.impulse_responses([(1.0, 1.0, 1.5)], [(3.0, 2.0, 1.5)], [0.3])[0]
    assert response.shape == (2, dataset.samples)
    assert np.isfinite(response).all()
    assert np.sum(response**2) > 0


def test_naf_of_whole_responses_holds_the_direct_sound(dataset, naf_run, tmp_path, monkeypatch):
    _accept_any_health(monkeypatch)
    responses = SimulatedResponses(dataset)
    configuration = Configuration.read(naf_run)
    whole = replace(configuration, recipe=replace(configuration.recipe, whole=True))
    train(responses, tmp_path / "whole", whole, Progress(disable=True))
    ends = np.array([(1.0, 1.0, 1.5)]), np.array([(3.0, 2.0, 1.5)])
    direct, orders = {}, {}
    for name, run in (("whole", tmp_path / "whole"), ("reflected", naf_run)):
        bundle = export(responses, [run], tmp_path / f"{name}-bundle")
        field = FieldsByLevel.load(bundle).default
        response = field.impulse_responses(*ends, [0.3])[0]
        first = round(float(field.onset_s(*ends)[0]) * dataset.sample_rate)
        direct[name] = np.sum(response[:, first - 20 : first + 60] ** 2)
        orders[name] = bundle.manifest.direct_sound, bundle.manifest.image_order
    assert orders == {"whole": ("field", 0), "reflected": ("geometry", 1)}
    assert direct["whole"] > 3 * direct["reflected"]


def test_fields_with_and_without_the_direct_sound_share_no_bundle(dataset, run, naf_run, tmp_path, monkeypatch):
    naf = load_learner(SimulatedResponses(dataset), naf_run)
    naf.recipe = replace(naf.recipe, whole=True)
    opened = {naf_run: naf, run: load_learner(SimulatedResponses(dataset), run)}
    monkeypatch.setattr(export_module, "_opened", lambda _, place: opened[place])
    with pytest.raises(ExportError, match="naf-whole holds the direct sound"):
        export(SimulatedResponses(dataset), [run, naf_run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_a_graph_of_naf_computes_what_torch_does_pose_by_pose(family, dataset, naf_run):
    learner = load_learner(SimulatedResponses(dataset), naf_run)
    arrays = poses(3)
    for name, tabled in (("naf.onnx", False), ("naf-tables.onnx", True)):
        graph = NafGraph(load_learner(learner.responses, naf_run).field, learner.codec, tabled=tabled)
        with torch.no_grad():
            for values in (*graph.parameters(), *graph.buffers()):
                if values.nbytes >= 16_384:  # stored in half precision
                    values.copy_(values.half().float())
            expected = graph(*map(torch.from_numpy, arrays[:3]))
        found = answer(open_session(family.models[name]), arrays)
        for output, values in zip(OUTPUTS, expected, strict=True):
            np.testing.assert_allclose(found[output], values, atol=1e-4)


def test_eight_bits_are_smaller_and_close(family):
    for name, other in (("factorised", "factorised-r16-int8"), ("naf", "naf-int8")):
        whole, small = (family.models[f"{each}.onnx"] for each in (name, other))
        assert b"MatMulInteger" in small
        assert b"MatMulInteger" not in whole
        arrays = poses(6)
        one, two = (answer(open_session(model), arrays)["log_magnitude"] for model in (whole, small))
        assert 0 < np.sqrt(np.mean((one - two) ** 2)) < 0.1
    assert len(family.models["naf-int8.onnx"]) < len(family.models["naf.onnx"])


def test_the_coherence_of_naf_is_the_training_sets(family, dataset, naf_run):
    stored = load_learner(SimulatedResponses(dataset), naf_run).field.coherence.numpy()
    found = answer(open_session(family.models["naf.onnx"]), poses(2))
    np.testing.assert_allclose(found["interaural_coherence"], np.stack([stored] * 2), atol=5e-4)
    assert not found["phase_certainty"].any()


def test_fields_of_the_same_name_do_not_share_a_bundle(dataset, run, tmp_path):
    with pytest.raises(ExportError, match="factorised-r16: more than one run"):
        export(SimulatedResponses(dataset), [run, run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_lower_ranks_become_fields_that_cost_less(dataset, run, tmp_path):
    bundle = export(SimulatedResponses(dataset), [run], tmp_path, ranks=(4, 8, 64), checked=False)
    fields = bundle.manifest.fields
    assert [(name, field.rank) for name, field in fields.items()] == [
        ("factorised", 16),
        ("factorised-r8", 8),
        ("factorised-r4", 4),
    ]
    sizes = [len(bundle.models[field.file]) for field in fields.values()]
    assert sizes == sorted(sizes, reverse=True)
    assert list(FieldsByLevel.load(bundle)) == ["standard", "factorised-r8", "factorised-r4"]


def test_a_field_of_another_width_says_so_and_shares_a_bundle_with_the_first(
    dataset, run, tiny_bundle, tmp_path, monkeypatch
):
    # Names are looked at and not graphs, of which each takes seconds.
    graph = onnx.load_from_string(tiny_bundle.models[MODEL_FILE])
    monkeypatch.setattr(export_module, "to_onnx", lambda *_, **__: graph)
    monkeypatch.setattr(export_module, "_check", lambda *_, **__: None)
    usual = Configuration.read(run)
    wide = replace(usual, epochs=1, shape=replace(usual.shape, width=48))
    responses = SimulatedResponses(dataset)
    train(responses, tmp_path / "wide", wide, Progress(disable=True))
    bundle = export(responses, [run, tmp_path / "wide"], tmp_path / "bundle", ranks=(8,), checked=False)
    named = {name: field.rank for name, field in bundle.manifest.fields.items()}
    assert named == {"factorised": 16, "factorised-r8": 8, "factorised-w48-r16": 16, "factorised-w48-r8": 8}
