"""`nafir listening-test` and `nafir listening-results` on the command line."""

import json
import sys

import pytest

from server.cli.main import main
from tests.listening.listeners import FIELD, design_of, listen, write_test


@pytest.fixture
def nafir(monkeypatch, capfd):
    """Runs the command: exit code, output, error output."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["nafir", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code or 0, *capfd.readouterr()

    return run


def test_results_are_printed_and_written(nafir, tmp_path):
    test = write_test(tmp_path / "test", design_of())
    for number in range(3):
        listen(test, number, lambda trial: min(set(trial.slots.values()) & {FIELD, "reference"}))
    code, out, _ = nafir("listening-results", test.folder)
    assert code == 0
    assert f"{FIELD} over" in out
    assert "12 of 12" in out
    code, out, _ = nafir(
        "listening-results", test.folder, "--json", "-o", tmp_path / "out.json", "--figure", tmp_path / "out.png"
    )
    document = json.loads(out)
    assert document["counted"] == 3
    assert document["comparisons"][0]["result"]["share"] == 1.0
    assert json.loads((tmp_path / "out.json").read_text()) == document
    assert (tmp_path / "out.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("listening-results", "{tmp}"), "test.json: is missing"),
        (("listening-test", "{tmp}/nowhere"), "there is no such folder"),
        (("listening-test", "{test}", "--host", "not an address"), "host: "),
        (("listening-test", "{test}", "--methods", "nearest"), "--methods: is for making a test"),
        (("listening-results", "{test}", "--figure", "{tmp}/x.txt"), "--figure"),
    ],
)
def test_errors_name_what_is_at_fault(nafir, tmp_path, arguments, told):
    test = write_test(tmp_path / "test", design_of())
    code, _, errors = nafir(*(each.format(tmp=tmp_path, test=test.folder) for each in arguments))
    assert code == 2
    assert told in " ".join(errors.split())


def test_without_the_training_extra_the_error_says_what_to_install(nafir, tmp_path, monkeypatch):
    found = __import__("importlib.util").util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "h5py" else found(name))
    code, _, errors = nafir("listening-test", tmp_path, tmp_path)
    assert code == 2
    assert "pip install 'nafir[training]'" in " ".join(errors.split())


def test_what_making_a_test_refuses_ends_the_command(nafir, tmp_path):
    code, _, errors = nafir("listening-test", tmp_path, tmp_path, "-o", tmp_path / "test")
    assert code == 2
    assert "scene.json" in errors
