import os
from pathlib import Path

import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from tests.training.measured_room import RATE, SAMPLES, Room
from training.baselines.baselines import TrainingPairs, nearest
from training.baselines.shaped import ShapedNearest, bands, delay_responses, stretches
from training.bundling.export import export
from training.data.dataset import SPEED_OF_SOUND
from training.data.importers.conditioning import Conditioning, condition
from training.data.importers.meshrir import read
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset
from training.evaluation.run import evaluate_bundles


def test_bands_add_up_to_the_response():
    responses = np.random.default_rng(0).standard_normal((2, 3, 500))
    parts = bands(responses, RATE)
    assert parts.shape[:2] == (2, 3)
    np.testing.assert_allclose(parts.sum(axis=-2), responses, atol=1e-12)


@pytest.mark.parametrize(("hertz", "band"), [(200, 0), (1000, 1), (2000, 2), (7000, 4)])
def test_a_band_holds_its_octave(hertz, band):
    tone = np.sin(2 * np.pi * hertz * np.arange(4000) / RATE) * np.hanning(4000)
    power = np.square(bands(tone, RATE)).sum(axis=-1)
    assert power[band] > 0.99 * power.sum()


def test_stretches_add_up_to_one_and_follow_the_arrival():
    weights = stretches(np.array([0.01, 0.02]), SAMPLES, RATE, 6)
    np.testing.assert_allclose(weights.sum(axis=-2), 1.0)
    later = round(0.01 * RATE)
    np.testing.assert_allclose(weights[1, :, later:], weights[0, :, :-later], atol=1e-9)
    # The first ends 2.5 ms after the arrival.
    assert np.flatnonzero(weights[0, 0] > 0.5)[-1] == pytest.approx(0.0125 * RATE, abs=1)


@pytest.mark.parametrize("later", [0.0, 3.0, -7.0, 0.37, -12.61])
def test_a_moved_sound_arrives_that_much_later(later):
    time = np.arange(600) / RATE
    pulse = np.exp(-(((time - 0.018) / 4e-4) ** 2)) * np.cos(2 * np.pi * 3000 * (time - 0.018))
    shifted_time = time - later / RATE
    expected = np.exp(-(((shifted_time - 0.018) / 4e-4) ** 2)) * np.cos(2 * np.pi * 3000 * (shifted_time - 0.018))
    np.testing.assert_allclose(delay_responses(pulse[None], np.array([later]))[0], expected, atol=1e-3)


def test_an_offset_does_not_ring_when_moved():
    np.testing.assert_allclose(delay_responses(np.full((1, 300), 0.1), np.array([40.4])), 0.1, atol=1e-4)


@pytest.fixture(scope="module")
def room():
    return Room()


@pytest.fixture(scope="module")
def shaped(room):
    return ShapedNearest(room.pairs, room.delays_s, RATE)


def level_errors(room, answer, part=slice(None)):
    levels = [
        power_to_db(np.square(np.stack([room.responses[pair], answer(pair)])[..., part]).sum(axis=-1)).ravel()
        for pair in room.held_out
    ]
    return np.abs(np.diff(levels, axis=1))


def test_levels_are_closer_than_those_of_the_nearest(room, shaped):
    ours = level_errors(room, shaped.response).mean()
    theirs = level_errors(room, lambda pair: nearest(room.pairs, pair)).mean()
    assert ours < 0.65 * theirs


def test_late_levels_are_closer_too(room, shaped):
    late = slice(round(0.03 * RATE), round(0.1 * RATE))
    ours = level_errors(room, shaped.response, late).mean()
    assert ours < 0.7 * level_errors(room, lambda pair: nearest(room.pairs, pair), late).mean()


def test_sound_arrives_when_it_should(room, shaped):
    for pair in room.held_out:
        peak = np.abs(shaped.response(pair)[0, 0]).argmax()
        assert abs(peak - room.delays_s[pair] * RATE) < 1.5


def test_where_nothing_changes_but_distance_the_response_is_exact():
    room = Room(tail=0.0)
    for index in range(60):
        distance = room.delays_s[index] * SPEED_OF_SOUND
        time = np.arange(SAMPLES) / RATE - room.delays_s[index] - 0.002
        room.responses[index, 0, 0] = np.exp(-((time / 2e-4) ** 2)) / distance
    shaped = ShapedNearest(room.pairs, room.delays_s + 0.002, RATE)
    for pair in room.held_out:
        expected = room.responses[pair]
        np.testing.assert_allclose(shaped.response(pair), expected, atol=0.03 * expected.max())


def test_orientations_that_are_asked_for_are_answered(room):
    doubled = np.concatenate([room.responses, 0.5 * room.responses], axis=1)
    pairs = TrainingPairs(doubled, room.listener, room.emitter, room.listeners, room.emitters, room.pairs.training)
    both = ShapedNearest(pairs, room.delays_s, RATE)
    pair = int(room.held_out[0])
    whole, second = both.response(pair), both.response(pair, np.array([1]))
    assert whole.shape == (2, 1, SAMPLES)
    np.testing.assert_allclose(second[0], whole[1], atol=1e-6)
    np.testing.assert_allclose(whole[1], 0.5 * whole[0], atol=1e-3 * np.abs(whole).max())


@pytest.mark.parametrize("held_out_share", [0.1, 0.5])
def test_it_is_the_best_answer_on_the_measured_office(tmp_path, held_out_share):
    office = os.environ.get("MEASURED_OFFICE")
    if not office:
        pytest.skip("MEASURED_OFFICE names no folder")
    report = ImportReport()
    rows = condition(read(Path(office), report), Conditioning(), report)
    ImportedDataset.write(tmp_path, rows, report, layout="meshrir", source=office, held_out_share=held_out_share)
    others = ("nearest", "linear", "linear-aligned")
    bundle = export(ImportedDataset.open(tmp_path), [tmp_path], tmp_path / "bundle")
    evaluation, _ = evaluate_bundles([bundle], tmp_path, methods=[*others, "shaped-nearest"])
    for metric in ("spectral_loss", "c50", "drr", "level", "onset"):
        best = min(evaluation.of(name).summaries[metric].mean for name in others)
        for ours in ("shaped-nearest", "standard"):
            assert evaluation.of(ours).summaries[metric].mean < best, (ours, metric)
