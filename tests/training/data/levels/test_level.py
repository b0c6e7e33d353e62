import importlib.util
import re
import time
from pathlib import Path

import numpy as np
import pytest

from tests.training.data.levels.conftest import box, empty, room
from training.data.levels.gltf_file import read_gltf
from training.data.levels.gltf_writer import Piece, WrittenNode
from training.data.levels.import_options import Handedness, Units, Up
from training.data.levels.level import GLTF_AXES, Axes, level_of
from training.data.levels.level_source import LevelError, LevelSource, Node, Part

ROOT = Path(__file__).parents[4]
PAGE = ROOT / "docs/how-to/bring-your-own-level.md"
_ROW = re.compile(r"^\| (\w+)[^|]* \| `--units (\w+) --up (\w)(?: --handedness (\w+))?` \|$", re.MULTILINE)
ENGINE_AXES = {
    engine.lower(): Axes(Up(up), Handedness(hand or "right"), Units(units))
    for engine, units, up, hand in _ROW.findall(PAGE.read_text(encoding="utf-8"))
}
"""The table of the page: options for files in an engine's own axes."""


def read(path):
    return level_of(path, read_gltf(path), GLTF_AXES)


@pytest.mark.parametrize("engine", ["unity", "godot", "unreal"])
def test_the_options_of_the_page_are_the_axes_of_the_engines_clients(engine):
    path = ROOT / "client_examples/vectors/make.py"
    spec = importlib.util.spec_from_file_location("vectors_make", path)
    make = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make)
    theirs = make.ENGINES[engine]
    np.testing.assert_allclose(ENGINE_AXES[engine].to_world, theirs.to_world / theirs.units_per_m)


def test_up_in_a_gltf_is_up_here_and_its_minus_z_is_north(glb):
    corners = read(glb(room())).surfaces.corners_m.reshape(-1, 3)
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [(0, -4, 0), (5, 0, 2.6)], atol=1e-6)


def test_nodes_become_entries_by_name_and_by_property(glb):
    leaf = Piece(*box((0, 0, 0), (0.9, 2, 0.04), inward=False), "wood")
    level = read(
        glb(
            room(),
            WrittenNode("door_kitchen", (leaf,), {"translation": [1, 0, 2]}, {"nafir_angle_deg": -80}),
            WrittenNode("Cube", (leaf,), {}, {"nafir_role": "door", "nafir_name": "gate", "nafir_kind": "slide"}),
            empty("emitter_radio", (1, 1.2, 1)),
            empty("listener_start", (2, 1.6, 2), {"nafir_yaw_deg": 30}),
            WrittenNode("spawn_hall", (Piece(*box((1, 0, 1), (3, 2, 2)), "x"),)),
            empty("spawn_spot", (1, 1, 1)),
        )
    )
    assert [(door.name, door.kind, door.angle_deg) for door in level.doors] == [
        ("kitchen", "swing", -80),
        ("gate", "slide", 90),
    ]
    np.testing.assert_allclose(level.doors[0].pivot, (1, -2, 0))
    np.testing.assert_allclose(level.doors[1].slide_m, (0.9, 0, 0), atol=1e-6)
    ((name, place),) = level.emitters
    assert name == "radio"
    np.testing.assert_allclose(place, (1, -1, 1.2))
    np.testing.assert_allclose(level.listener[0], (2, -2, 1.6))
    assert level.listener[1] == 30
    np.testing.assert_allclose((level.spawns[0].low, level.spawns[0].high), [(1, -2, 0), (3, -1, 2)], atol=1e-6)
    assert level.spawns[1].low == level.spawns[1].high
    assert len(level.surfaces.triangles) == 12  # those of the room alone stand still


def test_the_start_looks_where_its_node_looks(glb):
    turned = WrittenNode("listener_start", (), {"rotation": [0, np.sqrt(0.5), 0, np.sqrt(0.5)]})
    # A node looks along -z, which is north here; a quarter turn to the left is west.
    assert read(glb(room(), empty("listener_start", (0, 0, 0)))).listener[1] == pytest.approx(90)
    assert abs(read(glb(room(), turned)).listener[1]) == pytest.approx(180)


def test_what_hangs_below_a_door_moves_with_it(glb):
    handle = WrittenNode("handle", (Piece(*box((0.8, 1, 0), (0.9, 1.1, 0.1)), "metal"),))
    leaf = Piece(*box((0, 0, 0), (0.9, 2, 0.04)), "wood")
    level = read(glb(room(), WrittenNode("door_a", (leaf,), {}, {}, (handle,))))
    assert len(level.doors[0].surfaces.triangles) == 24


def test_a_property_names_the_material_of_all_below_it(glb):
    child = WrittenNode("child", (Piece(*box(), "M_012"),))
    assert read(glb(WrittenNode("a", (), {}, {"nafir_material": "brick"}, (child,)))).material_names == ("brick",)


@pytest.mark.parametrize(
    ("nodes", "complaint"),
    [
        ([WrittenNode("door_a", (Piece(*box(), "x"),))] * 2, "two nodes are the door 'a'"),
        (
            [empty("emitter_a", (0, 0, 0)), empty("x", (0, 0, 0), {"nafir_role": "emitter", "nafir_name": "a"})],
            "two nodes",
        ),
        ([empty("listener_start", (0, 0, 0)), empty("Listener_Start", (1, 0, 0))], "two nodes are the listener_start"),
        ([empty("door_a", (0, 0, 0))], "this door has no triangles"),
        ([empty("door_", (0, 0, 0))], "this door has no name"),
        ([empty("emitter_a", (0, 0, 0), {"nafir_opennes": 1})], "nafir_opennes: .*nafir_openness"),
        ([empty("emitter_a", (0, 0, 0), {"nafir_openness": 1.0000001})], "nafir_openness"),
        ([empty("emitter_a", (0, 0, 0), {"nafir_openness": float("nan")})], "nafir_openness"),
        ([WrittenNode("door_a", (Piece(*box(), "x"),), {}, {}, (empty("emitter_b", (0, 0, 0)),))], "has a role too"),
    ],
)
def test_names_and_properties_that_cannot_be_meant_are_refused(glb, nodes, complaint):
    with pytest.raises(LevelError, match=complaint):
        read(glb(room(), *nodes))


def test_thousands_of_emitters_with_triangles_take_no_longer_each():
    triangle = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], dtype=float), np.array([(0, 1, 2)])
    count = 15_000
    nodes = tuple(Node(f"emitter_{number}", np.eye(4)) for number in range(count))
    parts = tuple(Part(number, *triangle, "plaster") for number in range(count))
    begin = time.process_time()
    level = level_of(Path("level.glb"), LevelSource("glTF", nodes, parts, ()), GLTF_AXES)
    assert time.process_time() - begin < 2
    assert len(level.emitters) == count
    assert len(level.surfaces.triangles) == 0
