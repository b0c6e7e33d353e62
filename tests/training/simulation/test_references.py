"""Whole simulated responses: the direct sound comes from geometry, everything else from the dataset, nothing twice."""

import dataclasses

import h5py
import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.rendering.hrtf import KEMAR, Hrtf
from training.simulation.references import DirectSound, References


@pytest.fixture(scope="module")
def direct(dataset):
    return DirectSound(dataset)


def test_direct_sound_arrives_when_it_can(dataset, direct):
    """In a shoebox every pair is in sight: at the louder ear it comes after distance / c."""
    for emitter, listener in dataset.pairs(held_out=False):
        loudest = np.abs(direct.response(emitter, listener)).max(axis=1)
        onset = np.argmax(loudest > 0.2 * loudest.max(axis=-1, keepdims=True), axis=-1)
        distance = np.linalg.norm(dataset.probes[emitter] - dataset.probes[listener])
        # Sound reaches the nearer ear up to a head's radius earlier.
        early, late = ((distance + extra_m) / 343 * dataset.sample_rate for extra_m in (-0.13, 0.06))
        assert ((onset >= early) & (onset <= late)).all()


def test_direct_sound_has_the_level_of_a_free_field_through_the_head(dataset, direct):
    hrtf = Hrtf.read(KEMAR, dataset.sample_rate)
    for emitter, listener in dataset.pairs(held_out=True):
        offset = dataset.probes[emitter] - dataset.probes[listener]
        distance = np.linalg.norm(offset)
        nearest = np.argmax(hrtf.directions @ (offset / distance))  # yaw 0 looks along +x, as the world's axes do
        expected = np.sum(hrtf.impulse_responses[nearest] ** 2, axis=-1) / distance**2
        found = np.sum(direct.response(emitter, listener)[0].astype(float) ** 2, axis=-1)
        # The air takes 0.25 dB at the most over these 4 m; between measured directions the head is interpolated.
        np.testing.assert_allclose(power_to_db(found / expected), 0, atol=0.7)


def test_no_direct_sound_through_a_wall(dataset):
    """The tiny room parted by a wall: only pairs on one side of it hear each other at once."""
    geometry = dataset.scene.geometry.model_copy(
        update={"corners": ((0, 0), (1.2, 0), (1.2, 2.9), (1.4, 2.9), (1.4, 0), (4, 0), (4, 3), (0, 3))}
    )
    walled = dataclasses.replace(dataset, scene=dataset.scene.model_copy(update={"geometry": geometry}))
    direct = DirectSound(walled)
    sides = walled.probes[:, 0] < 1.3
    assert 0 < sides.sum() < len(sides)
    for emitter, listener in dataset.pairs(held_out=False):
        assert direct.response(emitter, listener).any() == (sides[emitter] == sides[listener])


@pytest.mark.parametrize("take", ["reflected", "repeats"])
def test_a_reference_is_the_reflected_sound_and_the_direct_one(dataset, direct, take):
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        references = References(dataset, file, take)
        for emitter, listener in dataset.pairs(held_out=True):
            reflected = dataset.read(np.array([[emitter, listener]]), take)[0].astype(np.float32)
            found = references[emitter * len(dataset.probes) + listener]
            np.testing.assert_array_equal(found, reflected + direct.response(emitter, listener))
            assert reflected.any()
