import numpy as np
import pytest
import trimesh

from tests.training.data.levels.conftest import box
from training.data.levels.space import OUTSIDE, sample_space


def corners(*boxes):
    return np.concatenate([vertices[triangles] for vertices, triangles in boxes])


def test_the_volume_of_a_closed_surface_is_that_of_its_region():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.5)
    space = sample_space(np.asarray(ball.triangles))
    assert len(space.points) == 2
    assert space.volumes_m3[1] == pytest.approx(ball.volume, rel=0.01)


@pytest.mark.parametrize("turn", range(4))
def test_no_turned_box_leaks(turn):
    vertices, triangles = box()
    rotation = trimesh.transformations.random_rotation_matrix(np.random.default_rng(turn).random(3))[:3, :3]
    space = sample_space((vertices @ rotation.T)[triangles])
    assert len(space.points) == 2
    assert space.volumes_m3[1] == pytest.approx(5 * 2.6 * 4, rel=0.02)


def test_rooms_parted_by_a_sheet_are_two_regions_and_joined_by_a_gap_one():
    room = box()
    wall = np.array([(2, -1, -1), (2, 4, -1), (2, 4, 9), (2, -1, 9)], float)
    sheet = wall[np.array([(0, 1, 2), (0, 2, 3)])]
    space = sample_space(np.concatenate([corners(room), sheet]))
    one, two = space.regions_at([(1, 1, 1), (4, 1, 1)])
    assert one != two
    assert space.volumes_m3[[one, two]] == pytest.approx([2 * 2.6 * 4, 3 * 2.6 * 4], rel=0.03)
    assert space.regions_at([(9, 9, 9)]) == OUTSIDE
    narrow = sheet.copy()
    narrow[..., 1] = np.minimum(narrow[..., 1], 2.3)
    one, two = sample_space(np.concatenate([corners(room), narrow])).regions_at([(1, 1, 1), (4, 1, 1)])
    assert one == two


def test_a_region_sees_the_fronts_that_face_it():
    space = sample_space(corners(box(inward=True), box((1, 0.5, 1), (2, 1.5, 2), inward=False)))
    air, thing = space.regions_at([(4, 1, 1), (1.5, 1, 1.5)])
    assert space.seen[air, 1] == 0
    assert space.seen[air, 0] > 0
    assert space.seen[thing, 0] == 0
    assert space.seen[thing, 1] > 0


def test_sides_of_triangles_are_those_that_air_is_on():
    mesh = corners(box(inward=True))
    space = sample_space(mesh)
    is_air = np.arange(len(space.points)) != OUTSIDE
    front, back, both, neither = space.sides(mesh, is_air).T
    assert (front > 0).all()
    assert not back.any()
    assert not both.any()
    assert not neither.any()
    assert not space.sides(mesh[:, ::-1], is_air)[:, 0].any()
