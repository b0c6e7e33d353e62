import base64
import json
import struct

import numpy as np
import pytest
import trimesh

from tests.training.data.levels.conftest import box, room
from training.data.levels.gltf_file import read_gltf
from training.data.levels.gltf_writer import Piece, WrittenNode, glb_bytes, gltf_of
from training.data.levels.level_source import LevelError


def nested(scale):
    """A box three nodes deep: moved, turned and scaled at each."""
    inner = WrittenNode("inner", (Piece(*box(), "brick"),), {"scale": list(scale), "translation": [1, 2, 3]})
    middle = WrittenNode("middle", (), {"rotation": [0, 0.6, 0, 0.8]}, {}, (inner,))
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag((1.0, 1.0, -2.0))
    matrix[:3, 3] = (0.5, 0.0, -4.0)
    return WrittenNode("outer", (), {"matrix": matrix.T.ravel().tolist()}, {}, (middle,))


@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 2, 1), (-1, -2, -3)])
def test_transforms_are_what_trimesh_makes_of_them(glb, scale):
    path = glb(nested(scale))
    (part,) = read_gltf(path).parts
    theirs = trimesh.load_scene(path).to_mesh()
    corners = part.vertices[part.triangles]
    np.testing.assert_allclose(
        np.sort(corners.mean(axis=1), axis=0), np.sort(theirs.triangles_center, axis=0), rtol=0, atol=1e-5
    )
    volume = trimesh.Trimesh(part.vertices, part.triangles, process=False).volume
    assert volume == pytest.approx(-5 * 2.6 * 4 * 2 * abs(np.prod(scale)), rel=1e-5)  # its faces still face inwards


def test_nodes_have_their_names_parents_and_properties(glb):
    child = WrittenNode("child", (Piece(*box(), "wood"),), {}, {"nafir_role": "door", "other": 3})
    source = read_gltf(glb(WrittenNode("parent", (), {}, {}, (child,)), room()))
    assert [(node.name, node.parent) for node in source.nodes] == [("parent", -1), ("child", 0), ("room", -1)]
    assert source.nodes[1].extras == {"nafir_role": "door", "other": 3}
    assert [(part.node, part.material) for part in source.parts] == [(1, "wood"), (2, "plaster")]


def test_data_uris_and_files_beside_the_level_are_read(tmp_path):
    document, body = gltf_of([room()])
    expected = read_gltf(write(tmp_path / "a.glb", glb_bytes(document, body))).parts[0]
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    embedded = read_gltf(write(tmp_path / "b.gltf", json.dumps(document).encode())).parts[0]
    (tmp_path / "with space").mkdir()
    (tmp_path / "with space" / "c.bin").write_bytes(body)
    document["buffers"][0]["uri"] = "with%20space/c.bin"
    beside = read_gltf(write(tmp_path / "c.gltf", json.dumps(document).encode())).parts[0]
    for part in (embedded, beside):
        np.testing.assert_array_equal(part.vertices, expected.vertices)
        np.testing.assert_array_equal(part.triangles, expected.triangles)


@pytest.mark.parametrize(
    "uri",
    ["../secret.bin", "/etc/passwd", "a/../../secret.bin", "%2e%2e/secret.bin", "file:///etc/passwd", "C:/x.bin",
     "http://localhost/x.bin", "..\\secret.bin", "link.bin", ""],
)  # fmt: skip
def test_nothing_outside_of_the_folder_is_read(tmp_path, uri):
    document, body = gltf_of([room()])
    (tmp_path / "secret.bin").write_bytes(body)
    folder = tmp_path / "level"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    document["buffers"][0]["uri"] = uri
    with pytest.raises(LevelError, match=r"buffers\.0\.uri: .*folder"):
        read_gltf(write(folder / "level.gltf", json.dumps(document).encode()))


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"])
@pytest.mark.parametrize("where", ["extensionsUsed", "extensionsRequired"])
def test_extensions_that_move_triangles_are_refused_by_name(tmp_path, name, where):
    document, body = gltf_of([room()])
    document[where] = [name]
    with pytest.raises(LevelError, match=name):
        read_gltf(write(tmp_path / "level.glb", glb_bytes(document, body)))


def test_a_scene_is_chosen_by_name_and_asked_for_where_none_is_the_default(tmp_path):
    document, body = gltf_of([room(), WrittenNode("other", (Piece(*box(), "wood"),))])
    document["scenes"] = [{"name": "day", "nodes": [0]}, {"name": "night", "nodes": [1]}]
    path = write(tmp_path / "level.glb", glb_bytes(document, body))
    assert read_gltf(path).parts[0].material == "plaster"
    assert "night" in read_gltf(path).notes[0]
    assert read_gltf(path, "night").parts[0].material == "wood"
    with pytest.raises(LevelError, match="--scene: 'noon' is no scene"):
        read_gltf(path, "noon")
    del document["scene"]
    with pytest.raises(LevelError, match=r"--scene: \['day', 'night'\]"):
        read_gltf(write(path, glb_bytes(document, body)))


def test_what_is_left_out_is_told(tmp_path):
    document, body = gltf_of([room()])
    document |= {"textures": [{}], "skins": [{"joints": [0]}], "animations": [{}], "cameras": [{}]}
    lines = dict(document["meshes"][0]["primitives"][0], mode=1)
    document["meshes"][0]["primitives"].append(lines)
    notes = "\n".join(read_gltf(write(tmp_path / "level.glb", glb_bytes(document, body))).notes)
    for word in ("textures", "skins", "animations", "cameras", "lines"):
        assert word in notes


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans_are_the_triangles_they_stand_for(tmp_path, mode):
    square = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], float) if mode == 5 else SQUARE
    document, body = gltf_of([WrittenNode("a", (Piece(square, np.arange(4)[None], "x"),))])
    document["meshes"][0]["primitives"][0]["mode"] = mode
    (part,) = read_gltf(write(tmp_path / "level.glb", glb_bytes(document, body))).parts
    sides = np.diff(part.vertices[part.triangles], axis=1)
    np.testing.assert_allclose(np.cross(sides[:, 0], sides[:, 1])[:, 2], [1, 1])


SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)


def spoil(document, *keys, value):
    for key in keys[:-1]:
        document = document[key]
    document[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value", "place"),
    [
        (("accessors", 0, "count"), 10**12, r"accessors\.0"),
        (("accessors", 0, "count"), -1, r"accessors\.0"),
        (("accessors", 0, "byteOffset"), 10**6, r"accessors\.0"),
        (("accessors", 0, "sparse"), {"count": 1}, "sparse"),
        (("bufferViews", 0, "byteLength"), 10**6, r"bufferViews\.0"),
        (("bufferViews", 0, "buffer"), 7, r"bufferViews\.0"),
        (("bufferViews", 0, "byteStride"), 1, r"accessors\.0"),
        (("nodes", 0, "children"), [0], r"nodes\.0: is the child of two nodes, or of itself"),
        (("nodes", 0, "scale"), [float("nan"), 1, 1], r"nodes\.0\.scale"),
        (("nodes", 0, "rotation"), [0, 0, 0, 0], r"nodes\.0\.rotation"),
        (("nodes", 0, "mesh"), 99, r"nodes\.0\.mesh"),
        (("scenes",), [], "scenes"),
        (("scenes", 0, "nodes"), ["x"], "scenes"),
        (("nodes",), {}, "nodes"),
        (("meshes", 0, "primitives", 0, "indices"), 0, r"accessors\.0"),
        (("meshes", 0, "primitives", 0, "extensions"), 5, r"meshes\.0\.primitives\.0\.extensions"),
        (("asset", "version"), "1.0", r"asset\.version"),
        (("extensionsRequired",), ["XYZ_shape"], "XYZ_shape"),
    ],
)
def test_documents_that_lie_are_refused_with_the_place(tmp_path, keys, value, place):
    document, body = gltf_of([room()])
    spoil(document, *keys, value=value)
    with pytest.raises(LevelError, match=place):
        read_gltf(write(tmp_path / "level.glb", glb_bytes(document, body)))


def test_indices_beyond_the_vertices_are_refused(tmp_path):
    vertices, triangles = box()
    document, body = gltf_of([WrittenNode("a", (Piece(vertices, triangles + 1, "x"),))])
    with pytest.raises(LevelError, match="8 is beyond the 8 vertices"):
        read_gltf(write(tmp_path / "level.glb", glb_bytes(document, body)))


def test_every_truncation_is_refused_or_read_whole(tmp_path):
    document, body = gltf_of([room()])
    whole = glb_bytes(document, body)
    for length in range(0, len(whole), 7):
        with pytest.raises(LevelError):
            read_gltf(write(tmp_path / "level.glb", whole[:length]))


def test_damaged_bytes_never_crash(tmp_path):
    document, body = gltf_of([room(), nested((1, 1, 1))])
    whole = glb_bytes(document, body)
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), rng.integers(1, 6)):
            damaged[at] = rng.integers(0, 256)
        try:
            read_gltf(write(tmp_path / "level.glb", bytes(damaged)))
        except LevelError:
            continue


def test_many_instances_of_a_mesh_count_each(tmp_path, monkeypatch):
    monkeypatch.setattr("training.data.levels.level_source.MOST_TRIANGLES", 100)
    document, body = gltf_of([room()])
    document["nodes"] = [dict(document["nodes"][0]) for _ in range(9)]
    document["scenes"] = [{"nodes": list(range(9))}]
    with pytest.raises(LevelError, match="triangles: 108, and at most 100"):
        read_gltf(write(tmp_path / "level.glb", glb_bytes(document, body)))


def test_a_glb_says_its_own_length(tmp_path):
    document, body = gltf_of([room()])
    whole = bytearray(glb_bytes(document, body))
    struct.pack_into("<I", whole, 8, len(whole) + 4)
    with pytest.raises(LevelError, match="cut short"):
        read_gltf(write(tmp_path / "level.glb", bytes(whole)))


def write(path, data):
    path.write_bytes(data)
    return path


def test_vertices_that_no_triangle_has_are_left_out(glb):
    """Every use of a mesh holds its vertices, so a few hundred kilobytes could fill the memory."""
    vertices, triangles = box()
    many = np.concatenate([vertices, np.zeros((1000, 3))])
    path = glb(WrittenNode("a", (Piece(many, triangles, "brick"),)))
    assert len(read_gltf(path).parts[0].vertices) == len(vertices)


def test_places_that_grow_beyond_all_numbers_are_refused(glb):
    inner = WrittenNode("emitter_a", (), {"translation": [1e200, 0, 0]})
    with pytest.raises(LevelError, match="no finite numbers"):
        read_gltf(glb(WrittenNode("outer", (), {"scale": [1e200] * 3}, {}, (inner,)), room()))


def test_a_file_whose_name_is_too_long_is_told(tmp_path):
    document, _ = gltf_of([room()])
    document["buffers"][0]["uri"] = "a" * 5000
    with pytest.raises(LevelError, match="cannot be looked for"):
        read_gltf(write(tmp_path / "a.gltf", json.dumps(document).encode()))
