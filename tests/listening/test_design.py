"""A folder that is no whole test is refused by file and field."""

import json

import pytest

from server.listening.design import DesignError, ListeningTest
from tests.listening.listeners import design_of, write_test


@pytest.fixture
def folder(tmp_path):
    return write_test(tmp_path / "test", design_of()).folder


def changed(folder, change):
    path = folder / "test.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def test_a_written_test_comes_back(folder):
    assert ListeningTest.open(folder).design == design_of()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda document: document.update(kind="duel"), "kind"),
        (lambda document: document.pop("places"), "places"),
        (lambda document: document["trials"][0].update(place=99), r"trials\.0\.place"),
        (lambda document: document["places"][0]["sounds"].pop("field"), r"places\.0\.sounds"),
        (lambda document: document["places"][0]["sounds"].update(field="../secret.wav"), r"places\.0\.sounds"),
        (lambda document: document["trials"][1].update(methods=["field", "other"]), "'other' is missing"),
    ],
)
def test_a_damaged_design_names_the_field(folder, change, named):
    changed(folder, change)
    with pytest.raises(DesignError, match=rf"test\.json: .*{named}"):
        ListeningTest.open(folder)


def test_sounds_are_all_there_and_of_one_size(folder):
    sound = min((folder / "sounds").iterdir())
    content = sound.read_bytes()
    sound.write_bytes(content + b"\0\0")
    with pytest.raises(DesignError, match="would tell methods apart"):
        ListeningTest.open(folder)
    sound.unlink()
    with pytest.raises(DesignError, match=f"{sound.name}: sounds: is missing"):
        ListeningTest.open(folder)


def test_a_folder_without_a_test_says_how_to_make_one(tmp_path):
    with pytest.raises(DesignError, match="nafir-train listening-test BUNDLE DATA"):
        ListeningTest.open(tmp_path)
    with pytest.raises(DesignError, match="there is no such folder"):
        ListeningTest.open(tmp_path / "nowhere")
