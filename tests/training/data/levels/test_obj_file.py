import numpy as np
import pytest
import trimesh

from tests.training.data.levels.conftest import box
from training.data.levels.import_options import Handedness, Units, Up
from training.data.levels.level import Axes, level_of
from training.data.levels.level_source import LevelError
from training.data.levels.obj_file import read_obj


def obj(tmp_path, text):
    path = tmp_path / "level.obj"
    path.write_text(text)
    return path


def test_names_of_objects_and_materials_are_kept_without_the_material_file(tmp_path):
    text = "mtllib ../../elsewhere.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\no door_a\nusemtl Old Wood\nf 1 2 3 4\n"
    source = read_obj(obj(tmp_path, text + "usemtl glass\nf 1//7 2//7 3//7\no b\nf -4 -3 -1\n"))
    assert [node.name for node in source.nodes] == ["door_a", "b"]
    assert [(part.node, part.material, len(part.triangles)) for part in source.parts] == [
        (0, "Old Wood", 2),
        (0, "glass", 1),
        (1, "glass", 1),
    ]
    np.testing.assert_array_equal(
        source.parts[2].vertices[source.parts[2].triangles][0], [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    )
    assert "left out: the looks of materials (.mtl)" in source.notes


def test_triangles_are_what_trimesh_reads(tmp_path):
    path = tmp_path / "level.obj"
    trimesh.Trimesh(*box(), process=False).export(path)
    (part,) = read_obj(path).parts
    theirs = trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(
        np.sort(part.vertices[part.triangles].mean(axis=1), axis=0), np.sort(theirs.triangles_center, axis=0)
    )
    assert trimesh.Trimesh(part.vertices, part.triangles).volume == pytest.approx(theirs.volume)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("v 0 0\n", "line 1: a vertex has three coordinates"),
        ("v 0 0 x\n", "line 1: could not convert"),
        ("v 0 0 0\nf 1 2 3\n", "line 2: vertex 2 is none of the 1 so far"),
        ("v 0 0 0\nf 1 1\n", "line 2: a face has three corners"),
        ("v 0 0 0\nf 0 1 1\n", "line 2: vertex 0"),
        ("cstype bezier\n", "line 1: curves"),
    ],
)
def test_faults_are_told_with_their_line(tmp_path, text, complaint):
    with pytest.raises(LevelError, match=complaint):
        read_obj(obj(tmp_path, text))


def test_an_object_is_in_the_middle_of_its_vertices(tmp_path):
    """An OBJ file places none. A door's hinge is not there, so it is asked for in another format."""
    floor = "o floor\nv 0 0 0\nv 4 0 0\nv 0 4 0\nf 1 2 3\n"
    radio = "o emitter_radio\nv 3 3 1\nv 3.2 3 1\nv 3 3.2 1\nf 4 5 6\n"
    axes = Axes(Up.Z, Handedness.RIGHT, Units.M)
    path = obj(tmp_path, floor + radio)
    ((name, position),) = level_of(path, read_obj(path), axes).emitters
    assert (name, position) == ("radio", pytest.approx((3.1, 3.1, 1.0)))
    path = obj(tmp_path, floor + radio.replace("emitter_radio", "door_hall"))
    with pytest.raises(LevelError, match="hinge"):
        level_of(path, read_obj(path), axes)
