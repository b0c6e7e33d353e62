import json

import numpy as np
import pytest
from rich.progress import Progress
from typer.testing import CliRunner

from training.cli.main import app
from training.learning.runs import Configuration
from training.models.encoders import FieldShape
from training.trials import fractions as fractions_module
from training.trials.fractions import (
    Effort,
    Fractions,
    FractionsError,
    Scored,
    Trial,
    configuration_of,
    measure_fractions,
    trials,
)
from training.trials.fractions_figure import figure_of, spreads

EFFORT = Effort(epochs=2, points=50, pairs=3)


@pytest.fixture
def _small(monkeypatch):
    """Trials of a field that is trained in a second."""

    def configured(trial, effort):
        usual = configuration_of(trial, effort)
        return Configuration(
            epochs=usual.epochs,
            batch=16,
            seed=trial.seed,
            share=usual.share,
            shape=FieldShape(rank=16, width=32, depth=2, grid_spacing_m=1.0, grid_features=4),
        )

    monkeypatch.setattr(fractions_module, "configuration_of", configured)


def test_every_run_makes_as_many_steps():
    for percent in (5, 25, 100):
        configuration = configuration_of(Trial("naf", percent, 1), EFFORT)
        assert configuration.epochs * configuration.share == pytest.approx(EFFORT.epochs)
        assert (configuration.seed, configuration.recipe.points) == (1, EFFORT.points)


def test_curves_are_whole_seed_by_seed():
    chosen = trials(["naf", "directional"], [5, 100], seeds=2)
    assert len(chosen) == 8
    assert {trial.seed for trial in chosen[:4]} == {0}
    assert trials(["naf", "directional"], [5, 100], seeds=1, first_seed=1) == chosen[4:]
    with pytest.raises(FractionsError, match="120 is not"):
        trials(["naf"], [120], seeds=1)


@pytest.mark.usefixtures("_small")
def test_what_is_scored_is_not_trained_again(dataset, tmp_path, monkeypatch):
    chosen = trials(["factorised"], [30, 100], seeds=1)
    with Progress(disable=True) as progress:
        found = measure_fractions(dataset.folder, tmp_path, chosen, EFFORT, progress)
        monkeypatch.setattr(fractions_module, "train", None)
        again = measure_fractions(dataset.folder, tmp_path, chosen, EFFORT, progress)
    assert again == found == Fractions.from_json(json.loads((tmp_path / "fractions.json").read_text()))
    assert [each.trial for each in found.scored] == chosen
    assert all(0 < each.errors["spectral_loss"] < 5 for each in found.scored)
    assert found.floor["spectral_loss"] > 0
    other = Effort(epochs=9, points=50, pairs=3)
    with Progress(disable=True) as progress, pytest.raises(FractionsError, match="choose an empty folder"):
        measure_fractions(dataset.folder, tmp_path, chosen, other, progress)


def scored(field, percent, seed, error):
    return Scored(Trial(field, percent, seed), 1, {"spectral_loss": error, "t60": 2 * error, "c50": error / 2})


@pytest.fixture
def found():
    curves = [scored("naf", percent, seed, 1 / percent + 0.1 * seed) for percent in (5, 100) for seed in range(3)]
    return Fractions("room", EFFORT, {"t60": 1.0}, (*curves, scored("naf-no-grid", 5, 0, 2.0)))


def test_bars_are_the_deviation_over_seeds(found):
    mean, deviation, seeds = spreads(found, "spectral_loss")["naf"][5]
    assert (mean, deviation, seeds) == pytest.approx((0.3, 0.1, 3))
    assert np.isnan(spreads(found, "spectral_loss")["naf-no-grid"][5][1])


def test_every_field_is_a_line_of_every_panel(found):
    panels = figure_of(found).axes
    assert len(panels) == 3
    assert [len(axes.containers) for axes in panels] == [2, 2, 2]


def test_a_fraction_that_is_none_is_told(tmp_path):
    told = CliRunner().invoke(app, ["fractions", str(tmp_path), "-o", str(tmp_path / "out"), "--fractions", "5,x"])
    assert told.exit_code == 2
    assert "--fractions" in told.output
