import numpy as np
import pytest

from tests.training.data.levels.conftest import box, room
from training.data.levels.gltf_writer import Piece, WrittenNode
from training.data.levels.level_import import Choices, import_level
from training.data.levels.mesh_figure import figure_of, section, storeys_of


def test_a_section_is_as_long_as_the_walls_it_cuts():
    vertices, triangles = box((0, 0, 0), (5, 4, 2.6))  # z is up here
    lines = section(vertices[triangles], 1.3)
    assert np.linalg.norm(lines[:, 0] - lines[:, 1], axis=1).sum() == pytest.approx(2 * (5 + 4))
    assert not len(section(vertices[triangles], 3.0))


def test_storeys_are_floors_a_storey_apart_and_tables_are_none(glb):
    table = Piece(*box((0.5, 0.3, 0.5), (4.5, 1.0, 3.5), inward=False), "wood")
    upper = Piece(*box((0, 2.9, 0), (5, 5.5, 4)), "plaster")
    seen = import_level(glb(room(), WrittenNode("table", (table,)), WrittenNode("upper", (upper,))), Choices())
    storeys = storeys_of(seen.report.examination)
    assert [floor for storey in storeys for floor in storey] == pytest.approx([0, 2.9, 2.9, 5.5], abs=1e-6)


def test_the_legend_has_what_is_drawn_and_how_many(glb):
    seen = import_level(glb(room(without=(4, 10))), Choices()).report.examination
    figure = figure_of(seen, "title", [("listener_start", (2.0, -2.0, 1.5))])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "holes (4 edges)" in labels
    assert any(label.startswith("rays that left (") for label in labels)
    assert not any("slivers" in label or "doors" in label for label in labels)


def test_a_flat_level_is_drawn_without_a_warning(glb):
    sheet = Piece(np.array([(0, 0, 0), (4, 0, 0), (0, 0, 4)], float), np.array([(0, 2, 1)]), "wood")
    seen = import_level(glb(WrittenNode("sheet", (sheet,))), Choices(is_open=True)).report.examination
    assert len(figure_of(seen, "title", []).axes) == 2
