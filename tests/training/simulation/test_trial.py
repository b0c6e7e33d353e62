"""A trial of few rays says what many would."""

from pathlib import Path

import numpy as np
import pytest

from server.acoustics.decibels import db_to_power
from server.scene.geometry import Geometry
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.simulation.plan_predictions import PlanPredictions
from training.simulation.planner import planner_of
from training.simulation.rays import RayTracer, sphere_directions
from training.simulation.trial import Trial, _root_mean_square
from training.trials.reverberation import reverberation_time_s
from training.trials.rooms_tried import rooms

SCENES = Path(__file__).parents[3] / "training" / "scenes"


def times_by_many_rays_s(scene: SceneFile, geometry: Geometry, rays: int = 150_000):
    """(band,) of the energy of one emitter at ten receivers."""
    probes = scene.probe_positions(0)
    tracer = RayTracer(geometry, probes[1:11], duration_s=10.0, image_order=0, arrival_directions=sphere_directions(1))
    energy = tracer.trace(probes[0], rays=rays, rng=np.random.default_rng(1)).sum(axis=(0, 1))
    bins_m = (np.arange(energy.shape[-1]) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND
    return reverberation_time_s(energy * db_to_power(-scene.air.absorption_db_per_m[:, None] * bins_m))


def test_long_rooms_ring_on_by_rays_of_which_there_are_few():
    """Of sixty metres of tunnel few rays told less than half of the reverberation."""
    (tunnel,) = (each for each in rooms() if each.id == "tunnel")
    trial = Trial.of_plan(tunnel, tunnel.probe_positions(0))
    expected = times_by_many_rays_s(tunnel, tunnel.geometry)
    np.testing.assert_allclose(trial.reverberation_time_s, expected, rtol=0.25)


@pytest.mark.parametrize("name", ["small1", pytest.param("small2", marks=pytest.mark.long)])
def test_places_of_one_small_room_share_their_late_sound(name):
    """By sixty-four times as many rays sharing changes 0.09 JND in `small1`."""
    scene = SceneFile.read(SCENES / f"{name}.toml")
    assert planner_of(scene, 0).plan({}).tail_start_s is not None


@pytest.mark.parametrize(
    ("scene", "most"), [("small1", 20_000), pytest.param("own/stairwell", 10_000, marks=pytest.mark.long)]
)
def test_a_tail_of_a_room_that_mixes_well_needs_few_rays(scene, most):
    scene = SceneFile.read(SCENES / f"{scene}.toml")
    predictions = PlanPredictions(scene, scene.probe_positions(0))
    assert 0 < predictions.trial.tail_rays(predictions.tail_start_s, 0.05) < most
    assert predictions.tail_rays() == scene.simulation.rays


def test_a_tail_needs_more_rays_where_few_of_them_run_level():
    corridor = SceneFile.read(SCENES / "own" / "corridor-20m.toml")
    predictions = PlanPredictions(corridor, corridor.probe_positions(0))
    needed = predictions.trial.tail_rays(predictions.tail_start_s, 0.05)
    assert needed > 10 * corridor.simulation.rays
    assert predictions.trial.tail_rays(predictions.tail_start_s, 0.1) == pytest.approx(needed / 4)
    assert predictions.tail_rays() == 16 * corridor.simulation.rays


def differences(common, spread, noise, pairs=60, takes=2, seed=0):
    """(take, pair, band 1) of pairs that have a difference in common, and one of their own."""
    rng = np.random.default_rng(seed)
    own = common + spread * rng.standard_normal(pairs)
    return (own + noise * rng.standard_normal((takes, pairs)))[..., None]


def mean_over_draws(**shares):
    return np.mean([_root_mean_square(differences(**shares, seed=seed))[0] for seed in range(200)])


def test_what_pairs_have_in_common_and_what_they_differ_by_is_told_apart_from_chance():
    assert mean_over_draws(common=0.5, spread=0.0, noise=0.5) == pytest.approx(0.5, rel=0.1)
    assert mean_over_draws(common=0.0, spread=1.0, noise=0.5) == pytest.approx(1.0, rel=0.2)
    assert mean_over_draws(common=0.0, spread=0.0, noise=1.0) < 0.1


def test_pairs_that_cannot_be_told_are_left_out():
    difference = differences(common=0.5, spread=0.0, noise=0.0)
    difference[0, ::2] = np.nan
    assert _root_mean_square(difference)[0] == pytest.approx(0.5)
    assert _root_mean_square(np.full_like(difference, np.nan))[0] == 0.0
