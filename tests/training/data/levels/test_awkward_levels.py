"""Levels with every kind of fault: each is served with a report, or refused with a reason."""

import json
import re
import time

import numpy as np
import pytest
import trimesh

from tests.training.data.levels.conftest import box, empty, room
from training.data.levels.gltf_writer import Piece, WrittenNode, glb_bytes, gltf_of, write_glb
from training.data.levels.import_options import Units, Up
from training.data.levels.level_import import Choices, import_level, write_level
from training.data.levels.level_scene import LevelScene
from training.data.levels.level_source import LevelError

LONGEST_S = 60.0


def open_mesh(path):
    write_glb(path, [room(without=(2, 3, 8, 9))])


def self_intersecting(path):
    knot = trimesh.creation.icosphere(subdivisions=2, radius=1.5)
    write_glb(path, [room(), WrittenNode("knot", (Piece(knot.vertices * 1.0, knot.faces, "wood"),))])


def inside_out(path):
    write_glb(path, [room(inward=False)])


def non_manifold(path):
    fins = [WrittenNode(f"fin{n}", (Piece(*box((0, 0, 0), (5, 1, 1 + n), inward=False), "wood"),)) for n in range(3)]
    write_glb(path, [room(), *fins])


def nothing(path):
    write_glb(path, [empty("listener_start", (0, 0, 0))])


def no_number(path):
    vertices, triangles = box()
    vertices[3, 1] = np.nan
    write_glb(path, [WrittenNode("broken_room", (Piece(vertices, triangles, "plaster"),))])


def mirrored(path):
    inner = WrittenNode("inner", room().pieces, {"scale": [-1, 1, 1]})
    write_glb(path, [WrittenNode("outer", (), {"scale": [1, 1, -2], "translation": [3, 0, 0]}, {}, (inner,))])


def several_scenes(path):
    document, body = gltf_of([room(), WrittenNode("other", room("wood").pieces)])
    document["scenes"] = [{"nodes": [0]}, {"nodes": [1]}]
    path.write_bytes(glb_bytes(document, body))


def several_scenes_without_default(path):
    document, body = gltf_of([room()])
    document["scenes"] = [{"nodes": [0]}, {"nodes": [0]}]
    del document["scene"]
    path.write_bytes(glb_bytes(document, body))


def coplanar(path):
    vertices, triangles = box()
    both = np.concatenate([triangles, triangles[:, ::-1]])
    decal = Piece(np.array([(1, 0, 1), (2, 0, 1), (1, 0, 2)], float), np.array([(0, 2, 1)]), "carpet")
    write_glb(path, [WrittenNode("room", (Piece(vertices, both, "plaster"), decal))])


def far_uri(path):
    document, body = gltf_of([room()])
    document["buffers"][0]["uri"] = "/etc/hostname"
    path.write_bytes(glb_bytes(document, body))


def upward_uri(path):
    document, body = gltf_of([room()])
    document["buffers"][0]["uri"] = "../../elsewhere.bin"
    path.write_bytes(glb_bytes(document, body))


def draco(path):
    document, body = gltf_of([room()])
    document["extensionsUsed"] = document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
    path.write_bytes(glb_bytes(document, body))


def unknown_material(path):
    write_glb(path, [room("M_042")])


def two_doors(path):
    write_glb(path, [room(), *[WrittenNode("door_a", room().pieces)] * 2])


def centimetres(path):
    vertices, triangles = box(high=(50_000, 26_000, 40_000))
    write_glb(path, [WrittenNode("room", (Piece(vertices, triangles, "plaster"),))])


def one_triangle(path):
    write_glb(path, [WrittenNode("a", (Piece(np.eye(3) * 5, np.array([(0, 1, 2)]), "plaster"),))])


def no_area(path):
    write_glb(path, [WrittenNode("a", (Piece(np.outer(np.arange(4.0), (1, 1, 1)), np.array([(0, 1, 2)]), "x"),))])


REFUSED = {
    open_mesh: "the level leaks: .* close its holes",
    nothing: "there are none that stand still",
    no_number: "broken_room: .* no finite numbers",
    several_scenes_without_default: "name one by --scene",
    far_uri: "leads out of the level's folder",
    upward_uri: "leads out of the level's folder",
    draco: "KHR_draco_mesh_compression is Draco compression: export without it",
    unknown_material: "nobody knows 'M_042'",
    two_doors: "two nodes are the door 'a'",
    centimetres: "is its unit smaller",
    one_triangle: "the level leaks",
    no_area: "triangles: there are none with an area",
}
SERVED = {
    self_intersecting: "triangles that go through others",
    inside_out: "triangles that faced away from the air",
    non_manifold: "edges of more than two triangles",
    mirrored: None,
    several_scenes: None,
    coplanar: "triangles on each other, back to back",
}


def outcome(path, **choices):
    """The imported level and, if it was refused, why."""
    begin = time.process_time()
    try:
        imported = import_level(path, Choices(**choices))
    except LevelError as exc:
        return None, str(exc)
    assert time.process_time() - begin < LONGEST_S
    return imported, "; ".join(imported.report.problems)


@pytest.mark.parametrize("make", REFUSED, ids=lambda make: make.__name__)
def test_what_cannot_serve_is_refused_with_a_reason(tmp_path, make):
    path = tmp_path / "level.glb"
    make(path)
    imported, reason = outcome(path)
    assert imported is None or imported.scene is None
    assert re.search(REFUSED[make], reason), reason


@pytest.mark.parametrize("make", SERVED, ids=lambda make: make.__name__)
def test_what_can_serve_is_served_with_a_report(tmp_path, make):
    path = tmp_path / "level.glb"
    make(path)
    imported, reason = outcome(path)
    assert not reason
    assert imported.scene.mesh.volume_m3 > 0
    content = json.loads(json.dumps(imported.report.to_json()))
    assert content["served"]
    assert SERVED[make] is None or SERVED[make] in [finding["what"] for finding in content["findings"]]


def test_a_refused_level_is_drawn_and_no_scene_of_it_is_left(tmp_path):
    path, folder = tmp_path / "level.glb", tmp_path / "out"
    write_glb(path, [room()])
    write_level(import_level(path, Choices()), folder)
    assert LevelScene.read(folder).mesh.volume_m3 == pytest.approx(5 * 2.6 * 4)
    (folder / "door0.npz").write_bytes(b"of an import before")
    open_mesh(path)
    imported, reason = outcome(path)
    write_level(imported, folder)
    assert sorted(each.name for each in folder.iterdir()) == ["report.json", "report.png"]
    assert json.loads((folder / "report.json").read_text())["problems"] == [reason]


def test_an_obj_is_asked_for_its_unit_and_axis(tmp_path):
    path = tmp_path / "level.obj"
    vertices, triangles = box(high=(500, 260, 400))
    trimesh.Trimesh(vertices, triangles, process=False).export(path)
    assert "--units and --up: OBJ does not say" in outcome(path)[1]
    assert "--up: OBJ does not say" in outcome(path, units=Units.CM)[1]
    imported, reason = outcome(path, units=Units.CM, up=Up.Y, default_material="plaster")
    assert not reason
    assert imported.scene.mesh.volume_m3 == pytest.approx(5 * 2.6 * 4)
    assert any("right-handed" in note for note in imported.report.notes)
    assert "is its unit smaller" in outcome(path, units=Units.M, up=Up.Y, default_material="plaster")[1]


def test_a_unit_against_the_specification_is_told(tmp_path):
    path = tmp_path / "level.glb"
    vertices, triangles = box(high=(500, 260, 400))
    write_glb(path, [WrittenNode("room", (Piece(vertices, triangles, "plaster"),))])
    imported, reason = outcome(path, units=Units.CM)
    assert not reason
    assert "read against the specification of glTF: --units cm" in imported.report.notes


@pytest.mark.long
def test_a_million_triangles_are_served_within_a_minute(tmp_path):
    path = tmp_path / "level.glb"
    mesh = trimesh.Trimesh(*box(), process=False)
    for _ in range(8):
        mesh = mesh.subdivide()
    vertices = np.asarray(mesh.vertices)
    assert len(mesh.faces) == 786_432
    crumpled = vertices + np.random.default_rng(0).normal(0, 5e-4, vertices.shape)
    write_glb(path, [WrittenNode("room", (Piece(crumpled, np.asarray(mesh.faces), "plaster"),))])
    imported, reason = outcome(path)
    assert not reason
    assert imported.scene.mesh.volume_m3 == pytest.approx(5 * 2.6 * 4, rel=0.01)


def test_what_stands_outside_of_a_closed_level_is_told(tmp_path):
    path = tmp_path / "level.glb"
    write_glb(path, [room(), empty("emitter_near", (1, 1, 1)), empty("emitter_far", (20, 1, 1))])
    imported, reason = outcome(path)
    assert not reason
    told = [note for note in imported.report.notes if "outside of all closed rooms" in note]
    assert told == [
        "emitter far at (20, -1, 1) is outside of all closed rooms: move it in, or say --open if the level has open sky"
    ]
    under_the_sky, _ = outcome(path, is_open=True)
    assert not any("outside of all closed rooms" in note for note in under_the_sky.report.notes)
