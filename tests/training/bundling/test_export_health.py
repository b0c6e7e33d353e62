"""What is not healthy is not exported."""

import numpy as np
import pytest

from server.api.catalogue import describe_scene
from server.core.errors import BundleError
from server.field.fields_by_level import FieldsByLevel
from server.health.check import Effort, HealthError, check
from server.health.report import reasons as reasons_of
from server.health.report import to_json
from server.scene.bundle import Bundle
from training.bundling import export as export_module
from training.bundling.data_reference import reference_of
from training.bundling.export import ExportError, export
from training.bundling.graphs import with_weights
from training.learning.train import load_learner
from training.models.factorised import ExportedField
from training.models.frozen_noise import even_noise
from training.simulation.responses import SimulatedResponses


@pytest.fixture
def without_tracing(dataset, run, monkeypatch):
    """The graph of the field as it was trained, with the values of the one that is exported: only these differ. Nor is
    the graph compared with the field."""
    healthy, to_onnx = load_learner(SimulatedResponses(dataset), run), export_module.to_onnx

    def graph(module, poses, outputs, **options):
        trained = ExportedField(healthy.field, healthy.cells).eval()
        return with_weights(to_onnx(trained, poses, outputs, **options), module)

    monkeypatch.setattr(export_module, "to_onnx", graph)
    monkeypatch.setattr(export_module, "_check", lambda *_, **__: None)


@pytest.mark.usefixtures("without_tracing")
@pytest.mark.parametrize(
    ("excess", "error", "problem"),
    [
        pytest.param(5.0, HealthError, "energy above what the walls let remain", id="too loud"),
        pytest.param(float("nan"), BundleError, "log_magnitude: .* finite", id="no number"),
    ],
)
def test_a_field_that_breaks_a_law_is_refused_and_nothing_is_written(
    dataset, run, tmp_path, monkeypatch, excess, error, problem
):
    def ill(responses, folder):
        learner = load_learner(responses, folder)
        learner.field.level_correction += excess
        return learner

    monkeypatch.setattr(export_module, "load_learner", ill)
    with pytest.raises(error, match=problem):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def _rising(responses, folder):
    """A field whose late levels grow again, from a field of the tiny room."""
    learner = load_learner(responses, folder)
    levels = learner.field.heads.slices["late"]
    channels, bands, cells = learner.field.heads.shapes["late"]
    late = learner.field.level_correction[:, levels].view(2, channels, bands, cells)
    late[..., cells // 2 :] += 3.0
    return learner


@pytest.mark.usefixtures("without_tracing")
def test_a_broken_law_may_be_accepted_with_a_reason_that_the_bundle_keeps(dataset, run, tmp_path, monkeypatch):
    monkeypatch.setattr(export_module, "load_learner", _rising)
    with pytest.raises(HealthError, match=r"rise within 60 dB of decay.*--accept decay='why'"):
        export(SimulatedResponses(dataset), [run], tmp_path / "refused")
    reasons = {"decay": "the room has an echo", "peak": "not broken at all"}
    bundle = export(SimulatedResponses(dataset), [run], tmp_path / "bundle", accepted=reasons)
    assert [(entry.law, entry.reason) for entry in bundle.manifest.accepted] == [("decay", "the room has an echo")]
    health = check(Bundle.load(tmp_path / "bundle"), Effort(scattered=8, halved=2, climbing=1, responses=1))
    assert not health.broken
    assert {finding.accepted for finding in health.accepted} == {"the room has an echo"}
    (told,) = [entry for entry in to_json(health)["findings"] if entry["accepted"]]
    assert (told["law"], told["holds"]) == ("decay", False)
    assert any("accepted, the room has an echo" in line for line in reasons_of(health))
    described = describe_scene(FieldsByLevel.load(bundle))
    assert [entry.law for entry in described.accepted_laws] == ["decay"]


@pytest.mark.parametrize(
    ("accepted", "problem"),
    [
        ({"decai": "why"}, "decai: is not a law .* decay"),
        ({"repeatable": "why"}, "repeatable: is not a law"),
        ({"decay": " "}, "decay: needs a reason"),
    ],
)
def test_what_nobody_may_accept_is_refused_before_any_work(dataset, tmp_path, accepted, problem):
    with pytest.raises(ExportError, match=problem):
        export(SimulatedResponses(dataset), [tmp_path / "no run"], tmp_path / "bundle", accepted=accepted)


@pytest.mark.usefixtures("without_tracing")
def test_a_field_is_checked_before_its_noise_is_chosen(dataset, run, tmp_path, monkeypatch):
    def choose(*_, **__):
        raise AssertionError("noise was chosen for a field that is refused")

    monkeypatch.setattr(export_module, "load_learner", _rising)
    monkeypatch.setattr(export_module, "choose_noise", choose)
    with pytest.raises(HealthError):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")


def test_noise_that_breaks_a_law_is_refused_and_nothing_is_written(dataset, run, tmp_path, monkeypatch):
    """Of a field that breaks none."""

    def choose(bundle, *_, **__):
        return 1e4 * even_noise(bundle.manifest.codec.codec, np.random.default_rng(1))

    monkeypatch.setattr(export_module, "choose_noise", choose)
    with pytest.raises(HealthError, match="largest sample"):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_the_manifest_says_what_its_data_do(tiny_bundle, dataset):
    found = tiny_bundle.manifest.reference
    assert found == reference_of(SimulatedResponses(dataset), tiny_bundle.manifest)
    assert found.responses > 50
    assert found.energy_excess_db < 0
