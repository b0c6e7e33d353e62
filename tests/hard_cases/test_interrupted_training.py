"""Training with a loss that explodes, and killed at every step."""

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.hard_cases.small_trainings import (
    FACTORISED,
    GRID,
    KINDS,
    SAMPLES,
    assert_finite,
    measured_at,
    single_precision,  # noqa: F401 - on a busy machine not always chosen alike
    trained,
    write,
)
from tests.training.conftest import one_thread  # noqa: F401 - sums in parallel are not repeatable
from training.learning import runs as runs_module
from training.learning.factorised import FactorisedLearner
from training.learning.runs import Configuration, RunError, load_checkpoint
from training.learning.train import DivergedError, load_learner

_ROOT = Path(__file__).parents[2]


# A loss that explodes.


@pytest.fixture(scope="module")
def responses(tmp_path_factory):
    return write(tmp_path_factory.mktemp("responses"), measured_at(GRID))


@pytest.fixture(scope="module")
def whole(responses, tmp_path_factory):
    """What an uninterrupted run ends at."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return folder, trained(responses, folder, FACTORISED)


@pytest.mark.parametrize("rate", [1e2, 1e6, 1e30])
@KINDS
def test_a_learning_rate_that_blows_parameters_up_is_stopped_before_they_are_kept(
    responses, tmp_path, configuration, rate
):
    exploding = dataclasses.replace(configuration, learning_rate=rate, epochs=40)
    with pytest.raises(DivergedError, match="Train with a lower learning rate"):
        trained(responses, tmp_path, exploding)
    if (tmp_path / "checkpoint.pt").exists():
        assert_plausible(responses, tmp_path, exploding)


def assert_plausible(responses, run, configuration):
    """What is kept has an error of the size that training begins with."""
    state = load_checkpoint(run, torch.device("cpu"))
    assert_finite(state["field"])
    assert state["first_loss"] is not None
    assert state["best_loss"] < 1000 * max(state["first_loss"], 1.0)
    assert configuration.learning_rate == Configuration.read(run).learning_rate
    assert responses.samples == SAMPLES


@pytest.mark.parametrize("growth", [1e4, 1e30, float("inf"), float("nan")])
def test_a_loss_that_grows_out_of_all_proportion_stops_training_at_the_last_good_checkpoint(
    responses, tmp_path, monkeypatch, growth
):
    losses_of, calls = FactorisedLearner.losses, []

    def growing(self, prediction, targets):
        parts = losses_of(self, prediction, targets)
        calls.append(torch.is_grad_enabled())
        # Once the first round was looked at.
        factor = growth if not all(calls) and torch.is_grad_enabled() else 1.0
        return {name: part * factor for name, part in parts.items()}

    monkeypatch.setattr(FactorisedLearner, "losses", growing)
    with pytest.raises(DivergedError, match="last checkpoint is kept"):
        trained(responses, tmp_path, FACTORISED)
    monkeypatch.undo()
    kept = load_checkpoint(tmp_path, torch.device("cpu"))
    assert kept["step"] == 2 * (kept["step"] // 2) > 0  # whole epochs of two steps
    assert_finite(kept["field"])
    assert_finite(trained(responses, tmp_path, FACTORISED))  # and from there one may go on


def test_an_error_on_what_is_held_back_that_explodes_is_never_kept(responses, tmp_path, monkeypatch):
    losses_of, rounds = FactorisedLearner.losses, []

    def growing(self, prediction, targets):
        parts = losses_of(self, prediction, targets)
        if torch.is_grad_enabled():
            return parts
        rounds.append(1)  # the first is of the mean of the training set
        return {name: part * (1e9 if len(rounds) > 2 else 1) for name, part in parts.items()}

    monkeypatch.setattr(FactorisedLearner, "losses", growing)
    with pytest.raises(DivergedError, match="validation error is"):
        trained(responses, tmp_path, FACTORISED)
    kept = load_checkpoint(tmp_path, torch.device("cpu"))
    assert kept["rounds"] == 1
    assert (tmp_path / "log.csv").read_text().count("\n") == 2


# Killed.

KILLED_AT = [
    pytest.param("training.learning.runs.write_json", 1, id="before anything is written"),
    pytest.param("training.learning.runs.write_json", 2, id="between the files that say what the run is"),
    pytest.param("training.learning.train._Loop._choose_precision", 1, id="before the first step"),
    *(
        pytest.param(
            "training.learning.train._Loop._step",
            number,
            id=f"before step {number}",
            marks=() if number in {1, 4} else pytest.mark.long,
        )
        for number in range(1, 7)
    ),
    pytest.param("torch.optim.AdamW.step", 3, id="before parameters change"),
    pytest.param("training.learning.train.append_log", 2, id="before a round is logged"),
    pytest.param("training.learning.train.save_checkpoint", 1, id="before the first checkpoint"),
    pytest.param("training.learning.train.save_checkpoint", 2, id="after a round is logged"),
    pytest.param("torch.save", 2, id="as a checkpoint is written"),
    pytest.param("training.learning.train._Loop._finish", 1, id="before it is finished"),
    pytest.param("training.learning.train.save_checkpoint", 4, id="before the finished field is kept"),
]


class Killed(BaseException):
    """As by a signal: nothing gets to tidy up."""


@pytest.mark.parametrize(("place", "call"), KILLED_AT)
def test_a_run_killed_anywhere_goes_on_to_the_same_field_and_the_same_log(
    responses, whole, tmp_path, monkeypatch, place, call
):
    calls = []
    original = _resolve(place)

    def killing(*given, **named):
        calls.append(place)
        if len(calls) == call:
            if place == "torch.save":
                given[1].write_bytes(b"half of a check")
            raise Killed
        return original(*given, **named)

    monkeypatch.setattr(place, killing)
    with pytest.raises(Killed):
        trained(responses, tmp_path, FACTORISED)
    monkeypatch.undo()
    found = trained(responses, tmp_path, FACTORISED)
    folder, expected = whole
    for name, values in expected.items():
        assert torch.equal(found[name], values), name
    assert _without_times(tmp_path) == _without_times(folder)


def _resolve(place):
    module, _, name = place.rpartition(".")
    if module in sys.modules:
        return getattr(sys.modules[module], name)
    return getattr(_resolve(module), name)


def _without_times(run):
    rows = [line.split(",") for line in (run / "log.csv").read_text().splitlines()]
    return [[value for name, value in zip(rows[0], row, strict=True) if name != "seconds"] for row in rows]


def test_a_process_killed_by_the_system_leaves_a_run_that_goes_on(responses, whole, tmp_path, monkeypatch):
    """SIGKILL, as soon as the first checkpoint lies there: of six steps two need not be taken again."""
    program = (
        "import sys, time, torch; torch.set_num_threads(1)\n"
        "from pathlib import Path\n"
        "from rich.progress import Progress\n"
        "import training.learning.train as t\n"
        "from training.data.responses import ImportedDataset\n"
        "from training.learning.runs import Configuration\n"
        "save = t.save_checkpoint\n"
        "def slowly(run, state):\n"
        "    save(run, state); print('saved', flush=True); time.sleep(60)\n"
        "t.save_checkpoint = slowly\n"
        "data, run, like = map(Path, sys.argv[1:])\n"
        "t.train(ImportedDataset.open(data), run, Configuration.read(like), Progress(disable=True))\n"
    )
    command = [sys.executable, "-c", program, str(responses.folder), str(tmp_path), str(whole[0])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=_ROOT) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "saved\n"
        os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(RunError, match=r"of 3 epochs are trained; run train again"):
        load_learner(responses, tmp_path)
    steps, step = [], torch.optim.AdamW.step
    monkeypatch.setattr("torch.optim.AdamW.step", lambda *given: steps.append(step(*given)))
    found = trained(responses, tmp_path, FACTORISED)
    assert len(steps) == 4
    for name, values in whole[1].items():
        assert torch.equal(found[name], values), name


def test_a_log_torn_in_the_middle_of_a_line_is_written_again(responses, whole, tmp_path, monkeypatch):
    def torn(run, _):
        with (run / "log.csv").open("a") as file:
            file.write("0.5,0.1,")
        raise Killed

    monkeypatch.setattr("training.learning.train.append_log", torn)
    with pytest.raises(Killed):
        trained(responses, tmp_path, FACTORISED)
    monkeypatch.undo()
    trained(responses, tmp_path, FACTORISED)
    assert _without_times(tmp_path) == _without_times(whole[0])


def test_what_a_run_is_survives_a_kill_as_it_is_written(responses, tmp_path, monkeypatch):
    trained(responses, tmp_path, dataclasses.replace(FACTORISED, epochs=1))
    before = (tmp_path / "run.json").read_text()

    def torn(path, text):
        with path.open("w") as file:
            file.write(text[:10])
        raise Killed

    monkeypatch.setattr("pathlib.Path.write_text", torn)
    with pytest.raises(Killed):
        dataclasses.replace(FACTORISED, epochs=1).write(tmp_path)
    monkeypatch.undo()
    assert (tmp_path / "run.json").read_text() == before
    assert runs_module.Configuration.read(tmp_path).epochs == 1
