"""The direct path and the first reflections that are rendered and the reflected sound that fields learn are one
response, and no part of it comes twice.

The oracle is the simulation with its own direct sound. Beside a wall's edge, and round it, the direct path bends and
the straight one simulated here does not: pairs for this stand clear of both.
"""

import dataclasses

import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.acoustics.geometry import Pose
from server.acoustics.room_parameters import measure
from server.acoustics.surroundings import PlanSurroundings
from server.field.field import AcousticField
from server.offline.render import RenderedEmitter
from server.rendering.hrtf import kemar
from server.rendering.still_paths import StillPaths
from server.responses.early_reflections import EarlyReflections
from server.responses.full_response import FullResponse
from server.scene.bundle import BUNDLED, Bundle
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.simulation_plan import SimulationPlan
from training.simulation.direct_paths import DirectPaths
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

YAWS = 2 * np.pi * np.arange(3) / 3 + 0.2
RATE = 24_000


@dataclasses.dataclass
class Simulated:
    """Responses (yaw, ear, sample) of one pair: in two independent takes, and what is in both, the direct sound and the
    first reflections."""

    emitter: np.ndarray
    listener: np.ndarray
    direct: np.ndarray
    first: np.ndarray
    reflected: np.ndarray
    again: np.ndarray

    @property
    def onset(self):
        """(yaw, ear)"""
        return np.argmax(np.abs(self.direct) > 0.1 * np.abs(self.direct).max(axis=-1, keepdims=True), axis=-1)

    def drr_db(self, response):
        return measure(response, RATE, onset=self.onset).direct_to_reverberant_db


@pytest.fixture(scope="module", params=["one room", "other room"])
def pairs(apartment, request):
    """Fresh ones in the bundled apartment, at places where no probe stood, from 0.7 to 4.5 m apart, of one emitter."""
    emitter, mirror = {
        "one room": (np.array([6.0, 2.2, 1.5]), np.ones(3)),
        "other room": (np.array([2.0, 2.8, 1.5]), np.array([-1.0, 0.7, 1.0])),
    }[request.param]
    away = mirror * np.array(
        [(0.7, 0.0, 0.0), (-0.6, 0.9, 0.1), (1.2, 1.3, -0.2), (-1.1, -1.4, 0.1), (0.9, -1.6, 0.2), (-4.4, 0.3, 0.1)]
    )
    listeners = emitter + away
    settings = apartment.simulation
    directions = sphere_directions(settings.arrival_directions)

    def tracer_of(least_order, image_order):
        return RoomTracer(
            apartment.geometry,
            apartment.air,
            listeners,
            duration_s=settings.duration_s,
            image_order=image_order,
            arrival_directions=directions,
            least_order=least_order,
        )

    tracer = tracer_of(GEOMETRIC_ORDER + 1, settings.image_order)
    firsts = tracer_of(1, GEOMETRIC_ORDER).images(emitter)
    synthesis = BinauralSynthesis(kemar(RATE), directions, YAWS, round(settings.duration_s * RATE))
    rng = np.random.default_rng(0)
    takes = []
    for seed in (1, 2):
        arrivals = tracer.trace(emitter, rays=settings.rays, rng=np.random.default_rng(seed))
        onsets = np.linalg.norm(away, axis=-1) / SPEED_OF_SOUND
        takes.append([synthesis.render(*what, rng) for what in zip(arrivals, listeners, onsets, strict=True)])
    return [
        Simulated(
            emitter,
            listener,
            synthesis.direct(emitter, listener, apartment.air),
            synthesis.specular(*first, listener),
            *reflected,
        )
        for listener, first, *reflected in zip(listeners, firsts, *takes, strict=True)
    ]


@pytest.fixture(scope="module")
def field():
    return AcousticField.load(Bundle.load(BUNDLED / "apartment"))


def direct_paths(pair, air):
    """(yaw, ear, sample) by the code of the server, along a straight line."""
    paths = StillPaths(kemar(RATE), speed_of_sound=SPEED_OF_SOUND, air_db_per_m=air.absorption_db_per_m)
    offset = pair.emitter - pair.listener
    distance = np.linalg.norm(offset)
    responses = np.zeros(pair.direct.shape, np.float32)
    for response, yaw in zip(responses, YAWS, strict=True):
        turned = (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
        paths.add(np.array([distance]), offset[None] / distance, np.zeros((1, 7)), turned, response)
    return responses


def first_reflections(pair, scene):
    """(yaw, ear, sample) by the code of the server."""
    early = EarlyReflections(
        PlanSurroundings(scene.geometry.floor_plan),
        scene.geometry.materials.surfaces,
        speed_of_sound=SPEED_OF_SOUND,
        air_db_per_m=scene.air.absorption_db_per_m,
        filters=kemar(RATE),
    )
    responses = np.zeros(pair.first.shape, np.float32)
    emitter = RenderedEmitter(np.zeros(1, np.float32), Pose(tuple(pair.emitter)))
    for response, yaw in zip(responses, YAWS, strict=True):
        early.add(response[None], Pose.from_yaw(tuple(pair.listener), yaw), [emitter])
    return responses


def energy_db(response):
    return power_to_db(np.sum(np.square(response, dtype=np.float64), axis=-1))


def test_the_direct_path_is_the_direct_sound_of_the_simulation(pairs, apartment):
    for pair in pairs:
        difference = energy_db(direct_paths(pair, apartment.air)) - energy_db(pair.direct)
        # One is filtered in the frequency domain, the other by short filters and a fractional delay line.
        assert np.abs(difference).max() < 0.2


def test_first_reflections_are_those_of_the_simulation(pairs, apartment):
    for pair in pairs:
        rendered = first_reflections(pair, apartment)
        assert np.abs(energy_db(rendered) - energy_db(pair.first)).max() < 0.2
        # In phase, too, from the lowest to the highest frequencies.
        assert np.sum((rendered - pair.first) ** 2) < 0.02 * np.sum(pair.first**2)


def test_joined_to_the_simulated_reflections_nothing_counts_twice(pairs, apartment):
    ratios, energies = [], []
    for pair in pairs:
        reference = pair.reflected + pair.direct + pair.first
        joined = pair.reflected + direct_paths(pair, apartment.air) + first_reflections(pair, apartment)
        ratios.append(pair.drr_db(joined) - pair.drr_db(reference))
        energies.append(energy_db(joined) - energy_db(reference))
    assert np.abs(ratios).mean() < 0.05
    assert np.abs(energies).mean() < 0.05
    # A direct sound more, or less, and this is what it would be.
    once, twice = ([pair.drr_db(pair.reflected + n * pair.direct) for pair in pairs] for n in (1, 2))
    assert np.mean(np.array(twice) - once) > 2
    # And this, without the first reflections: several times what is allowed.
    without = [pair.drr_db(pair.reflected + pair.direct) for pair in pairs]
    whole = [pair.drr_db(pair.reflected + pair.direct + pair.first) for pair in pairs]
    assert np.abs(np.array(without) - whole).mean() > 0.6


def test_the_bundled_field_is_the_reflected_sound(pairs, field):
    """Against independent simulations, which differ among each other by 0.3 dB."""
    levels = []
    holds_first = field.bundle.manifest.image_order < GEOMETRIC_ORDER
    for pair in pairs:
        predicted = field.impulse_responses([pair.listener] * len(YAWS), [pair.emitter] * len(YAWS), YAWS)
        takes = np.stack([pair.reflected, pair.again]) + holds_first * pair.first
        levels.append(energy_db(predicted) - energy_db(takes))
    assert np.abs(levels).mean() < 0.7
    assert np.abs(np.mean(levels)) < 0.35


def test_the_bundled_field_and_the_direct_path_are_the_whole_response(pairs, field):
    whole = FullResponse.through_kemar(field)
    ratios, floor, levels = [], [], []
    for pair in pairs:
        reference = pair.reflected + pair.direct + pair.first
        predicted = whole.impulse_responses([pair.listener] * len(YAWS), [pair.emitter] * len(YAWS), YAWS)
        ratios.append(pair.drr_db(predicted) - pair.drr_db(reference))
        floor.append(pair.drr_db(pair.again + pair.direct + pair.first) - pair.drr_db(reference))
        levels.append(energy_db(predicted) - energy_db(reference))
    assert np.abs(ratios).mean() < np.abs(floor).mean() + 0.8
    assert np.abs(np.mean(ratios)) < 0.7
    assert np.abs(np.mean(levels)) < 0.3


def test_what_goes_through_a_wall_is_the_simulations(apartment):
    """Beside the first reflections, of a pair that the wall of the flat parts."""
    walls = apartment.geometry.materials.walls.model_copy(update={"surface_mass_kg_m2": 10.0})
    materials = apartment.geometry.materials.model_copy(update={"walls": walls})
    scene = apartment.model_copy(update={"geometry": apartment.geometry.model_copy(update={"materials": materials})})
    emitter, listener = np.array([6.0, 1.0, 1.5]), np.array([2.0, 1.2, 1.6])
    plan = SimulationPlan.everything(1, 100, diffraction=False, transmission=True)
    synthesis = BinauralSynthesis(kemar(RATE), sphere_directions(6), YAWS, 12_000)
    simulated = synthesis.specular(*DirectPaths.of(scene, plan).images(emitter, listener), listener)
    heard = []
    for transmission in (False, True):
        early = EarlyReflections(
            PlanSurroundings(scene.geometry.floor_plan),
            materials.surfaces,
            speed_of_sound=SPEED_OF_SOUND,
            air_db_per_m=scene.air.absorption_db_per_m,
            filters=kemar(RATE),
            transmission=transmission,
        )
        responses = np.zeros((len(YAWS), 2, 12_000), np.float32)
        placed = RenderedEmitter(np.zeros(1, np.float32), Pose(tuple(emitter)))
        for response, yaw in zip(responses, YAWS, strict=True):
            early.add(response[None], Pose.from_yaw(tuple(listener), yaw), [placed])
        heard.append(responses)
    through = heard[1] - heard[0]
    assert np.abs(simulated).max() > 1e-3
    np.testing.assert_allclose(energy_db(through), energy_db(simulated), atol=0.3)
    np.testing.assert_allclose(np.argmax(np.abs(through), axis=-1), np.argmax(np.abs(simulated), axis=-1), atol=2)
