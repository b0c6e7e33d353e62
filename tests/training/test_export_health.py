"""What is not healthy is not exported."""

import pytest

from server.errors import BundleError
from server.health.check import HealthError
from training import export as export_module
from training.export import export
from training.responses import SimulatedResponses
from training.train import load_learner


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
    monkeypatch.setattr(export_module, "_check", lambda *_: None)  # the graph does what the field does
    with pytest.raises(error, match=problem):
        export(SimulatedResponses(dataset), [run], tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()
