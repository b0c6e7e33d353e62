import importlib.util
from pathlib import Path

import numpy as np
import pytest
import trimesh

from server.acoustics.mesh_tree import MeshTree
from training.data.levels.gltf_writer import write_glb
from training.data.levels.import_options import PROBES
from training.data.levels.level_import import Choices, import_level

HOUSE = Path(__file__).parents[4] / "training/scenes/house"


@pytest.fixture(scope="module")
def make():
    spec = importlib.util.spec_from_file_location("make_house", HOUSE / "make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def imported():
    return import_level(HOUSE / "house.glb", Choices())


def test_the_file_is_what_the_script_writes(make, tmp_path):
    write_glb(tmp_path / "house.glb", make.house(), make.NOTICE)
    assert (tmp_path / "house.glb").read_bytes() == (HOUSE / "house.glb").read_bytes()


def test_it_has_what_it_promises(imported):
    report = imported.report
    assert not report.problems
    assert len(report.places["doors"]) == 4
    assert not report.examination.holes
    assert report.examination.drawn.escape.left == 0
    assert {finding.done for finding in report.examination.findings} <= {"welded", "merged"}


def test_its_rooms_are_parted_by_its_doors_and_hold_their_air(make, imported):
    """Six rooms, of which hall, landing and kitchen are joined: five closed ones."""
    rooms = imported.report.examination.rooms
    assert len(rooms) == 5

    def air_m3(*names):
        return sum(
            (room.x[1] - room.x[0]) * (room.y[1] - room.y[0]) * (room.z[1] - room.z[0])
            for room in make.ROOMS
            if room.name in names
        )

    (bath,) = [room for room in rooms if room.low_m[0] > 6 and room.low_m[2] > 2.8]
    assert bath.volume_m3 == pytest.approx(air_m3("bath"), rel=0.03)
    (living,) = [room for room in rooms if "spawn living" in room.names]
    assert 0.93 * air_m3("living") < living.volume_m3 < 1.01 * air_m3("living")
    total = sum(room.volume_m3 for room in rooms)
    assert total == pytest.approx(imported.scene.mesh.volume_m3, rel=0.015)


@pytest.mark.parametrize("is_open", [False, True])
def test_nothing_but_its_rooms_is_air(make, imported, is_open):
    """Not above the roof of its ground floor either, under the open sky or not."""
    points = np.random.default_rng(2).uniform((0, 0, 0), (10, 8, 5.4), (20_000, 3))
    air = np.zeros(len(points), np.bool_)
    for filled in (*make.ROOMS, *(door.doorway for door in make.DOORS), *make.FURNITURE, *make.HOLLOWS):
        low, high = np.array(filled.ends).T
        air[((points > low) & (points < high)).all(axis=1)] = isinstance(filled, make.Room)
    found = MeshTree(imported.scene.mesh).contains(points, is_open=is_open)
    np.testing.assert_array_equal(found, air)


def test_probes_stand_in_every_room_and_on_the_stairs(make, imported):
    probes = imported.scene.probe_positions(0)
    assert 0.85 * PROBES < len(probes) < 1.15 * PROBES
    for room in make.ROOMS[:2] + make.ROOMS[3:8]:
        ends = np.array(room.ends)
        assert ((probes > ends[:, 0]) & (probes < ends[:, 1])).all(axis=1).sum() > 3
    heights_m = probes[(probes[:, 0] > 5) & (probes[:, 0] < 6) & (probes[:, 1] > 3.25) & (probes[:, 1] < 6), 2]
    assert heights_m.min() < 2.6
    assert heights_m.max() > make.FLOOR_2_M + 1


def test_trimesh_finds_it_watertight_too():
    mesh = trimesh.load_scene(HOUSE / "house.glb")
    still = [
        mesh.geometry[name].copy().apply_transform(mesh.graph.get(node)[0])
        for node in mesh.graph.nodes_geometry
        for name in [mesh.graph[node][1]]
        if not node.startswith(("door_", "spawn_"))
    ]
    whole = trimesh.util.concatenate(still)
    whole.merge_vertices(merge_tex=True, merge_norm=True)
    assert whole.is_watertight
    assert whole.volume < 0  # its faces face the air inside
