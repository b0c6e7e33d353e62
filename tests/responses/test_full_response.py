"""Whole responses of the bundled apartment: the direct path joined to what its field says follows."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.room_parameters import level_db
from server.field.field import AcousticField
from server.rendering.hrtf import KEMAR, Hrtf
from server.responses.full_response import FullResponse
from server.scene.bundle import BUNDLED, Bundle


@pytest.fixture(scope="module")
def apartment():
    return FullResponse.through_kemar(AcousticField.load(Bundle.load(BUNDLED / "apartment")))


@pytest.fixture(scope="module")
def without_reflections():
    """The same, leaving first reflections to the field: what is added is the direct sound alone."""
    bundle = Bundle.load(BUNDLED / "apartment")
    manifest = bundle.manifest.model_copy(update={"image_order": 0})
    return FullResponse.through_kemar(AcousticField.load(dataclasses.replace(bundle, manifest=manifest)))


def ears(apartment, listener, emitter, yaw_deg):
    return level_db(apartment.impulse_responses([listener], [emitter], [np.radians(yaw_deg)]))[0]


def direct(apartment, *poses):
    return apartment.impulse_responses(*poses) - apartment.field.impulse_responses(*poses)


def test_nothing_comes_before_the_direct_sound(apartment):
    """At either ear; emitters nearer than the delay line can follow are left out."""
    rng = np.random.default_rng(0)
    listeners, emitters = rng.uniform((0.5, 0.5, 1.3), (3.5, 4.5, 1.8), (2, 40, 3))
    yaws = rng.uniform(-np.pi, np.pi, 40)
    far = np.linalg.norm(listeners - emitters, axis=-1) > 0.4
    poses = (listeners[far], emitters[far], yaws[far])
    for first, reflected in zip(direct(apartment, *poses), apartment.field.impulse_responses(*poses), strict=True):
        arrives = np.flatnonzero(np.abs(first).max(axis=0) > 0.05 * np.abs(first).max())[0]
        assert not reflected[:, : arrives - 1].any()
        assert reflected[:, arrives:].any()


def test_direct_sound_has_the_level_of_a_free_field_through_the_head(without_reflections):
    """1 / r through the measured responses of the nearest direction, and a little air."""
    hrtf = Hrtf.read(KEMAR, without_reflections.sample_rate)
    listener = np.array((2.0, 2.5, 1.5))
    azimuths = np.radians(np.arange(0, 360, 30))
    for distance in (0.5, 1.3):
        towards = np.stack([np.cos(azimuths), np.sin(azimuths), np.zeros(12)], axis=-1)
        poses = (np.tile(listener, (12, 1)), listener + distance * towards, np.zeros(12))
        nearest = np.argmax(towards @ hrtf.directions.T, axis=-1)
        expected = level_db(hrtf.impulse_responses[nearest] / distance)
        assert_allclose(level_db(direct(without_reflections, *poses)), expected, atol=0.4)


def test_nothing_is_louder_than_the_near_limit_allows(apartment):
    here = (2.0, 2.5, 1.5)
    responses = apartment.impulse_responses([here] * 2, [here, (2.0, 2.5, 1.501)], [0.0, 0.0])
    assert np.isfinite(responses).all()
    # 12 dB for a quarter of a metre, and a few more for what the head adds in some directions.
    assert (level_db(responses) < 12 + 8).all()


def test_it_is_the_same_every_time(apartment):
    pose = ([(1.0, 2.0, 1.5)], [(6.0, 3.0, 1.5)], [0.7])
    assert_array_equal(apartment.impulse_responses(*pose), apartment.impulse_responses(*pose))


def test_batch_of_one_equals_batch_of_many(apartment):
    rng = np.random.default_rng(0)
    poses = (*rng.uniform((4.5, 0.5, 1.3), (7.5, 4.5, 1.8), (2, 5, 3)), rng.uniform(-3, 3, 5))
    together = apartment.impulse_responses(*poses)
    alone = [apartment.impulse_responses(*(part[i : i + 1] for part in poses))[0] for i in range(5)]
    assert_allclose(together, alone, atol=1e-6)


def test_turning_the_head_swaps_the_louder_ear(apartment):
    listener, emitter = (2.0, 1.5, 1.5), (2.0, 2.5, 1.5)
    ahead_east, ahead_west = ears(apartment, listener, emitter, 0), ears(apartment, listener, emitter, 180)
    assert ahead_east[0] - ahead_east[1] > 2
    assert ahead_west[1] - ahead_west[0] > 2


def test_it_is_quieter_behind_the_wall(apartment):
    emitter = (2.0, 1.0, 1.5)
    beside = ears(apartment, (3.4, 1.0, 1.5), emitter, 90).mean()
    behind = ears(apartment, (4.8, 1.0, 1.5), emitter, 90).mean()
    assert beside - behind > 4


def test_direct_sound_does_not_stop_at_the_corner(without_reflections):
    """Into the shadow of the doorway's edge by steps of 2 cm: the direct path follows without a jump, and fades."""
    y = np.arange(2.0, 0.5, -0.02)
    listeners = np.stack([np.full_like(y, 5.0), y, np.full_like(y, 1.5)], axis=-1)
    levels = level_db(
        direct(without_reflections, listeners, np.broadcast_to((3.0, 2.5, 1.5), listeners.shape), np.zeros(len(y)))
    )
    visible = without_reflections.bundle.floor_plan.is_visible(listeners, np.array((3.0, 2.5, 1.5)))
    assert visible[0]
    assert not visible[-1]
    assert np.abs(np.diff(levels, axis=0)).max() < 1
    assert (levels[0] - levels[-1] > 10).all()


def test_the_power_of_paths_is_that_of_the_responses(apartment):
    """Averaged over as many headings as there are, in sight and out of it."""
    emitter = np.array((2.0, 2.0, 1.5))
    listeners = np.array([(2.6, 2.8, 1.3), (1.0, 4.0, 1.7), (5.0, 1.0, 1.5)])
    power = apartment.path_power(listeners, emitter)
    yaws = 2 * np.pi * np.arange(24) / 24
    for listener, expected in zip(listeners, power, strict=True):
        heard = direct(apartment, np.tile(listener, (24, 1)), np.tile(emitter, (24, 1)), yaws)
        found = np.mean(np.sum(np.square(heard, dtype=np.float64), axis=-1))
        # Headings are one circle of the sphere of directions, which the head hears a little louder.
        assert 10 * np.log10(found / expected) == pytest.approx(0, abs=1.5)
