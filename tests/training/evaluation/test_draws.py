import dataclasses
import shutil

import numpy as np
import pytest

from server.acoustics.room_parameters import RoomParameters, measure
from training.baselines.held_out import EvaluationError, open_held_out
from training.data.dataset import Dataset
from training.evaluation.draws import median_parameters
from training.evaluation.evaluate import ONE_SIMULATION
from training.evaluation.run import evaluate_bundles
from training.parallel.jobs import LocalJobs
from training.simulation.pairs import PairSimulation
from training.simulation.references import References

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


@pytest.fixture(scope="module")
def simulated(held_out) -> list[list[RoomParameters]]:
    """By pair and draw, from the simulation itself: two takes for each of the seeds after the dataset's, with a tail of
    more rays."""
    dataset: Dataset = held_out.simulated
    plan = dataclasses.replace(dataset.effects, tail_rays=16 * dataset.effects.tail_rays)
    simulations = [
        PairSimulation.prepare(dataset.scene, dataset.probes, dataset.yaws, seed=dataset.seed + n, plan=plan)
        for n in (1, 2)
    ]
    ends = [divmod(int(pair), len(dataset.probes)) for pair in held_out.held_out]
    of_pairs = []
    for index, (emitter, listener) in enumerate(ends):
        known = held_out.reference(index) - References(dataset).reflected(emitter, listener)
        listeners = np.flatnonzero(dataset.held_out[emitter])
        of_pairs.append([])
        for draw in range(DRAWS):
            taken = simulations[draw // 2].take(emitter, listeners, draw % 2)
            reflected = {other: response for other, _, response in taken}[listener]
            of_pairs[-1].append(measure(reflected + known, dataset.sample_rate))
    return of_pairs


def test_each_parameter_is_the_median_of_independent_simulations(held_out, medians, simulated):
    for index, draws in enumerate(simulated):
        takes = held_out.reference(index), held_out.repeats[int(held_out.held_out[index])]
        own = [measure(take, held_out.sample_rate) for take in takes]
        for name in ("reverberation_time_s", "clarity_db", "interaural_cross_correlation"):
            values = np.stack([getattr(draw, name) for draw in draws])
            of_dataset = [getattr(take, name).reshape(-1)[0] for take in own]
            assert len({*values.reshape(DRAWS, -1)[:, 0], *of_dataset}) == DRAWS + len(own)
            np.testing.assert_allclose(getattr(medians[index], name), np.median(values, axis=0), rtol=1e-3)


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
    monkeypatch.setattr(PairSimulation, "energies", None)  # nothing is left to draw
    few = held_out.sample(pairs=1, yaws=1, seed=0)
    (of_one,) = median_parameters(few, DRAWS)
    index = held_out.held_out.tolist().index(few.held_out[0])
    np.testing.assert_array_equal(of_one.clarity_db, medians[index].clarity_db[few.yaw_indices])


def test_what_fewer_than_half_of_the_draws_have_is_missing(held_out, monkeypatch):
    """Of three draws, one whose reverberation time cannot be measured and, at one ear, two."""
    drawn = iter(range(1000))

    def broken(response, sample_rate, *, decay_db):
        parameters = measure(response, sample_rate, decay_db=decay_db)
        draw = next(drawn) % 3
        parameters.reverberation_time_s[..., 0 if draw == 1 else slice(0, 0)] = np.nan
        parameters.clarity_db[..., 1 if draw else slice(0, 0)] = np.nan
        return parameters

    monkeypatch.setattr("training.evaluation.draws.measure", broken)
    # One pair of an emitter of its own, so that calls come draw by draw; decays of 20 dB have draws of their own.
    emitters = held_out.held_out // len(held_out.simulated.probes)
    alone = next(index for index, emitter in enumerate(emitters) if np.count_nonzero(emitters == emitter) == 1)
    few = dataclasses.replace(held_out, held_out=held_out.held_out[[alone]], visible=held_out.visible[[alone]])
    (parameters,) = median_parameters(few, 3, decay_db=20.0, jobs=LocalJobs(1))
    assert np.isfinite(parameters.reverberation_time_s).all()
    assert np.isfinite(parameters.clarity_db[..., 0]).all()
    assert np.isnan(parameters.clarity_db[..., 1]).all()


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
    assert alone.summaries["spectral_loss"].mean is None
    assert evaluation.to_json()["draws"] == DRAWS
    single, _ = evaluate_bundles([], folder, methods=[])
    assert single.floor.summaries == floor.summaries
