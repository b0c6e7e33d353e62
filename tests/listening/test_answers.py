"""The CSV of a listener: nothing that was answered is lost, whenever the process dies."""

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from server.listening.answers import COLUMNS, AnswerFile, rows_of
from server.listening.plan import QUIET, ListenerPlan
from tests.listening.listeners import FIELD, answers_of, design_of, listen, write_test


@pytest.fixture
def heard(tmp_path):
    """A test, and the plan and file of a listener who has answered all of it."""
    test = write_test(tmp_path / "test", design_of(places=2))
    plan = listen(test, 0, lambda trial: FIELD if FIELD in trial.slots.values() else "reference")
    return test, plan, test.results / f"{plan.code}.csv"


def test_the_file_has_a_row_for_each_sound_of_each_trial(heard):
    _, plan, path = heard
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    first = [row for row in rows if row["trial"] == "0"]
    assert [row["slot"] for row in first] == ["1", "2", "3"]
    assert [row["method"] for row in first if row["answer"] == "1"] == [QUIET]
    number = next(number for number, trial in enumerate(plan.trials) if trial.part == "test")
    by_slot = {row["slot"]: row for row in rows if row["trial"] == str(number)}
    assert set(by_slot) == {"reference", "a", "b"}
    assert by_slot["reference"]["answer"] == ""
    assert {by_slot[slot]["method"]: by_slot[slot]["answer"] for slot in "ab"} == {FIELD: "1", "aac-nearest": "0"}
    assert by_slot["a"]["clip"] == "trumpet"


def test_a_file_that_is_torn_anywhere_keeps_its_whole_trials_and_goes_on(heard, tmp_path):
    _, plan, path = heard
    whole = path.read_bytes()
    answered = AnswerFile(path, plan).read()
    ends = [len(",".join(COLUMNS)) + 1]
    for trial in answered.values():
        ends.append(ends[-1] + sum(len(",".join(row.cells)) + 1 for row in trial.rows))
    assert ends[-1] == len(whole)
    torn = AnswerFile(tmp_path / "torn.csv", plan)
    for end in range(0, len(whole), 7):
        torn.path.write_bytes(whole[:end])
        kept = torn.read()
        count = sum(at <= end for at in ends[1:])
        assert list(kept.values()) == list(answered.values())[:count]
        if count < len(answered):
            torn.append(list(answered.values())[count].rows)
            assert torn.path.read_bytes() == whole[: ends[count + 1]]


WRITER = """
import sys
from pathlib import Path
from server.listening.answers import AnswerFile, rows_of
from server.listening.design import ListeningTest
from server.listening.plan import ListenerPlan
test = ListeningTest.open(Path(sys.argv[1]))
plan = ListenerPlan.read(next(test.results.glob("*.json")))
file = AnswerFile(test.results / f"{plan.code}.csv", plan)
for number, trial in enumerate(plan.trials):
    first, *others = trial.slots
    file.append(rows_of(number, trial, test.design, {first: 1.0, **dict.fromkeys(others, 0.0)}, {}, 1.0))
    print(number, flush=True)
    if number == 4:
        sys.stdin.read()
"""


def test_what_was_answered_before_a_kill_is_there_after_it(tmp_path):
    test = write_test(tmp_path / "test", design_of(places=2))
    test.results.mkdir()
    plan = ListenerPlan.draw(test.design, "abcdefghjk", 0)
    plan.write(test.results / "abcdefghjk.json")
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(test.folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        for number in range(5):
            assert process.stdout.readline() == f"{number}\n"
        os.kill(process.pid, signal.SIGKILL)
    file = AnswerFile(test.results / "abcdefghjk.csv", plan)
    assert list(file.read()) == [0, 1, 2, 3, 4]
    trial = plan.trials[5]
    file.append(rows_of(5, trial, test.design, answers_of(trial, QUIET), {}, 1.0))
    assert list(file.read()) == [0, 1, 2, 3, 4, 5]


def test_rows_of_another_plan_are_not_read(heard, tmp_path):
    test, _, path = heard
    other = ListenerPlan.draw(test.design.model_copy(update={"trials": test.design.trials[:1]}), "x", 0)
    foreign: Path = tmp_path / "foreign.csv"
    foreign.write_bytes(path.read_bytes())
    assert set(AnswerFile(foreign, other).read()) <= set(range(len(other.trials)))


def test_nothing_personal_is_stored(heard):
    assert set(COLUMNS) == {"trial", "part", "place", "clip", "slot", "method", "answer", "plays", "seconds"}
    assert {path.suffix for path in heard[0].results.iterdir()} == {".csv", ".json"}
