"""Whole simulated responses: direct sound and first reflections come from geometry, everything else from the energies
of the dataset, nothing twice."""

import dataclasses

import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.rendering.hrtf import KEMAR, Hrtf, kemar
from training.data.dataset import TAKES
from training.simulation.rays import sphere_directions
from training.simulation.references import GeometricSound, References
from training.simulation.responses import SimulatedResponses
from training.simulation.run import prepared
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
    walled = dataclasses.replace(dataset, place=dataset.scene.model_copy(update={"geometry": geometry}))
    geometric = GeometricSound(walled)
    sides = walled.probes[:, 0] < 1.3
    assert 0 < sides.sum() < len(sides)
    for emitter, listener in dataset.pairs(held_out=False):
        assert geometric.direct(emitter, listener).any() == (sides[emitter] == sides[listener])


@pytest.mark.parametrize("take", TAKES)
def test_a_reference_is_the_late_sound_and_what_geometry_knows(dataset, geometric, take):
    references = References(dataset, take)
    for emitter, listener in dataset.pairs(held_out=True):
        reflected = references.reflected(emitter, listener)
        found = references[emitter * len(dataset.probes) + listener]
        known = geometric.direct(emitter, listener) + geometric.first_reflections(emitter, listener)
        np.testing.assert_allclose(found, reflected + known, atol=1e-6)
        assert reflected.any()


@pytest.mark.parametrize("take", TAKES)
def test_late_sound_from_stored_energies_is_that_of_the_simulation(dataset, take):
    """But for the half precision of what is stored."""
    simulation = prepared(dataset.scene, seed=dataset.seed, plan=dataset.effects)
    references, number = References(dataset, take), TAKES.index(take)
    emitter, _ = dataset.pairs(held_out=True)[0]
    everyone = np.delete(np.arange(len(dataset.probes)), emitter)
    listeners = (everyone, np.flatnonzero(dataset.held_out[emitter]))[number]
    for listener, _, simulated in simulation.take(emitter, listeners, number):
        if not dataset.held_out[emitter, listener]:  # whose tail is another
            continue
        found = references.reflected(int(emitter), listener)
        assert np.sum((found - simulated) ** 2) < 1e-4 * np.sum(simulated**2)


def test_second_takes_share_the_mirrors_and_not_the_noise(dataset):
    references = [References(dataset, take) for take in TAKES]
    loudness = []
    for emitter, listener in dataset.pairs(held_out=True):
        one, other = (take.reflected(emitter, listener).astype(float) for take in references)
        onset = round(dataset.onset_s[emitter, listener] * dataset.sample_rate)
        # Mirrors in two walls are heard this early here, between what is diffuse.
        head = slice(onset, onset + round(0.008 * dataset.sample_rate))
        assert np.corrcoef(one[..., head].ravel(), other[..., head].ravel())[0, 1] > 0.2
        tail = slice(onset + 800, None)
        assert abs(np.corrcoef(one[..., tail].ravel(), other[..., tail].ravel())[0, 1]) < 0.2
        loudness.append([np.sum(one**2), np.sum(other**2)])
    # Independent simulations of one room agree on its level.
    first, second = np.sum(loudness, axis=0)
    assert first == pytest.approx(second, rel=0.3)


def test_whole_responses_are_references_row_by_row(dataset):
    whole, reflected = SimulatedResponses(dataset, whole=True), SimulatedResponses(dataset)
    yaws = len(dataset.yaws)
    rows = np.array([5 * yaws + 1, 0, 7 * yaws, 5 * yaws])
    references = References(dataset)
    for row, found, late in zip(rows, whole.read(rows), reflected.read(rows), strict=True):
        emitter, listener = whole.ends(row)
        np.testing.assert_allclose(found, references.complete(emitter, listener)[row % yaws], atol=1e-6)
        np.testing.assert_allclose(late, references.reflected(emitter, listener)[row % yaws], atol=1e-6)
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


def test_a_head_that_is_turned_hears_the_same_sound(dataset):
    """At an orientation that no yaw of the dataset has, level and turned by a quaternion alike."""
    half = 0.35
    by_yaw = References(dataset, heads=np.array([2 * half]))
    by_quaternion = References(dataset, heads=np.array([[0.0, 0.0, np.sin(half), np.cos(half)]]))
    own = References(dataset)
    for emitter, listener in dataset.pairs(held_out=True):
        turned = by_yaw.complete(emitter, listener)
        np.testing.assert_allclose(by_quaternion.complete(emitter, listener), turned, atol=1e-5)
        every = own.complete(emitter, listener)
        assert np.abs(turned - every).max(axis=(1, 2)).min() > 1e-3
        energies = np.sum(every.astype(float) ** 2, axis=(1, 2))
        assert 0.5 * energies.min() < np.sum(turned.astype(float) ** 2) < 2 * energies.max()


def test_another_head_hears_the_same_noise(dataset):
    """One that is twice as loud hears twice of everything."""
    head = kemar(dataset.sample_rate)
    louder = dataclasses.replace(head, cepstra=head.cepstra + np.log(2.0) * (np.arange(head.cepstra.shape[-1]) == 0))
    emitter, listener = dataset.pairs(held_out=True)[0]
    found = References(dataset, filters=louder).complete(emitter, listener)
    np.testing.assert_allclose(found, 2 * References(dataset).complete(emitter, listener), atol=1e-4)


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
