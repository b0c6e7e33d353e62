import numpy as np
import pytest
import trimesh

from tests.training.data.levels.conftest import box
from training.data.levels.topology import Topology, copies, is_degenerate, is_sliver, weld


def soup(vertices, triangles):
    """Each triangle with vertices of its own."""
    return vertices[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)


def test_welding_joins_what_is_nearer_than_a_tenth_of_a_millimetre():
    vertices, triangles = soup(*box())
    moved = vertices + np.random.default_rng(0).uniform(-3e-5, 3e-5, vertices.shape)
    welded, joined = weld(moved, triangles)
    assert len(welded) == 8
    assert trimesh.Trimesh(welded, joined, process=False).is_watertight
    apart, _ = weld(np.array([(0, 0, 0), (2e-4, 0, 0), (0, 1, 0)], float), np.array([(0, 1, 2)]))
    assert len(apart) == 3


def test_flat_triangles_and_slivers():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0), (1, 0.004, 0), (0, 1, 0)], float)
    triangles = np.array([(0, 1, 2), (0, 2, 3), (0, 1, 4), (0, 0, 1)])
    np.testing.assert_array_equal(is_degenerate(vertices, triangles), [True, False, False, True])
    np.testing.assert_array_equal(is_sliver(vertices, triangles)[:3], [True, True, False])


def test_copies_are_told_from_triangles_back_to_back():
    triangles = np.array([(0, 1, 2), (1, 2, 0), (2, 1, 0), (0, 1, 3)])
    same, opposite = copies(triangles)
    np.testing.assert_array_equal(same, [False, True, False, False])
    np.testing.assert_array_equal(opposite, [False, False, True, False])


def test_a_hole_is_as_long_as_its_edges():
    vertices, triangles = box(without=(0, 6))  # both triangles of one side
    topology = Topology(vertices, triangles)
    (hole,) = topology.holes(np.zeros(len(topology.edges), bool))
    side = {1: (2.6, 4.0), 0: (2.6, 4.0)}[0]
    assert len(hole.edges) == 4
    assert hole.length_m == pytest.approx(2 * sum(side))
    assert hole.extent_m == pytest.approx(np.hypot(*side))
    np.testing.assert_allclose(hole.centre_m, (0, 1.3, 2))


def test_a_closed_mesh_has_no_hole():
    topology = Topology(*box())
    assert not topology.holes(np.zeros(len(topology.edges), bool))
    np.testing.assert_array_equal(topology.uses, 2)


def test_a_patch_knows_which_of_its_triangles_face_against_it():
    vertices, triangles = box()
    turned = np.random.default_rng(1).permutation(12) < 5
    mixed = np.where(turned[:, None], triangles[:, ::-1], triangles)
    patch, against, one_sided = Topology(vertices, mixed).patches
    assert len(set(patch)) == 1
    assert (against == turned).all() or (against == ~turned).all()
    assert one_sided == 0


def test_a_moebius_strip_has_one_side():
    turns = np.linspace(0, 2 * np.pi, 13)[:-1]
    across = np.stack([np.cos(turns / 2) * np.cos(turns), np.cos(turns / 2) * np.sin(turns), np.sin(turns / 2)], axis=1)
    middle = np.stack([3 * np.cos(turns), 3 * np.sin(turns), 0 * turns], axis=1)
    vertices = np.concatenate([middle + across, middle - across])
    triangles = []
    for i in range(12):
        a, b = i, i + 12
        c, d = (i + 1, i + 13) if i < 11 else (12, 0)
        triangles += [(a, c, b), (b, c, d)]
    assert Topology(vertices, np.array(triangles)).patches[2] == 24
