"""Plans as meshes beside the plans, with few rays: one simulation is itself, and a mesh that is another is told."""

import numpy as np
import pytest

from server.scene.geometry import Materials
from training.data.levels.level_scene import LevelScene
from training.trials.plans_as_meshes import METRICS, SCENES, Sizes, compare, of_takes

FEW = Sizes(emitters=3, listeners=2, takes=3, rays=400)


@pytest.fixture(scope="module")
def small():
    return compare(SCENES[0], FEW)[0]


def test_there_are_seven_scenes():
    assert [path.stem for path in SCENES] == ["small1", "small2", "medium1", "medium2", "large1", "large2", "apartment"]
    assert all(path.is_file() for path in SCENES)


def test_a_plan_as_a_mesh_is_within_the_floor(small):
    assert small.scene == "small1"
    assert small.in_sight == FEW.pairs
    assert tuple(small.metrics) == METRICS
    for found in small.metrics.values():
        assert found.ratio < np.quantile(found.ratios, 0.99) + 0.1
        assert abs(found.shift) < 4 * found.shifts.std()
    assert small.metrics["level"].pairs == FEW.pairs
    assert abs(small.metrics["level"].shift) < 0.5
    assert 0 < small.times_as_long < 10


def test_a_mesh_that_absorbs_more_is_told(monkeypatch):
    def duller(scene):
        walls = scene.geometry.materials.walls.model_copy(update={"absorption": (0.7,) * 7})
        materials = Materials(walls=walls, floor=walls, ceiling=walls)
        geometry = scene.geometry.model_copy(update={"materials": materials})
        return as_mesh(scene.model_copy(update={"geometry": geometry}))

    as_mesh = LevelScene.of_plan
    monkeypatch.setattr(LevelScene, "of_plan", duller)
    found, _ = compare(SCENES[0], FEW)
    metrics = found.metrics
    assert metrics["level"].ratio > 3
    assert metrics["level"].shift < -0.5
    assert metrics["c50"].shift > 1
    assert metrics["t60"].shift < -20
    for name in ("level", "c50", "t60"):
        assert metrics[name].ratio > np.quantile(metrics[name].ratios, 0.95)
        assert abs(metrics[name].shift) > np.quantile(np.abs(metrics[name].shifts), 0.95)


def test_metrics_of_a_direct_sound_are_of_pairs_in_sight():
    found, with_images = compare(SCENES[5], Sizes(emitters=2, listeners=3, takes=2, rays=200))
    assert (found.image_order, with_images.image_order) == (1, 3)
    assert found.mesh_s == with_images.mesh_s
    assert 0 < found.in_sight < 6
    assert found.metrics["drr"].pairs == found.in_sight
    assert found.metrics["level"].pairs == 6


def takes(rng, bias=0.0):
    """Values of five emitters in four takes of a plan and four of a mesh, all their differences, and pairs."""
    values = rng.standard_normal((5, 8))
    values[:, 4:] += bias
    return np.abs(values[:, :, None] - values[:, None]), values, np.array([4, 4, 3, 4, 1])


def test_what_is_the_same_exceeds_the_range_of_chance_by_chance():
    rng = np.random.default_rng(0)
    found = [of_takes(*takes(rng), rng, draws=60) for _ in range(200)]
    assert np.mean([each.error for each in found]) == pytest.approx(np.mean([each.floor for each in found]), rel=0.04)
    assert np.mean([each.ratio > np.quantile(each.ratios, 0.95) for each in found]) == pytest.approx(0.05, abs=0.05)
    assert np.std([each.shift / each.shifts.std() for each in found]) == pytest.approx(1, abs=0.1)


def test_what_differs_is_beyond_chance():
    rng = np.random.default_rng(1)
    found = of_takes(*takes(rng, bias=2.0), rng)
    assert found.shift == pytest.approx(2, abs=0.8)
    assert found.ratio > found.ratios.max()
    assert found.pairs == 16


def test_emitters_without_known_pairs_do_not_count():
    differences, values, counts = takes(np.random.default_rng(2))
    counts[-1] = 0
    some = of_takes(differences[:4], values[:4], counts[:4], np.random.default_rng(0), draws=3)
    every = of_takes(differences, values, counts, np.random.default_rng(0), draws=3)
    assert (some.error, some.floor, some.shift) == pytest.approx((every.error, every.floor, every.shift))
