import re

import numpy as np
import pytest
import trimesh

from tests.training.data.levels.conftest import box, empty, room
from training.data.levels.examination import examine
from training.data.levels.gltf_file import read_gltf
from training.data.levels.gltf_writer import Piece, WrittenNode
from training.data.levels.level import GLTF_AXES, level_of

VOLUME_M3 = 5 * 2.6 * 4


@pytest.fixture
def examined(glb):
    def examine_nodes(*nodes, **options):
        path = glb(*nodes)
        return examine(level_of(path, read_gltf(path), GLTF_AXES), **options)

    return examine_nodes


def found(seen):
    return {finding.what: finding for finding in seen.findings}


def test_a_closed_room_has_nothing_at_fault(examined):
    seen = examined(room())
    assert not seen.problems
    assert not seen.holes
    assert set(found(seen)) == set()
    (only,) = seen.rooms
    assert only.volume_m3 == pytest.approx(VOLUME_M3, abs=3 * only.volume_error_m3)
    assert seen.mesh.volume_m3 == pytest.approx(VOLUME_M3)


def test_an_inside_out_room_is_turned(examined):
    seen = examined(room(inward=False))
    assert found(seen)["triangles that faced away from the air"].count == 12
    assert seen.mesh.volume_m3 == pytest.approx(VOLUME_M3)  # positive: its normals point into the air


def test_single_faces_that_face_away_are_turned(examined):
    vertices, triangles = box()
    triangles[[2, 7]] = triangles[[2, 7]][:, ::-1]
    seen = examined(WrittenNode("room", (Piece(vertices, triangles, "plaster"),)))
    finding = found(seen)["triangles that faced away from the air"]
    assert (finding.count, finding.done, finding.nodes) == (2, "turned", ("room",))
    assert seen.mesh.volume_m3 == pytest.approx(VOLUME_M3)


def test_a_house_with_thick_walls_loses_its_outside(examined):
    shell = Piece(*box((-0.3, -0.3, -0.3), (5.3, 2.9, 4.3), inward=False), "brick")
    seen = examined(room(), WrittenNode("shell", (shell,)))
    assert found(seen)["triangles that no air touches"].count == 12
    assert seen.mesh.volume_m3 == pytest.approx(VOLUME_M3)
    assert seen.mesh.materials == ("plaster",)


def test_a_listener_outside_keeps_the_outside(examined):
    shell = Piece(*box((-0.3, -0.3, -0.3), (5.3, 2.9, 4.3), inward=False), "brick")
    seen = examined(room(), WrittenNode("shell", (shell,)), empty("spawn_garden", (20, 1, 0)), is_open=True)
    assert "triangles that no air touches" not in found(seen)


def test_furniture_is_no_room_and_its_faces_are_kept(examined):
    cupboard = Piece(*box((1, 0.05, 1), (2.5, 2.0, 2), inward=False), "wood")
    seen = examined(room(), WrittenNode("cupboard", (cupboard,)))
    (only,) = seen.rooms
    assert only.volume_m3 == pytest.approx(VOLUME_M3 - 1.5 * 1.95, abs=3 * only.volume_error_m3)
    assert seen.mesh.volume_m3 == pytest.approx(VOLUME_M3 - 1.5 * 1.95)


@pytest.mark.parametrize("name", ["listener_start", "emitter_a", "spawn_a"])
def test_a_place_in_a_wall_is_refused(examined, name):
    cupboard = Piece(*box((1, 0.05, 1), (1.9, 0.9, 1.9), inward=False), "wood")
    seen = examined(room(), WrittenNode("cupboard", (cupboard,)), empty(name, (1.5, 0.5, 1.5)))
    (problem,) = seen.problems
    assert re.search(r"is in a wall or another closed thing of 0\.6\d m3: move it into the air", problem)
    assert name.replace("_a", " a") in problem


def test_a_small_hole_is_told_and_a_wide_one_refused(examined):
    wide = examined(room(without=(4, 10)))  # a wall of 5 x 2.6 m, of 98.8 m2 in all
    assert "the level leaks" in wide.problems[0]
    assert "through the hole of" in wide.problems[0]
    assert not examined(room(without=(4, 10)), is_open=True).problems
    hole = found(wide)["holes"]
    assert hole.count == 1
    assert found(wide)["no closed room"].done == "told"
    pierced = trimesh.Trimesh(*box(), process=False).subdivide().subdivide().subdivide()
    narrow = examined(WrittenNode("room", (Piece(np.asarray(pierced.vertices), np.asarray(pierced.faces[1:]), "x"),)))
    assert not narrow.problems
    assert 0 < narrow.drawn.escape.left < 0.01 * narrow.drawn.escape.rays
    assert found(narrow)["rays that left"].done == "told"


def test_double_and_flat_faces_go(examined):
    vertices, triangles = box()
    more = np.concatenate([triangles, triangles[:2], triangles[3:4, ::-1], [(0, 0, 1)]])
    seen = examined(WrittenNode("room", (Piece(vertices, more, "plaster"),)))
    assert found(seen)["copies of triangles"].count == 2
    assert found(seen)["triangles on each other, back to back"].count == 1
    assert found(seen)["triangles without area"].count == 1
    assert len(seen.mesh.triangles) == 12


def test_things_that_cross_or_lie_on_each_other_are_told(examined):
    post = Piece(*box((1, -0.5, 1), (1.3, 1, 1.3), inward=False), "wood")
    crate = Piece(*box((3, 0, 1), (4, 1, 2), inward=False), "wood")
    seen = examined(room(), WrittenNode("post", (post,)), WrittenNode("crate", (crate,)))
    assert "post" in found(seen)["triangles that go through others"].nodes
    assert "crate" in found(seen)["triangles that lie on others, in part"].nodes
    assert not seen.problems


def test_seams_are_no_holes(examined):
    """A wall of one piece against a floor of two: their edges have no vertices in common."""
    vertices, triangles = box(without=(2, 8))  # the floor, of two triangles
    floor = np.array([(0, 0, 0), (2, 0, 0), (5, 0, 0), (0, 0, 4), (2, 0, 4), (5, 0, 4)], float)
    sides = np.array([(0, 4, 1), (0, 3, 4), (1, 5, 2), (1, 4, 5)])
    seen = examined(WrittenNode("room", (Piece(vertices, triangles, "x"), Piece(floor, sides, "y"))))
    assert not seen.holes
    assert found(seen)["edges at seams"].count == 6
    assert seen.drawn.escape.left == 0
    assert len(seen.rooms) == 1


def test_surfaces_that_branch_are_told(examined):
    sheet = Piece(
        np.array([(0, 0, 0), (5, 0, 0), (5, 0, -2), (0, 0, -2)], float), np.array([(0, 1, 2), (0, 2, 3)]), "x"
    )
    assert found(examined(room(), WrittenNode("sheet", (sheet,))))["edges of more than two triangles"].count == 1


def test_doors_part_rooms_and_are_kept_apart(examined):
    wall = [(2, 0, 0), (2, 2.6, 0), (2, 2.6, 4), (2, 0, 4), (2, 0, 1), (2, 2, 1), (2, 2, 2), (2, 0, 2)]
    around = [(0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5), (2, 3, 7), (2, 7, 6)]
    sheet = Piece(np.array(wall, float), np.array(around), "plasterboard")
    leaf = WrittenNode("door_a", (Piece(*box((1.98, 0, 1), (2.02, 2, 2), inward=False), "wooden door"),))
    seen = examined(room(), WrittenNode("wall", (sheet,)), leaf)
    assert sorted(each.volume_m3 for each in seen.rooms) == pytest.approx([2 * 2.6 * 4, 3 * 2.6 * 4], rel=0.03)
    assert len(seen.doors[0].triangles) == 12
    assert "wooden door" not in seen.mesh.materials


def test_merging_tells_its_bound(examined):
    fine = trimesh.Trimesh(*box(), process=False).subdivide().subdivide()
    seen = examined(WrittenNode("room", (Piece(np.asarray(fine.vertices), np.asarray(fine.faces), "x"),)))
    assert len(seen.mesh.triangles) == 12
    assert found(seen)["triangles that sound cannot tell apart"].count == 180
    assert seen.merged_bound_m < 1e-5
    assert seen.mesh.volume_m3 == pytest.approx(VOLUME_M3, rel=1e-5)
