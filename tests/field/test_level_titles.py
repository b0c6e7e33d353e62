"""What visitors read in place of the names of quality levels."""

from server.api.frontier import Frontier
from server.field.fields_by_level import FieldsByLevel
from server.field.level_titles import LevelOfField, level_titles
from server.scene.bundle import Bundle, bundled_scenes
from server.scene.manifest import Phase, QualityLevel, Reuse


def of(name, *, architecture="factorised", rank=16, **limits):
    return LevelOfField(QualityLevel(name=name, field="some", **limits), architecture, rank)


def near(turn_deg, first_reflections="pose", spacing_m=1.0):
    return Reuse(spacing_m=spacing_m, turn_deg=turn_deg, first_reflections=first_reflections)


def test_a_title_says_what_a_level_leaves_out():
    levels = [
        of("a"),
        of("b", reuse=near(120)),
        of("c", reuse=near(120, "node", 2.5)),
        of("d", shared_tail=True),
        of("e", frames=40, ir_rate_hz=20.0),
        of("f", architecture=None, rank=None),
    ]
    assert level_titles(levels) == {
        "a": "Full",
        "b": "Reverberation renewed every 1 m",
        "c": "All reflections renewed every 2.5 m",
        "d": "Shared late reverberation",
        "e": "Shortened reverberation, at most 20 responses a second",
        "f": "Geometry only",
    }


def test_levels_of_one_kind_are_told_apart_by_the_first_detail_that_differs():
    levels = [
        of("a"),
        of("b", rank=4),
        of("c", reuse=near(30)),
        of("d", reuse=near(120)),
        of("e", reuse=near(120, "node"), phase=Phase(kind="integrated")),
        of("f", reuse=near(120, "node")),
        of("g", shared_tail=True),
        of("h", shared_tail=True),
    ]
    assert level_titles(levels) == {
        "a": "Full, rank 16",
        "b": "Full, rank 4",
        "c": "Reverberation renewed every 1 m, 30°",
        "d": "Reverberation renewed every 1 m, 120°",
        "e": "All reflections renewed every 1 m, integrated phase",
        "f": "All reflections renewed every 1 m",
        "g": "Shared late reverberation, g",
        "h": "Shared late reverberation, h",
    }


def test_in_every_bundled_scene_titles_differ_from_each_other_and_from_names():
    for folder in bundled_scenes():
        levels = Frontier.of(FieldsByLevel.load(Bundle.load(folder)), {}).levels
        titles = [level.title for level in levels]
        assert len(set(titles)) == len(titles)
        assert not {level.name for level in levels} & set(titles)
        assert all(len(level.title) < 48 for level in levels if level.is_offered)
