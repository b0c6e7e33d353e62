import dataclasses

import numpy as np
import pytest
import torch
from rich.progress import Progress

from training.evaluation import ablation
from training.evaluation.ablation import AblationError, ablate, table, variants
from training.learning.factorised import FactorisedLearner
from training.learning.runs import Configuration, FactorisedRecipe, configure
from training.models.targets import LEAD_SAMPLES, align
from training.simulation.responses import SimulatedResponses

SILENT = Progress(disable=True)


class Oracle(torch.nn.Module):
    """Says what the responses themselves say, `louder_by` nepers louder."""

    responses, louder_by = None, 0.0

    def __init__(self, _, cells):
        super().__init__()
        self._codec = cells.codec

    def forward_all_frames(self, listener, emitter, yaw, path):  # noqa: ARG002  it looks poses up
        responses, found = self.responses, []
        for pose in zip(listener.numpy(), emitter.numpy(), yaw.numpy(), strict=True):
            asked = np.concatenate([pose[0], pose[1], [pose[2]]])
            known = np.column_stack([responses.listener, responses.emitter, responses.yaw])
            row = int(np.argmin(np.abs(known - asked).sum(axis=1)))
            delay = responses.onset_s[row] * responses.sample_rate - LEAD_SAMPLES
            log_magnitude, _ = self._codec.encode(align(responses.read([row])[0], delay))
            found.append(log_magnitude + self.louder_by)
        return (torch.from_numpy(np.stack(found)),)


@pytest.mark.parametrize("louder_by", [0.0, np.log(2)])
def test_errors_are_in_the_units_they_say(dataset, configuration, monkeypatch, louder_by):
    responses = SimulatedResponses(dataset)
    monkeypatch.setattr(ablation, "ExportedField", Oracle)
    monkeypatch.setattr(Oracle, "responses", responses)
    monkeypatch.setattr(Oracle, "louder_by", louder_by)
    rows = np.flatnonzero(responses.held_out)
    spectral, level, decay = ablation._errors(FactorisedLearner(responses, configuration), rows)
    assert spectral == pytest.approx(louder_by, abs=2e-3)
    assert level == pytest.approx(20 * louder_by / np.log(10), abs=0.05)
    assert decay == pytest.approx(0, abs=0.05)


def test_each_factor_varies_alone(dataset):
    base = configure("factorised")
    moved = variants(base, SimulatedResponses(dataset), None)
    assert moved.pop("as it is") == base
    usual = dataclasses.asdict(FactorisedRecipe())
    for name, configuration in moved.items():
        assert dataclasses.replace(configuration, recipe=base.recipe) == base
        recipe = dataclasses.asdict(configuration.recipe)
        assert sum(recipe[factor] != usual[factor] for factor in usual) == 1, name
    assert "swapped ends" not in moved
    with pytest.raises(AblationError, match="factors"):
        variants(configure("naf"), SimulatedResponses(dataset), None)


def test_an_ablation_is_measured_on_what_is_held_out_and_goes_on_where_it_was(dataset, configuration, tmp_path):
    short = dataclasses.replace(configuration, epochs=3)
    both: dict[str, Configuration] = {
        "as it is": short,
        "no level correction": dataclasses.replace(short, recipe=FactorisedRecipe(level_correction=False)),
    }
    responses = SimulatedResponses(dataset)
    rows = ablate(responses, tmp_path, both, SILENT)
    checkpoints = [(tmp_path / name / "checkpoint.pt").read_bytes() for name in ("as-it-is", "no-level-correction")]
    again = ablate(responses, tmp_path, both, SILENT)
    assert again == rows
    after = [(tmp_path / name / "checkpoint.pt").read_bytes() for name in ("as-it-is", "no-level-correction")]
    assert after == checkpoints
    assert [line[0] for line in table(rows)] == ["factor", "as it is", "no level correction"]
    # Means of logarithms are too low: without correction the spectrum is nearer, the level farther.
    assert rows[1].level_db > rows[0].level_db


def test_without_held_out_pairs_there_is_nothing_to_measure(dataset, configuration, tmp_path):
    nothing = dataclasses.replace(dataset, held_out=np.zeros_like(dataset.held_out))
    with pytest.raises(AblationError, match="held out"):
        ablate(SimulatedResponses(nothing), tmp_path, {"as it is": configuration}, SILENT)
