"""What was hidden is found."""

import numpy as np

from server.health import search
from server.health.poses import EMITTER, LISTENER, YAW, allowed, corners, scattered

HIDDEN = np.array([6.3, 1.4, 2.0, 1.1, 4.2, 0.9, 0.7])


def test_every_pose_is_one_that_a_client_may_ask_for(bundle):
    for poses in (corners(bundle), scattered(bundle, 100, seed=3)):
        assert len(poses)
        for listener, emitter in zip(poses[:, LISTENER], poses[:, EMITTER], strict=True):
            bundle.require_inside(tuple(listener), "listener")
            bundle.require_inside(tuple(emitter), "emitter")


def test_corners_are_those_of_the_bounds_and_some_have_the_emitter_in_the_head(bundle):
    poses, bounds = corners(bundle), bundle.manifest.bounds
    assert len(poses) == 64
    assert set(np.unique(poses[:, 0])) == {bounds.minimum[0], bounds.maximum[0]}
    assert np.sum(np.all(poses[:, LISTENER] == poses[:, EMITTER], axis=1)) == 8


def test_the_same_poses_come_first_however_many_are_asked_for(bundle):
    np.testing.assert_array_equal(scattered(bundle, 700, seed=3)[:50], scattered(bundle, 50, seed=3))
    assert not np.array_equal(scattered(bundle, 50, seed=4), scattered(bundle, 50, seed=3))


def test_climbing_comes_nearer_to_a_peak_by_a_third(bundle):
    def worth(poses):
        return -np.linalg.norm(poses - HIDDEN, axis=1)

    start = scattered(bundle, 64, seed=0)
    start = start[np.argsort(-worth(start))[:8]]
    found, values = search.climb(bundle, worth, start, np.random.default_rng(0))
    assert values.max() > 0.65 * worth(start).max()
    assert allowed(bundle, found).all()
    np.testing.assert_allclose(worth(found), values)


def test_a_pose_that_gives_no_number_is_the_worst_there_is(bundle):
    def worth(poses):
        return np.where(poses[:, 0] > 5, np.nan, poses[:, 0])

    _, values = search.climb(bundle, worth, scattered(bundle, 8, seed=0), np.random.default_rng(0))
    assert np.isinf(values).any()


def test_a_jump_across_a_plane_is_found_to_the_centimetre(bundle):
    """Beyond it all is twice as loud, and on both sides levels change slowly."""
    plane = 2.345

    def energies(poses):
        loud = (1 + (poses[:, 0] > plane)) * (1 + 0.01 * poses[:, 1])
        return loud[:, None, None, None] * np.ones((1, 1, 7, 3))

    def change(step):
        return np.abs(10 * np.log10(step.after.sum(axis=(1, 2, 3)) / step.before.sum(axis=(1, 2, 3))))

    poses = scattered(bundle, 400, seed=2)
    moved = search.moves(poses, np.random.default_rng(1))["listener"]
    steps = search.steepest(bundle, energies, change, poses, moved, kept=6)
    changes = change(steps)
    assert changes.max() > 3.0
    assert np.abs(steps.poses[np.argmax(changes), 0] - plane) < search.STEP_M


def test_moves_are_of_sixteen_steps_of_one_thing_each(bundle):
    poses = scattered(bundle, 20, seed=2)
    moved = search.moves(poses, np.random.default_rng(1))
    for name, part in (("listener", LISTENER), ("emitter", EMITTER)):
        way = moved[name] - poses
        np.testing.assert_allclose(np.linalg.norm(way[:, part], axis=1), 16 * search.STEP_M)
        assert np.count_nonzero(np.any(way != 0, axis=0)) == 3
    np.testing.assert_allclose((moved["yaw"] - poses)[:, YAW], 16 * search.STEP_RAD)
