import numpy as np
import pytest
from PIL import Image

from server.acoustics.decibels import power_to_db
from server.field.field import AcousticField
from training.baselines.baselines import linear
from training.baselines.held_out import EvaluationError, open_held_out
from training.evaluation.maps import (
    _interpolated_power,
    _simulated_power,
    _training_gram,
    draw_maps,
    map_emitters,
    spread_out,
)

OPPOSITE = [0, 2]  # of four yaws


@pytest.fixture(scope="module")
def held_out(dataset):
    with open_held_out(dataset.folder) as opened:
        yield opened


@pytest.fixture(scope="module")
def maps(held_out, tiny_bundle):
    return map_emitters(held_out, AcousticField.load(tiny_bundle), emitters=2, spacing_m=0.5)


def energy(response):
    return np.square(response[OPPOSITE].astype(float)).sum(axis=-1).mean()


def test_interpolated_energies_are_those_of_the_baselines(held_out):
    """At the listener of a held-out pair, the map says what the baseline's waveform holds."""
    for index, pair in enumerate(held_out.held_out):
        emitter = int(held_out.pairs.pair_emitter[pair])
        listeners, gram = _training_gram(held_out.pairs, held_out.yaws, emitter)
        known, interpolated = _interpolated_power(listeners, gram, held_out.listeners[index][None])
        np.testing.assert_allclose(interpolated[0], energy(linear(held_out.pairs, int(pair))), rtol=1e-3)
        of_emitter = np.flatnonzero(held_out.pairs.training & (held_out.pairs.pair_emitter == emitter))
        positions = held_out.pairs.listener_positions[held_out.pairs.pair_listener[of_emitter]]
        closest = of_emitter[np.argmin(np.linalg.norm(positions - held_out.listeners[index], axis=-1))]
        np.testing.assert_allclose(known[0], energy(held_out.pairs.response(int(closest))), rtol=1e-3)


def test_the_simulated_map_agrees_with_the_dataset_at_its_probes(dataset, held_out):
    emitter, listeners = 0, [1, 2, 3, 4, 5]
    power = _simulated_power(dataset, dataset.probes[emitter], dataset.probes[listeners])
    stored = [energy(held_out.pairs.response(emitter * len(dataset.probes) + listener)) for listener in listeners]
    assert np.abs(power_to_db(power) - power_to_db(np.array(stored))).mean() < 0.7


def test_all_maps_are_of_the_same_cells(maps):
    for of_emitter in maps:
        assert list(of_emitter.levels_db) == ["simulation", "field", "nearest", "linear"]
        holes = [np.isnan(levels) for levels in of_emitter.levels_db.values()]
        assert all((hole == holes[0]).all() for hole in holes)
        assert np.mean(~holes[0]) > 0.5
        assert of_emitter.errors_db("simulation") == 0
        assert 0 < of_emitter.errors_db("field") < 6


def test_emitters_are_spread_out():
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [2.4, 0, 0]])
    assert spread_out(points, np.array([0.04, 0, 0]), 3) == [0, 2, 3]
    assert len(spread_out(points, np.zeros(3), 9)) == 4


def test_maps_are_a_picture_with_a_panel_each(maps, tmp_path):
    draw_maps(maps, tmp_path / "maps.png")
    with Image.open(tmp_path / "maps.png") as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape[1] > pixels.shape[0] > 200
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100


def test_measured_data_have_no_walls_to_draw(make_held_out, tiny_bundle):
    data = make_held_out(lambda pair: np.zeros((1, 2, 100)) + pair)
    with pytest.raises(EvaluationError, match="walls"):
        map_emitters(data, AcousticField.load(tiny_bundle), emitters=1, spacing_m=0.5)
