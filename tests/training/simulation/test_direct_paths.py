"""The direct sound of references is the one that a renderer computes."""

import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db
from server.acoustics.sound_path import PlanPathFinder
from server.acoustics.transmission import transmission_loss_db
from training.data.scene_file import SceneFile
from training.data.simulation_plan import SimulationPlan
from training.simulation.direct_paths import DirectPaths

CORNERS = ((0, 0), (3, 0), (3, 4), (3.2, 4), (3.2, 0), (7, 0), (7, 5), (0, 5))
HERE, ROUND_THE_CORNER, BESIDE = np.array([1.0, 1.0, 1.2]), np.array([6.0, 1.5, 1.6]), np.array([2.0, 2.0, 1.4])
BENT = SimulationPlan.everything(1, 100)


def scene_with(tiny_scene, mass=None):
    scene = SceneFile.read(tiny_scene)
    walls = scene.geometry.materials.walls.model_copy(update={"surface_mass_kg_m2": mass})
    materials = scene.geometry.materials.model_copy(update={"walls": walls})
    return scene.model_copy(
        update={"geometry": scene.geometry.model_copy(update={"corners": CORNERS, "materials": materials})}
    )


@pytest.mark.parametrize("listener", [ROUND_THE_CORNER, BESIDE])
def test_it_comes_as_late_from_where_and_as_loud_as_rendering_has_it(tiny_scene, listener):
    scene = scene_with(tiny_scene)
    (position,), (amplitude,) = DirectPaths.of(scene, BENT).images(HERE, listener)
    paths = PlanPathFinder(scene.geometry.floor_plan, 343.0).find(listener, HERE[None])
    np.testing.assert_allclose(position - listener, paths.length_m[0] * paths.arrival[0], atol=1e-9)
    air_db = paths.length_m[0] * scene.air.absorption_db_per_m
    expected_db = paths.screen_db[0] - air_db - amplitude_to_db(paths.length_m[0])
    np.testing.assert_allclose(amplitude_to_db(amplitude), expected_db, atol=1e-9)


def test_without_diffraction_walls_are_silent_behind(tiny_scene):
    straight = DirectPaths.of(scene_with(tiny_scene), SimulationPlan.everything(1, 100, diffraction=False))
    positions, amplitudes = straight.images(HERE, ROUND_THE_CORNER)
    assert positions.shape == (0, 3)
    assert amplitudes.shape == (0, len(OCTAVE_BANDS_HZ))
    (position,), _ = straight.images(HERE, BESIDE)
    np.testing.assert_array_equal(position, HERE)


def test_through_a_thin_wall_it_comes_straight_and_as_much_quieter_as_its_mass_says(tiny_scene):
    scene = scene_with(tiny_scene, mass=20.0)
    paths = DirectPaths.of(scene, SimulationPlan.everything(1, 100, transmission=True))
    positions, amplitudes = paths.images(HERE, ROUND_THE_CORNER)
    np.testing.assert_array_equal(positions[1], HERE)
    distance = np.linalg.norm(HERE - ROUND_THE_CORNER)
    lost_db = distance * scene.air.absorption_db_per_m + amplitude_to_db(distance)
    expected_db = -transmission_loss_db(20.0, OCTAVE_BANDS_HZ) - lost_db
    np.testing.assert_allclose(amplitude_to_db(amplitudes[1]), expected_db, atol=1e-9)
    assert len(paths.images(HERE, BESIDE)[0]) == 1  # in sight there is nothing to go through
