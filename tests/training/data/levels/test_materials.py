import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.data.levels.level_source import LevelError
from training.data.levels.materials import MaterialMap, find, suggestions, table, unassigned_message, words_of


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("Mat_BrickWall_01", "brick"),
        ("wood_floor.001", "wood"),
        ("PaintedBrick", "brick-painted"),
        ("BRICK", "brick"),
        ("glassWindow", "glass"),
        ("Concrete_Block", "concrete-rough"),
        ("carpet-thick", "carpet-thick"),
        ("Shag Rug", "carpet-thick"),
        ("Bricc", None),
        ("Woodwind", None),
        ("MirrorGlass", None),  # glass and mirror fit equally well
        ("", None),
    ],
)
def test_names_mean_the_row_with_most_of_their_words(name, row):
    assert find(name) == row


def test_words_of_names():
    assert words_of("Mat_BrickWall.001") == ("mat", "brick", "wall", "001")
    assert words_of("PBRWood") == ("pbr", "wood")


def test_every_row_finds_itself_and_has_a_source():
    for name, row in table().items():
        assert find(name) == name
        assert row.source
        assert len(row.absorption) == len(row.scattering) == len(OCTAVE_BANDS_HZ)


def test_no_two_rows_answer_to_the_same_name():
    names = [tuple(sorted(words_of(each))) for row in table().values() for each in row.names]
    assert len(names) == len(set(names))


def test_near_names_are_suggested():
    assert suggestions("Bricc")[0].startswith("brick")
    assert suggestions("Carpte")[0].startswith("carpet")
    assert not suggestions("Qx")


def test_a_file_maps_what_the_table_does_not_know(tmp_path):
    path = tmp_path / "map.toml"
    bands = ", ".join(["0.5"] * 7)
    path.write_text(
        f'[materials]\nM_01 = "brick"\n"Odd Foam" = {{ absorption = [{bands}], scattering = [{bands}] }}\n'
        'M_02 = { like = "glass", surface_mass_kg_m2 = 30 }\nunused = "wood"\n'
    )
    mapping = MaterialMap.read(path, None)
    brick, foam, glass, known, nobody = mapping.assign(["M_01", "Odd Foam", "M_02", "Carpet", "M_03"])
    assert brick.material == table()["brick"].material
    assert foam.material.absorption == (0.5,) * 7
    assert glass.material.absorption == table()["glass"].absorption
    assert glass.material.surface_mass_kg_m2 == 30
    assert known.how == "table: carpet"
    assert nobody.material is None
    assert "'M_03'" in unassigned_message([nobody])
    assert mapping.unused(["M_01", "Odd Foam", "M_02"]) == ["unused"]


def test_a_default_serves_the_rest():
    (one,) = MaterialMap.read(None, "plaster").assign(["M_03"])
    assert one.how == "default: plaster"
    assert one.material == table()["plaster"].material


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('default = "brik"', "brik: is no row of the table; near: brick"),
        ('[materials]\na = "brik"', r"materials\.a: 'brik' is no row of the table; near: brick"),
        ("[materials]\na = { absorption = [0.5] }", "materials.a"),
        ("[materials]\na = { surface_mass_kg_m2 = 3 }", "materials.a: give absorption and scattering"),
        ("[materiels]", "materiels"),
        ("a = ", "is no TOML"),
    ],
)
def test_mapping_files_at_fault_are_refused_with_the_field(tmp_path, text, complaint):
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(LevelError, match=complaint):
        MaterialMap.read(path, None)
