"""How far a run is from its end, as tables say it."""

import dataclasses
import math

import pytest
from rich.progress import Progress

from training.learning.record import TrainingRecord, slope_per_doubling
from training.learning.runs import Configuration, NafRecipe, RunError, record_of
from training.learning.train import train
from training.models.naf import NafShape
from training.simulation.responses import SimulatedResponses

SMALL = NafShape(width=16, grid_features=4, grid_spacing_m=1.0)


def test_the_slope_is_that_of_the_last_doubling():
    early = [(step, 100.0) for step in range(1, 64)]
    late = [(step, 5 - 0.25 * math.log2(step)) for step in range(64, 129)]
    assert slope_per_doubling(early + late) == pytest.approx(-0.25)
    assert slope_per_doubling([(10, 1.0), (20, 0.5)]) == pytest.approx(-0.5)
    assert slope_per_doubling([(1, 3.0), (100, 1.0)]) is None
    assert slope_per_doubling([]) is None


@pytest.fixture(scope="module")
def naf_run(dataset, tmp_path_factory):
    run = tmp_path_factory.mktemp("record") / "run"
    recipe = NafRecipe(points=50)
    configuration = Configuration.naf(SMALL, recipe, epochs=4, batch=4, share=0.5)
    train(SimulatedResponses(dataset), run, configuration, Progress(disable=True))
    return run


def test_a_record_counts_what_a_run_has_seen(naf_run):
    record = record_of(naf_run)
    assert record.field == "naf"
    assert record.epochs == 4
    assert record.points == record.steps * 4 * 50
    assert record.recipe_share == pytest.approx(4 / 200 * 50 / 2000 * 0.5)
    assert (record.patience, record.stopped) == (None, False)
    assert record.slope_per_doubling is not None


def test_a_record_has_the_loss_that_the_log_has(naf_run):
    record = record_of(naf_run)
    last = (naf_run / "log.csv").read_text().splitlines()[-1].split(",")
    assert record.held_back_loss == pytest.approx(float(last[-1]) + float(last[-2]), rel=1e-4)


def test_the_mean_of_the_training_set_has_a_ninth_of_the_variance_as_loss(naf_run):
    """Targets are divided by three standard deviations; the phase counts a tenth."""
    assert record_of(naf_run).mean_loss == pytest.approx((1 + 0.1) / 9, rel=0.25)


def test_a_record_survives_its_text(naf_run):
    record = record_of(naf_run)
    assert TrainingRecord.from_json(record.to_json()) == record


def test_whole_responses_have_no_points_and_no_share_of_the_recipe(run, configuration):
    record = record_of(run)
    assert (record.field, record.epochs) == ("factorised", configuration.epochs)
    assert record.points is record.recipe_share is None


def test_a_sentence_says_why_a_run_ended(naf_run):
    record = record_of(naf_run)
    assert "not because the loss had stopped falling" in record.sentence()
    stopped = dataclasses.replace(record, patience=3, stopped=True)
    assert "ended after 3 rounds without a smaller loss" in stopped.sentence()
    assert "before 3 rounds" in dataclasses.replace(stopped, stopped=False).sentence()
    for said in (f"{record.steps:,} steps", "4 epochs", "0.025 % of the paper's recipe", "per doubling"):
        assert said in record.sentence()


def test_what_is_no_run_has_no_record(tmp_path):
    with pytest.raises(RunError):
        record_of(tmp_path)
