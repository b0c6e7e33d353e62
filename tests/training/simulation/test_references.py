"""Whole simulated responses: direct sound and first reflections come from geometry, everything else from the dataset,
nothing twice."""

import dataclasses

import h5py
import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.rendering.hrtf import KEMAR, Hrtf, kemar
from training.data.dataset import TAKES
from training.data.responses import SimulatedResponses
from training.simulation.rays import sphere_directions
from training.simulation.references import GeometricSound, References, ReheardReferences, WholeResponses
from training.simulation.synthesis import BinauralSynthesis


@pytest.fixture(scope="module")
def geometric(dataset):
    return GeometricSound(dataset)


def test_direct_sound_arrives_when_it_can(dataset, geometric):
    """In a shoebox every pair is in sight: at the louder ear it comes after distance / c."""
    for emitter, listener in dataset.pairs(held_out=False):
        loudest = np.abs(geometric.direct(emitter, listener)).max(axis=1)
        onset = np.argmax(loudest > 0.2 * loudest.max(axis=-1, keepdims=True), axis=-1)
        distance = np.linalg.norm(dataset.probes[emitter] - dataset.probes[listener])
        # Sound reaches the nearer ear up to a head's radius earlier.
        early, late = ((distance + extra_m) / 343 * dataset.sample_rate for extra_m in (-0.13, 0.06))
        assert ((onset >= early) & (onset <= late)).all()


def test_direct_sound_has_the_level_of_a_free_field_through_the_head(dataset, geometric):
    hrtf = Hrtf.read(KEMAR, dataset.sample_rate)
    for emitter, listener in dataset.pairs(held_out=True):
        offset = dataset.probes[emitter] - dataset.probes[listener]
        distance = np.linalg.norm(offset)
        nearest = np.argmax(hrtf.directions @ (offset / distance))  # yaw 0 looks along +x, as the world's axes do
        expected = np.sum(hrtf.impulse_responses[nearest] ** 2, axis=-1) / distance**2
        found = np.sum(geometric.direct(emitter, listener)[0].astype(float) ** 2, axis=-1)
        # The air takes 0.25 dB at the most over these 4 m; between measured directions the head is interpolated.
        np.testing.assert_allclose(power_to_db(found / expected), 0, atol=0.7)


def test_no_direct_sound_through_a_wall(dataset):
    """The tiny room parted by a wall: only pairs on one side of it hear each other at once."""
    geometry = dataset.scene.geometry.model_copy(
        update={"corners": ((0, 0), (1.2, 0), (1.2, 2.9), (1.4, 2.9), (1.4, 0), (4, 0), (4, 3), (0, 3))}
    )
    walled = dataclasses.replace(dataset, scene=dataset.scene.model_copy(update={"geometry": geometry}))
    geometric = GeometricSound(walled)
    sides = walled.probes[:, 0] < 1.3
    assert 0 < sides.sum() < len(sides)
    for emitter, listener in dataset.pairs(held_out=False):
        assert geometric.direct(emitter, listener).any() == (sides[emitter] == sides[listener])


@pytest.mark.parametrize("take", ["reflected", "repeats"])
def test_a_reference_is_the_stored_sound_and_what_geometry_knows(dataset, geometric, take):
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        references = References(dataset, file, take)
        for emitter, listener in dataset.pairs(held_out=True):
            reflected = dataset.read(np.array([[emitter, listener]]), take)[0].astype(np.float32)
            found = references[emitter * len(dataset.probes) + listener]
            known = geometric.direct(emitter, listener) + geometric.first_reflections(emitter, listener)
            np.testing.assert_allclose(found, reflected + known, atol=1e-6)
            assert reflected.any()


def test_whole_responses_are_references_row_by_row(dataset):
    whole, reflected = WholeResponses(dataset), SimulatedResponses(dataset)
    yaws = len(dataset.yaws)
    rows = np.array([5 * yaws + 1, 0, 7 * yaws, 5 * yaws])
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        references = References(dataset, file)
        for row, found in zip(rows, whole.read(rows), strict=True):
            emitter, listener = whole.ends(row)
            expected = references[emitter * len(dataset.probes) + listener][row % yaws]
            np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(whole.read(rows) - reflected.read(rows)).max() > 0.01


def test_first_reflections_in_a_shoebox_are_direct_sounds_of_six_mirrored_emitters(dataset, geometric):
    """Of which 0.7 of the energy is reflected and 0.7 of that not scattered, alike on all surfaces and in all bands."""
    size_m, amplitude = (4.0, 3.0, 2.5), 0.7
    synthesis = BinauralSynthesis(kemar(dataset.sample_rate), sphere_directions(6), dataset.yaws, dataset.samples)
    for emitter, listener in dataset.pairs(held_out=True):
        place, expected = dataset.probes[emitter], 0.0
        for axis, extent in enumerate(size_m):
            for wall in (0.0, extent):
                image = np.where(np.arange(3) == axis, 2 * wall - place, place)
                mirrored = synthesis.direct(image, dataset.probes[listener], dataset.scene.air)
                expected = expected + amplitude * mirrored
        found = geometric.first_reflections(emitter, listener)
        assert np.abs(found).max() > 0.01
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(found).max())


def test_heard_anew_through_its_own_head_a_reference_differs_in_noise_alone(dataset):
    own = kemar(dataset.sample_rate)
    anew, other = (ReheardReferences(dataset, own, dataset.yaws, take) for take in TAKES)
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        stored = References(dataset, file)
        for emitter, listener in dataset.pairs(held_out=True):
            pair = emitter * len(dataset.probes) + listener
            found, expected = anew[pair], stored[pair]
            assert found.shape == expected.shape
            assert not np.array_equal(found, expected)
            ratio_db = 10 * np.log10(np.sum(found**2, axis=-1) / np.sum(expected**2, axis=-1))
            assert np.abs(ratio_db).max() < 1.5
            np.testing.assert_array_equal(found, anew[pair])  # the noise is that of the pair
            assert not np.array_equal(found, other[pair])
            # What comes before any diffuse sound is the same: the direct sound, from the same side.
            first = round(dataset.onset_s[emitter, listener] * dataset.sample_rate)
            np.testing.assert_allclose(found[..., :first], expected[..., :first], atol=1e-3 * np.abs(expected).max())


def test_a_head_on_its_side_hears_above_what_it_heard_at_its_left(dataset):
    own = kemar(dataset.sample_rate)
    level, rolled = (
        GeometricSound(dataset, own, np.array([orientation]))
        for orientation in ((0.0, 0.0, 0.0, 1.0), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)))
    )
    receiver = np.array([1.0, 1.0, 1.0])
    above, left, amplitude = receiver + np.eye(3)[2], receiver + np.eye(3)[1], np.ones((1, 7))
    # Rolled to the right, the left ear points up: sound from above comes from its left.
    found = rolled.synthesis.specular(above[None], amplitude, receiver)
    np.testing.assert_allclose(found, level.synthesis.specular(left[None], amplitude, receiver), atol=1e-5)
