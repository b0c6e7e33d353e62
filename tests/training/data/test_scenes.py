"""The scenes that come with the training side: after the six of Luo et al. (2022), and the bundled apartment."""

from pathlib import Path

import numpy as np
import pytest

from training.data.scene_file import SceneFile

FOLDER = Path(__file__).parents[3] / "training" / "scenes"
LARGE, MEDIUM, SMALL = ("large1", "large2"), ("medium1", "medium2"), ("small1", "small2")


def read(name):
    return SceneFile.read(FOLDER / f"{name}.toml")


def reverberation_times_s(scene):
    """(band,) by Eyring, air included (Kuttruff, Room Acoustics, ch. 5)."""
    plan, materials = scene.geometry.floor_plan, scene.geometry.materials
    perimeter_m = np.linalg.norm(plan.walls[:, 1] - plan.walls[:, 0], axis=-1).sum()
    areas = np.array([perimeter_m * plan.height_m, plan.area_m2, plan.area_m2])
    absorption = areas @ [getattr(materials, name).absorption for name in ("walls", "floor", "ceiling")] / areas.sum()
    air_per_m = scene.air.absorption_db_per_m * np.log(10) / 10
    volume_m3 = plan.area_m2 * plan.height_m
    return 24 * np.log(10) / 343 * volume_m3 / (-areas.sum() * np.log(1 - absorption) + 4 * air_per_m * volume_m3)


def test_no_scene_goes_untested():
    assert {path.stem for path in FOLDER.glob("*.toml")} == {"apartment", *LARGE, *MEDIUM, *SMALL}


@pytest.mark.parametrize("name", ["apartment", *LARGE, *MEDIUM, *SMALL])
class TestEveryScene:
    def test_probes_are_inside_and_many_enough_for_all_rooms(self, name):
        scene = read(name)
        probes = scene.probe_positions(0)
        assert 40 <= len(probes) <= 60
        assert scene.geometry.floor_plan.contains(probes).all()
        # Nowhere in the room is further from a probe than two cells of their grid.
        low, high = np.min(scene.geometry.corners, axis=0), np.max(scene.geometry.corners, axis=0)
        points = np.random.default_rng(0).uniform([*low, 1.5], [*high, 1.5], (500, 3))
        points = points[scene.geometry.floor_plan.contains(points)]
        nearest = np.linalg.norm(points[:, None] - probes, axis=-1).min(axis=1)
        assert nearest.max() < 2 * scene.probes.spacing_m

    def test_every_probe_hears_every_other(self, name):
        scene = read(name)
        probes = scene.probe_positions(0)
        assert np.isfinite(scene.geometry.floor_plan.path_length_m(probes[0], probes)).all()

    def test_is_named_as_its_file_and_reverberates_as_a_furnished_home(self, name):
        scene = read(name)
        assert scene.id == name
        times_s = reverberation_times_s(scene)
        assert (times_s > 0.2).all()
        assert (times_s < 1.0).all()
        # Long enough for a decay of 45 dB in every band.
        assert (scene.simulation.duration_s > 0.75 * times_s).all()


@pytest.mark.parametrize("name", LARGE)
def test_large_scenes_are_rooms_joined_by_doorways(name):
    geometry = read(name).geometry
    plan, probes = geometry.floor_plan, read(name).probe_positions(0)
    assert plan.area_m2 > 60
    assert len(geometry.openings) >= 2
    out_of_sight = ~plan.is_visible(probes[:, None], probes[None])
    assert out_of_sight.mean() > 0.3
    for opening in geometry.openings:
        # One may stand in it, and neither of its posts.
        ends = np.array([(*opening.start, 1.0), (*opening.end, 1.0)])
        assert plan.wall_distance_m(ends) == pytest.approx(0, abs=1e-9)
        assert plan.contains(np.array((*opening.centre, 1.0)))


@pytest.mark.parametrize("name", MEDIUM)
def test_medium_scenes_are_one_room_that_is_no_rectangle(name):
    geometry = read(name).geometry
    assert 25 < geometry.floor_plan.area_m2 < 60
    assert not geometry.openings
    assert len(geometry.floor_plan.bend_corners) > 0


@pytest.mark.parametrize("name", SMALL)
def test_small_scenes_are_rectangles(name):
    geometry = read(name).geometry
    assert geometry.floor_plan.area_m2 < 25
    edges = np.diff(geometry.floor_plan.walls, axis=1)[:, 0]
    assert len(edges) == 4
    np.testing.assert_allclose(np.sum(edges * np.roll(edges, 1, axis=0), axis=1), 0, atol=1e-9)
