import csv
import io
import json
import re

import numpy as np
import pytest

from tests.training import written_layouts
from tests.training.measured_room import Room
from tests.training.written_layouts import RATE, response, wav
from training.cli.main import main
from training.evaluation.literature import METRICS
from training.evaluation.paper_metrics import PAPER_METRICS


@pytest.fixture
def nafir_train(monkeypatch, capfd):
    """Runs a command; gives its exit code, standard output and standard error."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["nafir-train", *map(str, arguments)])
        try:
            main()
        except SystemExit as left:
            return left.code or 0, *capfd.readouterr()
        return 0, *capfd.readouterr()

    return run


@pytest.fixture
def room(tmp_path):
    return written_layouts.raf(tmp_path / "room")


@pytest.fixture
def predictions(tmp_path):
    folder = tmp_path / "predictions"
    for name in ("000007", "000008", "000009"):
        wav(folder / f"{name}.wav", 0.5 * response(name, 1))
    return folder


def test_the_whole_way_from_a_list_to_a_score(nafir_train, room, tmp_path):
    code, out, _ = nafir_train("benchmark", room, "--list")
    assert code == 0
    names = [row["name"] for row in csv.DictReader(io.StringIO(out))]
    assert names == ["000007", "000008", "000009"]
    for name in names:
        wav(tmp_path / "mine" / f"{name}.wav", response(name, 1))
    result = tmp_path / "score.json"
    code, out, _ = nafir_train("benchmark", room, "--predictions", tmp_path / "mine", "-o", result, "--json")
    assert code == 0
    told = json.loads(out)
    assert told == json.loads(result.read_text())
    assert told["split"]["test"] == told["scored"]["responses"] == 3
    assert (told["split"]["train"], told["split"]["validation"]) == (6, 1)
    assert [metric["name"] for metric in told["metrics"]] == [metric.name for metric in METRICS]
    assert re.fullmatch("[0-9a-f]{64}", told["benchmark"])
    assert {"nafir", "numpy", "soxr", "python"} <= told["versions"].keys()
    assert not (tmp_path / "score.json.partial").exists()


def test_a_score_is_a_table(nafir_train, room, predictions):
    code, out, _ = nafir_train("benchmark", room, "--predictions", predictions)
    assert code == 0
    assert "room (raf): 3 responses at 16000 Hz" in out
    assert "two ears only" in out
    code, out, _ = nafir_train("benchmark", room, "--predictions", predictions, "--markdown")
    assert code == 0
    rows = [line.split(" | ") for line in out.splitlines() if line.startswith("| ")]
    level = next(row for row in rows if row[0] == "| level")
    assert (level[2], level[3], level[4], level[5]) == ("6.02", "6.02", "dB", "3")
    assert all(len(row) == 7 for row in rows)


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda folder: (folder / "000008.wav").unlink(), "lacks 1 of 3 predictions: 000008: add them"),
        (lambda folder: (folder / "000008.wav").write_bytes(b"x"), r"000008\.wav: not an audio file"),
        (lambda folder: wav(folder / "000008.wav", np.zeros((1, 4_000))), r"000008\.wav: is silent"),
        (lambda folder: wav(folder / "000108.wav", response("x", 1)), r"named by no response .*: 000108\.wav"),
    ],
)
def test_bad_predictions_end_the_command(nafir_train, room, predictions, damage, problem):
    damage(predictions)
    code, out, err = nafir_train("benchmark", room, "--predictions", predictions)
    assert (code, out) == (2, "")
    assert re.search(problem, " ".join(err.split()))


def test_fewer_predictions_are_told_loudly(nafir_train, room, predictions):
    (predictions / "000008.wav").unlink()
    code, out, _ = nafir_train("benchmark", room, "--predictions", predictions, "--allow-missing")
    assert code == 0
    assert out.count("NOT COMPARABLE") == 2


def test_definitions_need_no_dataset(nafir_train):
    code, out, _ = nafir_train("benchmark", "--definitions")
    assert code == 0
    for metric in METRICS:
        assert f"(`{metric.name}`)" in out
        assert metric.definition.formula in out
    told = json.loads(nafir_train("benchmark", "--definitions", "--json")[1])
    assert [each["name"] for each in told] == [metric.name for metric in METRICS]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ((), "name the folder of a dataset"),
        (("{room}",), "--predictions: name the folder of your responses"),
        (("{room}", "--predictions", "{room}", "--list"), "--list and --predictions contradict each other"),
        (("{room}", "--layout", "wav", "--list"), "there is no 'wav', but soundspaces"),
        (("{room}", "--split", "none.json", "--list"), "none.json: cannot be read"),
        (("nowhere", "--list"), "nowhere: dataset: there is no such folder"),
    ],
)
def test_a_command_that_says_too_little_or_too_much_is_refused(nafir_train, room, arguments, problem):
    code, _, err = nafir_train("benchmark", *(each.format(room=room) for each in arguments))
    assert code == 2
    assert problem in " ".join(err.split())


def test_predictions_of_ours_score_as_they_are_evaluated(nafir_train, tmp_path):
    data = Room(tail=0.05).write(tmp_path / "data").folder
    code, out, _ = nafir_train("predict", data, "--method", "nearest", "-o", tmp_path / "near", "--format", "npy")
    assert code == 0
    assert "split held out" in out
    benchmark = json.loads(nafir_train("benchmark", data, "--predictions", tmp_path / "near", "--json")[1])
    evaluated = json.loads(nafir_train("evaluate", data, "--methods", "nearest", "--json")[1])
    ours = {metric["name"]: metric["mean"] for metric in benchmark["metrics"] if metric["by"] == "Nafir"}
    theirs = {name: each["mean"] for name, each in evaluated["columns"]["nearest"]["metrics"].items()}
    assert ours == {name: theirs[name] for name in ours}
    assert theirs.keys() - ours.keys() == {metric.name for metric in PAPER_METRICS}


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ((), "--method or --bundle: say what predicts"),
        (("--method", "guess"), "there is no 'guess', but nearest"),
        (("--method", "nearest", "--level", "fine"), "--level: is that of a bundle"),
        (("--method", "nearest", "--bundle", "b"), "--method and --bundle contradict each other"),
    ],
)
def test_a_prediction_needs_one_method(nafir_train, room, tmp_path, arguments, problem):
    code, _, err = nafir_train("predict", room, "-o", tmp_path / "out", *arguments)
    assert code == 2
    assert problem in " ".join(err.split())
    assert not (tmp_path / "out").exists()


def test_arrays_may_have_another_rate(nafir_train, room, tmp_path):
    for name in ("000007", "000008", "000009"):
        path = tmp_path / "arrays" / f"{name}.npy"
        path.parent.mkdir(exist_ok=True)
        np.save(path, np.repeat(response(name, 1), 2, axis=1))
    arguments = ("benchmark", room, "--predictions", tmp_path / "arrays", "--json")
    told = json.loads(nafir_train(*arguments, "--predictions-rate", 2 * RATE)[1])
    assert told["notes"] == [f"3 predictions were resampled from {2 * RATE} to {RATE} Hz."]
    assert told["predictions"]["cut"] == 0
