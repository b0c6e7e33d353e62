import dataclasses
import shutil

import numpy as np
import pytest

from server.acoustics.room_parameters import RoomParameters, measure
from training.dataset import Dataset
from training.evaluation.draws import median_parameters
from training.evaluation.evaluate import ONE_SIMULATION
from training.evaluation.held_out import EvaluationError, open_held_out
from training.evaluation.run import evaluate_bundles
from training.simulation.pairs import PairSimulation

DRAWS = 4


@pytest.fixture(scope="module")
def folder(dataset, tmp_path_factory):
    """The dataset, with draws that no other test sees."""
    copy = tmp_path_factory.mktemp("draws") / "data"
    shutil.copytree(dataset.folder, copy)
    return copy


@pytest.fixture(scope="module")
def held_out(folder):
    with open_held_out(folder) as opened:
        yield opened


@pytest.fixture(scope="module")
def medians(held_out) -> list[RoomParameters]:
    return median_parameters(held_out, DRAWS)


def drawn(held_out, draw: int, index: int) -> RoomParameters:
    """By the simulation itself: whole responses of two takes for each of the seeds after the dataset's."""
    dataset: Dataset = held_out.simulated
    simulation = PairSimulation.prepare(
        dataset.scene, dataset.probes, dataset.yaws, seed=dataset.seed + 1 + draw // 2, plan=dataset.effects
    )
    emitter, listener = divmod(int(held_out.held_out[index]), len(dataset.probes))
    listeners = np.flatnonzero(dataset.held_out[emitter])
    reflected = {other: response for other, _, response in simulation.take(emitter, listeners, draw % 2)}[listener]
    known = held_out.reference(index) - dataset.read(np.array([[emitter, listener]]))[0]
    return measure(reflected + known, dataset.sample_rate)


def test_each_parameter_is_the_median_of_independent_simulations(held_out, medians):
    draws = [drawn(held_out, draw, 0) for draw in range(DRAWS)]
    for name in ("reverberation_time_s", "clarity_db", "interaural_cross_correlation"):
        values = np.stack([getattr(draw, name) for draw in draws])
        assert len(np.unique(values[:, 0].reshape(DRAWS, -1)[:, 0])) == DRAWS
        np.testing.assert_allclose(getattr(medians[0], name), np.median(values, axis=0), rtol=1e-3)


def test_what_was_drawn_is_kept_and_what_was_cut_off_goes_on(folder, held_out, medians, monkeypatch):
    files = sorted((folder / "draws").glob("*/*.npz"))
    emitters = np.unique(held_out.held_out // len(held_out.simulated.probes))
    assert len(files) == DRAWS * len(emitters)
    files[0].unlink()
    before = {file: file.stat().st_mtime_ns for file in files[1:]}
    again = median_parameters(held_out, DRAWS)
    assert {file: file.stat().st_mtime_ns for file in files[1:]} == before
    for one, other in zip(medians, again, strict=True):
        for name, values in vars(one).items():
            np.testing.assert_array_equal(values, getattr(other, name))
    monkeypatch.setattr(PairSimulation, "own", None)  # nothing is left to draw
    few = held_out.sample(pairs=1, yaws=1, seed=0)
    (of_one,) = median_parameters(few, DRAWS)
    index = held_out.held_out.tolist().index(few.held_out[0])
    np.testing.assert_array_equal(of_one.clarity_db, medians[index].clarity_db[few.heard])


def test_another_simulation_has_draws_of_its_own(held_out):
    other = dataclasses.replace(held_out.simulated, seed=held_out.simulated.seed + 7)
    moved = median_parameters(dataclasses.replace(held_out, simulated=other).sample(pairs=1, yaws=1, seed=0), 2)
    same = median_parameters(held_out.sample(pairs=1, yaws=1, seed=0), 2)
    assert not np.array_equal(moved[0].clarity_db, same[0].clarity_db)


def test_measurements_cannot_be_drawn(held_out):
    with pytest.raises(EvaluationError, match="--draws"):
        median_parameters(dataclasses.replace(held_out, simulated=None), DRAWS)


def test_a_single_simulation_is_nearer_to_the_median_than_to_another(folder):
    evaluation, _ = evaluate_bundles([], folder, methods=[], draws=DRAWS)
    assert [result.name for result in evaluation.results] == [ONE_SIMULATION, "floor"]
    alone, floor = evaluation.results
    metrics = ("t60", "edt", "c50", "drr", "iacc", "level")
    # By a factor of 0.8 where draws are normally distributed; of few pairs, only over all metrics.
    assert np.mean([alone.summaries[name].mean / floor.summaries[name].mean for name in metrics]) < 0.95
    assert alone.summaries["spectral_loss"].mean == 0
    assert evaluation.to_json()["draws"] == DRAWS
    single, _ = evaluate_bundles([], folder, methods=[])
    assert single.floor.summaries == floor.summaries
