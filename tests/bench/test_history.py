"""Runs that `nafir bench --record` keeps."""

import json
import os
import re
import subprocess
import sys
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from server.bench import cli, history
from server.bench.history import Run, append_run, current_commit, read_history
from server.bench.report import Goal
from server.core.errors import NafirError

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def nafir(*arguments: str) -> subprocess.CompletedProcess[str]:
    run = [sys.executable, "-m", "server", *arguments]
    return subprocess.run(run, env=ENVIRONMENT, capture_output=True, text=True, timeout=300, check=False)


def test_a_run_is_kept_with_host_date_commit_command_and_figures(tmp_path):
    began = datetime.now().astimezone() - timedelta(seconds=1)
    quick = "field", "apartment", "--rounds", "1", "--poses", "1", "--json"
    done = nafir("bench", "--record", "--history", str(tmp_path), *quick)
    assert (done.returncode == 0) == ("not reached" not in done.stderr)
    (run,) = read_history(tmp_path / "field.json")
    measured = json.loads(done.stdout)
    assert run.figures["apartment, " + measured["levels"][0]["name"] + ", ms_p50"] == measured["levels"][0]["ms_p50"]
    assert (run.host.processor, run.host.cores) == (measured["host"]["processor"], measured["host"]["cores"])
    assert began <= run.date <= datetime.now().astimezone()
    assert run.command.startswith("nafir bench --record --history ")
    assert run.command.endswith("field apartment --rounds 1 --poses 1 --json")
    assert run.commit == "unknown" or re.fullmatch("[0-9a-f]{40}(\\+changes)?", run.commit)
    assert (run.failures == ()) == (done.returncode == 0)


def runs_of(bench: str, tmp_path: Path, *arguments: str):
    done = CliRunner().invoke(cli.app, ["--record", "--history", str(tmp_path), bench, *arguments])
    return done, read_history(tmp_path / f"{bench}.json")


def test_a_goal_that_is_missed_is_kept_as_a_failure(tmp_path, monkeypatch):
    judgement = Goal("speed", 15).judge(14.5)
    measured = {"host": {}, "peer": "", "summary": [vars(judgement)]}
    monkeypatch.setattr("server.bench.convolver.measure_convolver", lambda *_: measured)
    done, (run,) = runs_of("convolver", tmp_path, "--json")
    assert done.exit_code == 1
    assert run.figures == {"speed": 14.5}
    assert run.failures == ("speed: is 14.5, and may be no less than 15",)


def test_a_run_that_breaks_off_is_not_kept(tmp_path, monkeypatch):
    def broken(*_):
        raise NafirError("no")

    monkeypatch.setattr("server.bench.convolver.measure_convolver", broken)
    done, runs = runs_of("convolver", tmp_path)
    assert isinstance(done.exception, NafirError)
    assert runs == []
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_kept_unless_that_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr("server.bench.convolver.measure_convolver", lambda *_: {"summary": []})
    assert CliRunner().invoke(cli.app, ["--history", str(tmp_path), "convolver", "--json"]).exit_code == 0
    assert list(tmp_path.iterdir()) == []


def test_runs_are_added_after_those_before_and_read_back_as_they_were(tmp_path):
    path = tmp_path / "new" / "field.json"
    first, second = (Run.now("nafir bench field", {"ms": value, "none": None}, ("slow",)) for value in (0.1, 1 / 3))
    append_run(path, first)
    append_run(path, second)
    assert read_history(path) == [first, second]
    assert [each.name for each in path.parent.iterdir()] == ["field.json"]


@pytest.mark.parametrize("text", ["", "{}", "[{}]", '[{"host": 1}]', "[1"])
def test_a_file_that_is_no_history_is_refused_and_left_as_it_is(tmp_path, text):
    path = tmp_path / "field.json"
    path.write_text(text)
    with pytest.raises(NafirError, match="is no history"):
        append_run(path, Run.now("nafir bench field", {}, ()))
    assert path.read_text() == text


def test_a_commit_is_that_of_the_checkout_and_tells_of_changes(tmp_path, monkeypatch):
    def git(*arguments: str) -> str:
        run = ["git", "-C", tmp_path, "-c", "user.name=n", "-c", "user.email=n@example.org", *arguments]
        return subprocess.run(run, check=True, capture_output=True, text=True).stdout.strip()

    module = tmp_path / "server" / "history.py"
    monkeypatch.setattr(history, "__file__", str(module))
    module.parent.mkdir()
    module.write_text("")
    assert current_commit() == "unknown"
    git("init")
    (tmp_path / "pyproject.toml").write_text("")
    git("add", ".")
    git("commit", "-m", "first")
    assert current_commit() == git("rev-parse", "HEAD")
    module.write_text("changed")
    assert current_commit() == git("rev-parse", "HEAD") + "+changes"
