import tomllib

import pytest

from tests.training.data.levels.conftest import box, empty, room
from training.data.levels.gltf_writer import Piece, WrittenNode
from training.data.levels.level_import import Choices, import_level
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile, SceneFileError

LEAF = Piece(*box((1, 0, 1), (1.9, 2, 1.04), inward=False), "wooden door")


@pytest.fixture
def imported(glb):
    odd = 'odd "name"\\ é'
    path = glb(
        room("plaster"),
        WrittenNode(f"door_{odd}", (LEAF,), {}, {"nafir_openness": 0.5, "nafir_mass_kg_m2": 12}),
        empty("emitter_radio", (4, 1.2, 1)),
        empty("listener_start", (2, 1.6, 3), {"nafir_yaw_deg": -45}),
        empty("spawn_a", (3, 1, 1)),
    )
    return import_level(path, Choices())


def test_what_is_written_is_read_again(imported, tmp_path):
    folder = tmp_path / "scene"
    imported.scene.write(folder, imported.comments)
    read = LevelScene.read(folder)
    assert read.file == imported.scene.file
    assert read.mesh.to_bytes() == imported.scene.mesh.to_bytes()
    assert [leaf.to_bytes() for leaf in read.doors] == [leaf.to_bytes() for leaf in imported.scene.doors]
    assert "# From table: plaster (Vorländer" in (folder / "scene.toml").read_text(encoding="utf-8")
    (door,) = read.file.geometry.doors
    assert (door.openness, door.surface_mass_kg_m2) == (0.5, 12)
    assert read.file.start.listener == (2, -3, 1.6)
    assert read.file.start.listener_yaw_deg == -45


def test_the_same_level_gives_the_same_bytes(imported, tmp_path):
    for name in ("one", "two"):
        imported.scene.write(tmp_path / name, imported.comments)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("[geometry.materials.plaster]", "[geometry.materials.clay]", "geometry.materials: 'plaster' is missing"),
        ('mesh = "geometry.npz"', 'mesh = "../geometry.npz"', "geometry.mesh"),
        ('mesh = "geometry.npz"', 'mesh = "other.npz"', "cannot be read"),
        ("openness = 0.5", "openness = nan", r"geometry\.doors\.0\.openness"),
        ("sample_rate", "rate", r"simulation\.sample_rate"),
        ("[air]", "[air", "not TOML"),
    ],
)
def test_folders_at_fault_are_refused_with_the_field(imported, tmp_path, old, new, complaint):
    imported.scene.write(tmp_path, imported.comments)
    path = tmp_path / "scene.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(SceneFileError, match=complaint):
        LevelScene.read(tmp_path)


def test_what_simulates_floor_plans_says_that_it_is_a_level(imported, tmp_path):
    imported.scene.write(tmp_path, imported.comments)
    assert tomllib.loads((tmp_path / "scene.toml").read_text(encoding="utf-8"))["geometry"]["mesh"] == "geometry.npz"
    with pytest.raises(SceneFileError, match=r"geometry\.mesh: .* takes a floor plan"):
        SceneFile.read(tmp_path / "scene.toml")


def test_places_are_found_where_none_are_named(glb):
    imported = import_level(glb(room("plaster")), Choices())
    start = imported.scene.file.start
    for x, y, z in (start.listener, start.emitter):
        assert 0.2 < x < 4.8
        assert -3.8 < y < -0.2
        assert 0.2 < z < 2.4
    assert start.listener != start.emitter
    assert len([note for note in imported.report.notes if note.startswith("there is no")]) == 2
