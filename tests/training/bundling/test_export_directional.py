"""A directional field in a bundle, alone and beside one of ears."""

import itertools

import numpy as np
import pytest
import torch
from rich.progress import Progress

from server.acoustics.geometry import Quaternion
from server.field.fields_by_level import FieldsByLevel
from server.field.runtime import open_session
from server.responses.full_response import FullResponse
from tests.training.told_paths import in_tiny
from training.bundling.export import ExportError, export
from training.learning.runs import Configuration, DirectionalRecipe
from training.learning.train import load_learner, train
from training.models.directional import ExportedDirections
from training.simulation.responses import SimulatedResponses

SILENT = Progress(disable=True)


@pytest.fixture(scope="module")
def directional_run(dataset, configuration, tmp_path_factory):
    folder = tmp_path_factory.mktemp("directional") / "run"
    settings = Configuration.directional(configuration.shape, epochs=60, batch=8)
    train(SimulatedResponses(dataset), folder, settings, SILENT)
    return folder


@pytest.fixture(scope="module")
def alone(dataset, directional_run, tmp_path_factory):
    return export(
        SimulatedResponses(dataset),
        [directional_run],
        tmp_path_factory.mktemp("directional") / "bundle",
        precisions=("float32", "int8"),
        ranks=(8,),
    )


def places(count):
    rng = np.random.default_rng(1)
    ends = [rng.uniform((0.4, 0.4, 1.2), (3.6, 2.6, 1.8), (count, 3)).astype(np.float32) for _ in range(2)]
    return dict(zip(("listener", "emitter", "path"), (*ends, in_tiny(*ends)), strict=True))


def test_the_manifest_says_what_it_predicts(alone, dataset):
    manifest = alone.manifest
    assert manifest.format_version == 3
    assert list(manifest.fields) == ["directional", "directional-r16-int8", "directional-r8", "directional-r8-int8"]
    for field in manifest.fields.values():
        assert (field.predicts, field.order, field.architecture) == ("directions", 2, "directional")
    assert manifest.codec.known_frames == 0
    assert manifest.codec.samples == dataset.samples
    assert manifest.levels[0].name == "standard"
    assert all(level.tail == "bands" for level in manifest.levels)


def test_the_graph_computes_what_torch_does(alone, dataset, directional_run):
    learner = load_learner(SimulatedResponses(dataset), directional_run)
    given = places(20)
    with torch.no_grad():
        expected = ExportedDirections(learner.field, learner.cells)(*map(torch.from_numpy, given.values()))
    for name, tolerance in (("directional", 0.03), ("directional-r16-int8", 0.5)):
        session = open_session(alone.models[f"{name}.onnx"])
        assert [each.name for each in session.get_inputs()] == ["listener", "emitter", "path"]
        found = session.run(["log_magnitude", "directions"], given)
        for values, true in zip(found, expected, strict=True):
            assert values.shape == tuple(true.shape)
            np.testing.assert_allclose(values, true, atol=tolerance)


@pytest.mark.parametrize("level", ["standard", "directional-r8"])
def test_a_degree_of_pitch_or_roll_is_no_more_of_a_step_than_one_of_yaw(alone, level):
    whole = FullResponse.through_kemar(FieldsByLevel.load(alone)[level])
    ends = [(1.0, 1.0, 1.5)], [(3.0, 2.0, 1.5)]
    degrees = np.radians(np.arange(-30, 31))

    def largest_step(turned):
        heads = [Quaternion.from_angles(0.5 + yaw, pitch, roll) for yaw, pitch, roll in turned]
        heard = [whole.impulse_responses(*ends, np.array([head]))[0] for head in heads]
        return max(np.linalg.norm(b - a) / np.linalg.norm(a) for a, b in itertools.pairwise(heard))

    yaw, pitch, roll = (largest_step([np.eye(3)[axis] * angle for angle in degrees]) for axis in range(3))
    assert 0 < max(pitch, roll) < 1.2 * yaw < 0.15


def test_every_form_is_heard(alone):
    ends = [(1.0, 1.0, 1.5)], [(3.0, 2.0, 1.5)]
    for field in FieldsByLevel.load(alone).values():
        response = field.impulse_responses(*ends, [0.3])[0]
        assert np.isfinite(response).all()
        assert np.sum(response**2) > 0


def test_it_shares_a_bundle_with_a_field_of_ears(dataset, run, directional_run, tmp_path):
    bundle = export(SimulatedResponses(dataset), [run, directional_run], tmp_path / "bundle", checked=False)
    fields = bundle.manifest.fields
    assert {name: field.predicts for name, field in fields.items()} == {
        "factorised": "ears",
        "directional-r16": "directions",
    }
    assert bundle.manifest.format_version == 3
    assert fields["directional-r16"].codec is not None
    assert fields["directional-r16"].codec.known_frames == 0
    assert set(FieldsByLevel.load(bundle)) == {"standard", "directional-r16"}


def test_order_zero_has_one_output(dataset, configuration, tmp_path):
    recipe = DirectionalRecipe(order=0)
    responses = SimulatedResponses(dataset)
    settings = Configuration.directional(configuration.shape, recipe, epochs=1, batch=8)
    train(responses, tmp_path / "run", settings, SILENT)
    bundle = export(responses, [tmp_path / "run"], tmp_path / "bundle", checked=False)
    session = open_session(bundle.models["directional.onnx"])
    assert [each.name for each in session.get_outputs()] == ["log_magnitude"]
    assert bundle.manifest.fields["directional"].order == 0


def test_two_directional_runs_of_one_size_do_not_share_a_bundle(dataset, directional_run, tmp_path):
    with pytest.raises(ExportError, match="directional-r16: more than one run"):
        export(SimulatedResponses(dataset), [directional_run, directional_run], tmp_path / "bundle")
