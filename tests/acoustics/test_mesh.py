"""Triangle meshes against solids of known area and volume; bad arrays and files are refused by name."""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest

from server.acoustics.geometry import FARTHEST_M
from server.acoustics.mesh import LONGEST_NAME, MeshError, TriangleMesh

# A box with its normals pointing inwards: two triangles for each of -x, +x, -y, +y, -z, +z.
QUADS = ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))


def box(size=(2.0, 3.0, 4.0), origin=(0.0, 0.0, 0.0)):
    corners = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    triangles = [(q[0], q[a], q[a + 1]) for q in QUADS for a in (1, 2)]
    surfaces = np.repeat([0, 0, 0, 0, 1, 2], 2)
    return TriangleMesh(corners * size + origin, np.array(triangles), surfaces, ("walls", "floor", "ceiling"))


def with_arrays(**changed):
    given = {name: getattr(box(), name) for name in ("vertices_m", "triangles", "surfaces", "materials")}
    return TriangleMesh(**(given | changed))


def test_a_box_has_the_area_and_volume_of_a_box():
    mesh = box()
    assert mesh.areas_m2.sum() == pytest.approx(2 * (6 + 8 + 12))
    assert mesh.volume_m3 == pytest.approx(24)
    np.testing.assert_array_equal(mesh.bounds_m, [(0, 0, 0), (2, 3, 4)])


def test_volume_does_not_depend_on_where_the_mesh_is():
    assert box(origin=(1e6, -1e6, 1e5)).volume_m3 == pytest.approx(24, rel=1e-9)


def test_normals_point_into_the_air_and_volume_is_negative_if_they_do_not():
    mesh = box()
    to_middle = np.array([1, 1.5, 2]) - mesh.corners_m.mean(axis=1)
    assert np.all(np.sum(mesh.normals * to_middle, axis=-1) > 0)
    flipped = with_arrays(triangles=mesh.triangles[:, ::-1])
    np.testing.assert_array_equal(flipped.normals, -mesh.normals)
    assert flipped.volume_m3 == pytest.approx(-24)


def test_normals_of_minute_triangles_are_unit_vectors_and_of_degenerate_ones_zero():
    vertices = np.array([(0, 0, 0), (1e-150, 0, 0), (0, 1e-150, 0), (1, 1, 1)], dtype=float)
    mesh = TriangleMesh(vertices, [(0, 1, 2), (0, 3, 3)], [0, 0], ("wall",))
    np.testing.assert_allclose(mesh.normals, [(0, 0, 1), (0, 0, 0)])


def test_arrays_are_copies_that_nobody_can_change():
    vertices = np.array(box().vertices_m)
    mesh = with_arrays(vertices_m=vertices)
    vertices[:] = 7
    assert mesh.vertices_m.max() == 4
    for name in ("vertices_m", "triangles", "surfaces", "normals", "areas_m2", "corners_m", "bounds_m"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(mesh, name)[0] = 0


def test_unused_vertices_do_not_count_into_the_bounds():
    mesh = with_arrays(vertices_m=np.concatenate([box().vertices_m, [(99, 99, 99)]]))
    np.testing.assert_array_equal(mesh.bounds_m[1], (2, 3, 4))


def test_part_of_a_mesh_keeps_its_materials():
    mesh = box()
    floor = mesh.only(mesh.surfaces == mesh.materials.index("floor"))
    assert floor.areas_m2.sum() == pytest.approx(6)
    with pytest.raises(MeshError, match="triangles: give at least one"):
        mesh.only(np.zeros(12, bool))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("vertices_m", np.zeros((8, 2)), r"vertices_m: give an array \(vertex, 3\), not \(8, 2\)"),
        ("vertices_m", [["a", "b", "c"]], "vertices_m: .*numbers"),
        ("vertices_m", np.where(np.arange(24).reshape(8, 3) == 4, np.nan, 1.0), "vertex 1 is at .*finite"),
        ("vertices_m", np.full((8, 3), -np.inf), "vertex 0 .*one of 8"),
        ("vertices_m", np.full((8, 3), 2 * FARTHEST_M), "within 1e[+]07 m"),
        ("triangles", np.zeros((0, 3), int), "triangles: give at least one"),
        ("triangles", np.zeros((12, 4), int), r"triangles: give an array \(triangle, 3\), not \(12, 4\)"),
        ("triangles", np.zeros((12, 3)), "triangles: give integers, not float64"),
        ("triangles", np.full((12, 3), 8), r"row 0 is \[8, 8, 8\].*from 0 to 7"),
        ("triangles", np.full((12, 3), -1), "from 0 to 7"),
        ("triangles", np.full((12, 3), 2**32), "from 0 to 7"),
        ("surfaces", np.zeros(11, int), r"surfaces: give an array \(12,\), not \(11,\)"),
        ("surfaces", np.full(12, 3), "materials has 3"),
        ("materials", (), "materials: give from 1"),
        ("materials", "walls", "materials: give a tuple"),
        ("materials", ("a", "b", "a"), "'a' is there twice"),
        ("materials", ("a", "b", ""), "name 2"),
        ("materials", ("a", "b", "x" * (LONGEST_NAME + 1)), "name 2 must have"),
    ],
)
def test_bad_arrays_are_refused_by_name(field, value, message):
    with pytest.raises(MeshError, match=message):
        with_arrays(**{field: value})


def test_a_saved_mesh_is_read_back_to_the_bit_and_written_the_same(tmp_path):
    mesh = with_arrays(materials=("Wände", "floor", "天井"), vertices_m=box().vertices_m / 3)
    mesh.save(tmp_path / "mesh.npz")
    read = TriangleMesh.load(tmp_path / "mesh.npz")
    assert TriangleMesh.from_bytes(mesh.to_bytes()).materials == mesh.materials
    for name in ("vertices_m", "triangles", "surfaces"):
        np.testing.assert_array_equal(getattr(read, name), getattr(mesh, name))
    assert read.materials == mesh.materials
    read.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "mesh.npz").read_bytes()


def npz(path, **arrays):
    np.savez(path, **arrays)
    return path


def arrays():
    mesh = box()
    return {
        "vertices_m": mesh.vertices_m,
        "triangles": mesh.triangles,
        "surfaces": mesh.surfaces,
        "materials": np.array(mesh.materials),
    }


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"vertices_m": np.array([{}], dtype=object)}, "vertices_m: .*not numbers|vertices_m: has a header"),
        ({"vertices_m": np.zeros((8, 3), np.float32)}, "vertices_m: holds float32"),
        ({"triangles": np.zeros((12, 3), np.int64)}, "triangles: holds int64"),
        ({"triangles": np.zeros((12, 300), np.int32)}, "triangles: must be an array of at most three columns|not"),
        ({"materials": np.array(["x" * 200])}, "materials: holds"),
        ({"vertices_m": np.full((8, 3), np.nan)}, "vertices_m: vertex 0"),
    ],
)
def test_files_with_bad_arrays_are_refused_by_name(tmp_path, changed, message):
    path = npz(tmp_path / "mesh.npz", **(arrays() | changed))
    with pytest.raises(MeshError, match=message) as raised:
        TriangleMesh.load(path)
    assert str(path) in str(raised.value)


def test_files_that_lack_an_array_or_are_no_archive_are_refused(tmp_path):
    path = npz(tmp_path / "mesh.npz", **{name: array for name, array in arrays().items() if name != "surfaces"})
    with pytest.raises(MeshError, match="surfaces: is missing"):
        TriangleMesh.load(path)
    whole = npz(tmp_path / "whole.npz", **arrays()).read_bytes()
    for content in (b"", b"PK\3\4", whole[: len(whole) // 2], bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(MeshError, match="no readable"):
            TriangleMesh.load(path)


def test_limits_hold_before_memory_is_taken(tmp_path):
    box().save(tmp_path / "mesh.npz")
    with pytest.raises(MeshError, match="triangles: has 12 rows, and may have 11"):
        TriangleMesh.load(tmp_path / "mesh.npz", most_triangles=11)
    with pytest.raises(MeshError, match="vertices_m: has 8 rows, and may have 7"):
        TriangleMesh.load(tmp_path / "mesh.npz", most_vertices=7)
    # A header that claims a terabyte, with nothing behind it.
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (2_000_000, 60_000)})
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive:
        archive.writestr("vertices_m.npy", header.getvalue())
        for name in ("triangles", "surfaces", "materials"):
            archive.writestr(f"{name}.npy", b"")
    with pytest.raises(MeshError, match="at most three columns"):
        TriangleMesh.load(tmp_path / "bomb.npz")


def test_archives_of_other_methods_and_with_more_in_them_are_refused_before_memory_is_taken():
    with zipfile.ZipFile(io.BytesIO(box().to_bytes())) as whole:
        files = {name: whole.read(name) for name in whole.namelist()}
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_BZIP2) as archive:
        for name, content in files.items():
            archive.writestr(name, content + bytes(100_000_000 if name == "vertices_m.npy" else 0))
    assert len(bomb.getvalue()) < 10_000
    tracemalloc.start()
    try:
        with pytest.raises(MeshError, match="vertices_m: is packed by a method"):
            TriangleMesh.from_bytes(bomb.getvalue())
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()
    more = io.BytesIO(box().to_bytes())
    with zipfile.ZipFile(more, "a") as archive:
        archive.writestr("more.npy", b"")
    with pytest.raises(MeshError, match=r"others beside it, 'more\.npy'"):
        TriangleMesh.from_bytes(more.getvalue())


def test_a_damaged_archive_is_the_same_mesh_or_a_mesh_error():
    mesh = box()
    whole, rng = mesh.to_bytes(), np.random.default_rng(5)
    refused = 0
    for _ in range(2_000):
        data = bytearray(whole)
        for at in rng.integers(len(whole), size=rng.integers(1, 4)):
            data[at] ^= rng.integers(1, 256)
        try:
            read = TriangleMesh.from_bytes(bytes(data))
        except MeshError:
            refused += 1
        else:
            np.testing.assert_array_equal(read.corners_m, mesh.corners_m)
            assert read.materials == mesh.materials
    assert refused > 1_000


@pytest.mark.parametrize("code", [0x110000, 0xFFFFFFFF])
def test_names_of_characters_that_do_not_exist_are_refused(tmp_path, code):
    names = np.frombuffer(np.array([code], "<u4").tobytes(), "<U1")
    with pytest.raises(MeshError, match="materials: holds no text"):
        TriangleMesh.load(npz(tmp_path / "mesh.npz", **(arrays() | {"materials": names})))
