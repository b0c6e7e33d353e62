"""States of doors: each is the mesh with its leaves where they are, found quicker."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.acoustics.doors import DoorLeaf, LeafMotion, MeshWithDoors
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_edges_kernel import find_shortest, renew_shortest
from server.acoustics.surroundings import MeshSurroundings
from tests.two_rooms import BEFORE, BEHIND, EAST, SLIDE, SWING, WEST, box, leaf, moving, rooms

STATES = pytest.mark.parametrize("openness", [0.0, 0.07, 0.5, 1.0])
MOTIONS = pytest.mark.parametrize("motion", [SWING, SLIDE], ids=["swing", "slide"])
SPEED = 343.0


def places(count, seed=0):
    low, high = rooms().mesh.bounds_m
    found = np.random.default_rng(seed).uniform(low, high, (4 * count, 3))
    return found[MeshSurroundings(rooms().mesh).contains(found)][:count]


def paths(surroundings, listener, emitters):
    return surroundings.sound_paths(SPEED).find(np.array(listener), np.atleast_2d(emitters))


def test_a_swing_turns_about_its_hinge_and_a_slide_goes_along():
    corners = np.array([(4.05, 2.0, 0.0), (4.05, 2.9, 1.0)])
    assert_allclose(SWING.moved(corners, 1.0), [(4.05, 2.0, 0.0), (3.15, 2.0, 1.0)], atol=1e-12)
    half = 0.9 * np.sqrt(0.5)
    assert_allclose(SWING.moved(corners, 0.5)[1], (4.05 - half, 2.0 + half, 1.0), atol=1e-12)
    assert_allclose(SLIDE.moved(corners, 0.5), corners + np.array((0.0, 0.45, 0.0)), atol=1e-12)
    for motion in (SWING, SLIDE):
        assert_allclose(motion.moved(corners, 0.0), corners, atol=1e-12)


@MOTIONS
@STATES
def test_a_state_is_the_mesh_with_its_leaf_there(motion, openness):
    """Sight is the same, and paths are at most as much longer as points on the leaf are farther apart."""
    state = moving(motion).at((openness,))
    plain = MeshSurroundings(TriangleMesh.joined([rooms().mesh, DoorLeaf(leaf(), motion).at(openness)]))
    listeners, emitters = places(12, 1), places(60, 2)
    assert np.array_equal(state.mesh.corners_m, plain.mesh.corners_m)
    for listener in listeners:
        ours, theirs = (paths(each, listener, emitters) for each in (state, plain))
        assert np.array_equal(ours.in_sight, theirs.in_sight)
        assert np.array_equal(ours.screen_db <= -99, theirs.screen_db <= -99)
        heard = (ours.screen_db > -99).all(axis=1)
        assert np.max(ours.length_m[heard] - theirs.length_m[heard], initial=0.0) < 0.03
        assert np.max(theirs.length_m[heard] - ours.length_m[heard], initial=0.0) < 0.03


def test_nothing_is_heard_round_a_door_that_is_shut_and_all_is_when_it_is_open():
    doors = moving()
    shut, open_ = doors.at((0.0,)), doors.at((1.0,))
    assert paths(shut, WEST, EAST).screen_db.max() <= -99
    assert paths(open_, WEST, EAST).screen_db.min() > -40
    assert not shut.is_visible(np.array(BEFORE), np.array(BEHIND))
    assert open_.is_visible(np.array(BEFORE), np.array(BEHIND))


def test_through_a_shut_door_goes_what_its_mass_lets_through():
    """By the mass law: 10 kg/m2 at 1 kHz."""
    doors = moving()
    gains_db = np.full((len(doors.materials), 7), -100.0)
    losses_db = np.full_like(gains_db, np.inf)
    losses_db[doors.materials.index("wood")] = 30.0
    through = [
        found.gain_db
        for openness in (0.0, 1.0)
        for found in [doors.at((openness,)).first_reflections(gains_db, losses_db).find(BEFORE, [BEHIND])]
    ]
    assert len(through[0])
    assert_allclose(through[0].max(axis=0), -30.0)
    assert not len(through[1]) or through[1].max() < -90


def test_a_state_is_kept():
    doors = moving()
    assert doors.at((0.25,)) is doors.at((0.25,))
    assert doors.at((0.25,)) is not doors.at((0.5,))


@STATES
def test_sight_is_exact_at_once_and_ways_are_those_of_before(openness):
    doors = moving()
    before = doors.at((1.0,))
    soon, whole = doors.soon_at((openness,), before), moving().at((openness,))
    for listener in places(8, 3):
        emitters = places(60, 4)
        assert np.array_equal(paths(soon, listener, emitters).in_sight, paths(whole, listener, emitters).in_sight)
    assert soon.bends is before.bends
    doors.at((openness,))
    assert doors.soon_at((openness,), before) is doors.at((openness,))


def test_nothing_is_heard_by_a_way_of_before_in_which_the_leaf_now_stands():
    """Through the open door, a path bends at both of its frames; the leaf shuts between them."""
    doors = moving()
    open_ = doors.at((1.0,))
    assert paths(open_, WEST, EAST).screen_db.min() > -40
    soon = doors.soon_at((0.0,), open_)
    for listener in [place for place in places(40, 5) if place[0] < 4]:
        emitters = np.array([place for place in places(60, 6) if place[0] > 4.2])
        assert paths(soon, listener, emitters).screen_db.max() <= -99


@pytest.mark.parametrize("taken", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("more", [0, 15])
def test_ways_are_renewed_as_if_they_were_found_for_the_first_time(taken, more):
    """Steps between random places that are near each other, of which some are taken away and some new."""
    rng = np.random.default_rng(7)
    at = rng.uniform(size=(60 + more, 2))
    at[5] = at[6]  # a step of no length
    far = np.linalg.norm(at[:, None] - at, axis=-1)
    steps = np.where((far < 0.25) & ~np.eye(len(at), dtype=bool), far, np.inf).astype(np.float32)
    lengths, before = of(steps[:60, :60].copy())
    gone = np.triu(rng.uniform(size=(60, 60)) < taken)
    steps[:60, :60][gone | gone.T] = np.inf
    renewed, last = np.empty_like(steps), np.empty(steps.shape, np.int16)
    order = np.argsort(lengths, axis=-1, kind="stable").astype(np.int16)
    renew_shortest(steps, lengths, before, order, renewed, last)
    assert np.array_equal(renewed, of(steps)[0])
    for source, point in np.argwhere((last >= 0) & np.isfinite(renewed)):
        by = last[source, point]
        assert renewed[source, point] == renewed[source, by] + steps[by, point]
    assert np.array_equal(last < 0, ~np.isfinite(renewed) | np.eye(len(at), dtype=bool))


def of(steps):
    lengths, before = np.empty_like(steps), np.empty(steps.shape, np.int16)
    find_shortest(steps, lengths, before)
    return lengths, before


def test_nobody_is_shut_in_by_a_leaf():
    """Where a leaf passes, there is air all the same, and what is heard there is finite."""
    doors, inside = moving(), (4.075, 2.45, 1.5)
    for openness in (0.0, 0.3, 1.0):
        state = doors.at((openness,))
        assert state.holds(inside)
        assert doors.holds(inside)
        found = paths(state, inside, np.array([WEST, EAST, inside]))
        assert np.isfinite(found.length_m).all()
        assert np.isfinite(found.screen_db).all()
    assert not doors.holds((4.075, 1.0, 1.5))


@pytest.mark.parametrize(
    "emitter",
    [(4.1, 2.9, 1.0), (4.0, 2.0, 1.0), (4.05, 2.0, 0.0), (4.05, 2.45, 1.5), (4.075, 2.45, 2.8)],
    ids=["edge of the leaf", "edge of the wall", "vertex", "plane of a triangle", "ceiling above the leaf"],
)
@STATES
def test_emitters_on_edges_vertices_and_planes_have_finite_paths(emitter, openness):
    found = paths(moving().at((openness,)), WEST, emitter)
    assert np.isfinite(found.length_m).all()
    assert np.isfinite(found.screen_db).all()
    assert_allclose(np.linalg.norm(found.arrival, axis=-1), 1.0)


def test_a_ray_along_an_edge_and_coplanar_double_faces_stay_shut():
    """A leaf in a frame of the same outline: faces lie on each other, and no line slips between them."""
    still = TriangleMesh.joined([rooms().mesh, box((4.05, 2.0, 0.0), (4.1, 2.9, 1.4), "frame")])
    doors = MeshWithDoors(still, [DoorLeaf(leaf(), SWING)])
    shut = doors.at((0.0,))
    for y in (2.0, 2.45, 2.9):
        for z in (0.0, 1.4, 2.8):
            assert not shut.is_visible(np.array((3.0, y, z)), np.array((5.0, y, z)))
    assert paths(shut, WEST, EAST).screen_db.max() <= -99


def test_an_ornate_leaf_costs_little_more_than_a_plain_one():
    """Of its many edges, the longest bend sound: those of the leaf itself."""
    rng = np.random.default_rng(0)
    knobs = [
        box((4.03, y, z), (4.05, y + 0.08, z + 0.08), "wood") for y, z in rng.uniform((2.05, 0.1), (2.8, 2.6), (60, 2))
    ]
    still = MeshSurroundings(rooms().mesh).bends.places
    doors = MeshWithDoors(rooms().mesh, [DoorLeaf(TriangleMesh.joined([leaf(), *knobs]), SWING)])
    state = doors.at((0.5,))
    assert len(state.bends.places) <= len(still) + 48
    free = SWING.moved(np.array([(4.05, 2.9, 1.4)]), 0.5)  # half way up the edge that is not at the hinge
    assert np.linalg.norm(state.bends.places - free, axis=-1).min() < 0.5
    plain = moving().at((0.5,))
    ours, theirs = (paths(each, WEST, EAST).length_m[0] for each in (state, plain))
    assert ours == pytest.approx(theirs, abs=0.1)


def test_all_listeners_of_a_stream_have_the_same_moment():
    doors = moving()
    before = doors.at((1.0,))
    assert doors.soon_at((0.5,), before) is doors.soon_at((0.5,), before)
    assert doors.soon_at((0.5,), before) is not doors.soon_at((0.4,), before)
    other = doors.at((0.9,))
    assert doors.soon_at((0.5,), other).bends is other.bends


def test_leaves_without_an_edge_that_bends_are_taken():
    """A leaf within a wall, where no sound gets round it."""
    buried = LeafMotion("slide", (0.0, 0.0, 0.0), 0.0, (0.0, 0.5, 0.0))
    doors = MeshWithDoors(rooms().mesh, [DoorLeaf(box((4.02, 0.5, 0.5), (4.1, 1.0, 1.0), "wood"), buried)])
    assert paths(doors.at((0.5,)), WEST, EAST).screen_db.min() > -40
