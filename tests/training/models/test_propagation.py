import numpy as np
import pytest
import torch

from server.acoustics.geometry import FloorPlan
from training.models.propagation import Propagation

PLANS = {
    "apartment": FloorPlan(
        ((0, 0), (4, 0), (4, 2), (4.2, 2), (4.2, 0), (8, 0), (8, 5), (4.2, 5), (4.2, 3), (4, 3), (4, 5), (0, 5)), 2.8
    ),
    "L": FloorPlan(((0, 0), (6, 0), (6, 2), (2, 2), (2, 5), (0, 5)), 3.0),
    # Round two bends, with slanted walls.
    "horseshoe": FloorPlan(((0, 0), (9, 0.5), (8.5, 5), (6, 5), (5.5, 2), (3, 1.8), (2.5, 5.2), (0, 5)), 3.0),
    "shoebox": FloorPlan(((0, 0), (4, 0), (4, 3), (0, 3)), 2.5),
}
PAIRS = 3000


def random_pairs(plan):
    rng = np.random.default_rng(0)
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    points = rng.uniform((*low, 0.1), (*high, plan.height_m - 0.1), (4 * PAIRS, 3)).astype(np.float32)
    points = points[plan.contains(points) & (plan.wall_distance_m(points) > 0.01)]
    return points[: len(points) // 2], points[len(points) // 2 : len(points) // 2 * 2]


@pytest.fixture(params=PLANS)
def case(request):
    """A plan, emitters and listeners in it, and their paths by way of torch."""
    plan = PLANS[request.param]
    listeners, emitters = random_pairs(plan)
    path = Propagation(plan)(torch.from_numpy(listeners), torch.from_numpy(emitters))
    return plan, listeners, emitters, path


def test_lengths_are_those_of_the_floor_plan(case):
    plan, listeners, emitters, path = case
    assert len(listeners) > PAIRS / 2
    np.testing.assert_allclose(path.length.numpy()[:, 0], plan.path_length_m(emitters, listeners), atol=2e-4)


def test_sight_is_that_of_the_floor_plan(case):
    plan, listeners, emitters, path = case
    expected = plan.is_visible(listeners, emitters)
    # Single precision may differ where a corner is grazed.
    assert np.mean((path.visible.numpy()[:, 0] == 1) != expected) < 1e-3
    assert expected.all() == (plan is PLANS["shoebox"])


def test_sight_fades_with_what_a_corner_adds_to_the_way(case):
    """Reflected sound does not change at once where the straight line breaks."""
    plan, listeners, emitters, path = case
    excess_m = plan.path_length_m(emitters * (1, 1, 0), listeners * (1, 1, 0))
    excess_m = excess_m - np.linalg.norm((emitters - listeners)[:, :2], axis=-1)
    np.testing.assert_allclose(path.visible.numpy()[:, 0], np.exp(-excess_m / 0.05), atol=0.01)


def test_no_step_of_a_millimetre_changes_sight_by_much():
    """Past the corner of an L."""
    plan = PLANS["L"]
    across = np.linspace(2.1, 4.5, 2401, dtype=np.float32)
    listeners = np.column_stack([np.full_like(across, 1.0), across, np.full_like(across, 1.5)])
    emitters = np.tile(np.array([5.0, 1.0, 1.5], np.float32), (len(across), 1))
    sight = Propagation(plan)(torch.from_numpy(listeners), torch.from_numpy(emitters)).visible.numpy()[:, 0]
    assert sight.min() < 0.1
    assert sight.max() == 1
    assert np.abs(np.diff(sight)).max() < 0.02


def test_directions_are_unit_vectors(case):
    *_, path = case
    assert ((path.directions.norm(dim=-1) - 1).abs() < 0.02).all()


def test_in_sight_they_point_at_each_other(case):
    _, listeners, emitters, path = case
    seen = path.visible.numpy()[:, 0] == 1
    offset = (emitters - listeners)[seen, :2]
    straight = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    far = np.linalg.norm(offset, axis=-1) > 0.1
    np.testing.assert_allclose(path.directions[:, 0].numpy()[seen][far], straight[far], atol=2e-3)
    np.testing.assert_allclose(path.directions[:, 1].numpy()[seen][far], -straight[far], atol=2e-3)


def test_out_of_sight_they_set_out_on_a_shortest_path(case):
    """A small step in the direction given makes what remains shorter by the step."""
    plan, listeners, emitters, path = case
    hidden = ~plan.is_visible(listeners, emitters) & (path.visible.numpy()[:, 0] < 0.5)
    step_m = 0.02
    for here, there, direction in (
        (listeners[hidden], emitters[hidden], path.directions[:, 0].numpy()[hidden]),
        (emitters[hidden], listeners[hidden], path.directions[:, 1].numpy()[hidden]),
    ):
        level = there.copy()
        level[:, 2] = here[:, 2]
        corner_far = np.min(np.linalg.norm(here[:, None, :2] - np.array(plan.corners), axis=-1), axis=1) > 2 * step_m
        ahead = here + step_m * np.pad(direction, ((0, 0), (0, 1)))
        shorter = plan.path_length_m(here, level) - plan.path_length_m(ahead, level)
        np.testing.assert_allclose(shorter[corner_far], step_m, atol=2e-4)


def test_paths_there_and_back_are_one(case):
    plan, listeners, emitters, path = case
    back = Propagation(plan)(torch.from_numpy(emitters), torch.from_numpy(listeners))
    torch.testing.assert_close(back.length, path.length, rtol=0, atol=1e-4)
    torch.testing.assert_close(back.directions.flip(1), path.directions, rtol=0, atol=1e-3)


def test_a_listener_at_the_emitter_is_finite(case):
    plan, listeners, *_ = case
    points = torch.from_numpy(listeners[:5]).requires_grad_()
    path = Propagation(plan)(points, points)
    for part in (path.length, path.directions):
        assert part.isfinite().all()
    path.length.sum().backward()
    assert points.grad.isfinite().all()


@pytest.mark.parametrize("far", [1e3, 1e5, 1e6])
def test_sight_of_places_far_outside_is_a_share(far):
    """A network that is asked there multiplies by it."""
    turns = np.linspace(0, 2 * np.pi, 40)
    listeners = np.stack([far * np.cos(turns), far * np.sin(turns), np.full(40, 1.5)], axis=-1).astype(np.float32)
    emitters = np.tile(np.array([[1.0, 1.0, 1.5]], np.float32), (40, 1))
    path = Propagation(PLANS["apartment"])(torch.from_numpy(listeners), torch.from_numpy(emitters))
    assert ((path.visible >= 0) & (path.visible <= 1)).all()
    assert torch.isfinite(path.length).all()
