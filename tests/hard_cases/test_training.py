"""Training on responses that hardly are any, from places that say nothing of a room, with a loss that explodes, and
killed at every step."""

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from rich.progress import Progress

from tests.training.conftest import one_thread  # noqa: F401 - sums in parallel are not repeatable
from training import runs as runs_module
from training.dataset import DatasetError
from training.importers.report import ImportReport
from training.learning.factorised import FactorisedLearner
from training.models.factorised import FieldShape
from training.models.naf import NafShape
from training.models.targets import codec_of, delay_samples
from training.responses import FILE, ImportedDataset, Measurement, ResponsesError
from training.runs import Configuration, NafRecipe, RunError, load_checkpoint
from training.train import DivergedError, load_learner, train

_ROOT = Path(__file__).parents[2]
RATE, SAMPLES = 8_000, 1_200
FACTORISED = Configuration(
    epochs=3, batch=4, shape=FieldShape(rank=4, width=16, depth=2, grid_spacing_m=1.0, grid_features=4)
)
NAF = Configuration.naf(NafShape(width=16), NafRecipe(points=40), epochs=3, batch=4)
KINDS = pytest.mark.parametrize(
    "configuration", [pytest.param(FACTORISED, id="factorised"), pytest.param(NAF, id="naf")]
)
GRID = [((float(x), float(y), 1.5), (1.4, 1.6, 1.2)) for x in range(4) for y in range(3)]


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """The clock decides between precisions, and on a busy machine not always alike."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("training.train.bfloat16_gains", lambda *_: False)
        yield


def response(seed, samples=SAMPLES):
    noise = np.random.default_rng(seed).standard_normal((2, samples))
    return (noise * 10 ** (-3 * np.arange(samples) / RATE / 0.1)).astype(np.float32)


def measured_at(poses, of=response):
    return [
        Measurement(listener, emitter, of(number), RATE, yaw=0.0) for number, (listener, emitter) in enumerate(poses)
    ]


def write(folder, measurements, share=0.1):
    return ImportedDataset.write(
        folder / "data", measurements, ImportReport(), layout="test", source="test", held_out_share=share
    )


def trained(responses, run, configuration):
    train(responses, run, configuration, Progress(disable=True))
    return load_learner(responses, run).field.state_dict()


def assert_finite(state):
    assert all(torch.isfinite(values).all() for values in state.values())


# Responses that hardly are any.


def test_a_response_without_samples_is_refused_with_its_number(tmp_path):
    for first_bad in (0, 3):
        some = measured_at(GRID, lambda n, bad=first_bad: response(n, 0 if n == bad else SAMPLES))
        with pytest.raises(ResponsesError, match=f"row {first_bad} has no samples"):
            write(tmp_path, some)
    assert not (tmp_path / "data" / FILE).exists()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_response_that_is_not_finite_is_refused_with_its_number(tmp_path, value):
    some = measured_at(GRID, lambda n: response(n) if n != 5 else np.full((2, SAMPLES), value, np.float32))
    with pytest.raises(ResponsesError, match="row 5 is not finite"):
        write(tmp_path, some)


@pytest.mark.parametrize("end", ["listener", "emitter"])
def test_a_place_that_is_not_finite_is_refused_with_its_number(tmp_path, end):
    some = measured_at(GRID)
    some[2] = dataclasses.replace(some[2], **{end: (0.0, float("nan"), 1.0)})
    with pytest.raises(ResponsesError, match="row 2 is not finite"):
        write(tmp_path, some)


@KINDS
def test_a_file_damaged_after_it_was_written_is_told_before_a_step_is_taken(tmp_path, configuration):
    responses = write(tmp_path, measured_at(GRID))
    with h5py.File(tmp_path / "data" / FILE, "r+") as file:
        file["responses"][4, 1, 700] = np.nan
    with pytest.raises(ResponsesError, match="not finite"):
        trained(ImportedDataset.open(tmp_path / "data"), tmp_path / "run", configuration)
    assert responses.samples == SAMPLES


@KINDS
def test_responses_shorter_than_a_window_are_refused(tmp_path, configuration):
    responses = write(tmp_path, measured_at(GRID, lambda n: response(n, 100)))
    with pytest.raises(DatasetError, match="100 samples are too short"):
        trained(responses, tmp_path / "run", configuration)


@KINDS
@pytest.mark.parametrize("silent", [1, 6, len(GRID)])
def test_silent_responses_are_learned_from(tmp_path, configuration, silent):
    """A receiver that nothing reaches. With all of them silent, no bin varies: a spread of zero."""
    responses = write(tmp_path, measured_at(GRID, lambda n: response(n) * np.float32(n >= silent)))
    assert_finite(trained(responses, tmp_path / "run", configuration))


@KINDS
def test_responses_that_are_all_the_same_are_learned(tmp_path, configuration):
    """Every bin has a spread of zero."""
    responses = write(tmp_path, measured_at(GRID, lambda _: response(0)))
    assert_finite(trained(responses, tmp_path / "run", configuration))


def test_a_spread_of_zero_is_not_divided_by(tmp_path):
    responses = write(tmp_path, measured_at(GRID, lambda _: response(0)))
    trained(responses, tmp_path / "run", NAF)
    spread = load_learner(responses, tmp_path / "run").field.spread
    assert float(spread.min()) > 0.01


@KINDS
def test_responses_that_end_before_sound_arrives_are_learned_as_silence(tmp_path, configuration):
    """A receiver out of reach: 100 m away, in responses of 50 m."""
    far = [*GRID, ((1.0, 1.0, 1.5), (101.0, 1.0, 1.5))]
    assert_finite(trained(write(tmp_path, measured_at(far)), tmp_path / "run", configuration))


def test_a_pair_that_no_way_connects_is_told_with_its_row():
    enclosed = SimpleNamespace(onset_s=np.array([0.01, np.inf]), sample_rate=RATE, file="pairs.h5")
    assert delay_samples(enclosed, 0) == 80 - 64
    with pytest.raises(DatasetError, match="row 1: no way leads"):
        delay_samples(enclosed, 1)


# Places that say nothing of a room.


@KINDS
@pytest.mark.parametrize("count", [1, 2])
def test_too_few_places_are_told_as_such(tmp_path, configuration, count):
    responses = write(tmp_path, measured_at(GRID[:count]))
    with pytest.raises(DatasetError, match="nothing is left to train on"):
        trained(responses, tmp_path / "run", configuration)


@KINDS
def test_three_places_are_enough_to_begin_with(tmp_path, configuration):
    assert_finite(trained(write(tmp_path, measured_at(GRID[:3])), tmp_path / "run", configuration))


@KINDS
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_places_on_a_line_make_a_field(tmp_path, configuration, axis):
    def on_line(step):
        place = [1.0, 1.0, 1.0]
        place[axis] += step
        return tuple(place)

    poses = [(on_line(step / 2), on_line(9.0)) for step in range(10)]
    assert_finite(trained(write(tmp_path, measured_at(poses)), tmp_path / "run", configuration))


@KINDS
def test_places_measured_again_and_again_make_a_field(tmp_path, configuration):
    poses = [GRID[0]] * 6 + GRID[1:6] + [GRID[1]] * 2
    assert_finite(trained(write(tmp_path, measured_at(poses)), tmp_path / "run", configuration))


@KINDS
def test_one_place_measured_again_and_again_is_no_room(tmp_path, configuration):
    responses = write(tmp_path, measured_at([GRID[0]] * 6))
    with pytest.raises(DatasetError, match="nothing is left to train on"):
        trained(responses, tmp_path / "run", configuration)


@KINDS
def test_an_emitter_in_the_listeners_head_is_learned_from(tmp_path, configuration):
    poses = [((1.4, 1.6, 1.2), (1.4, 1.6, 1.2)), *GRID]
    assert_finite(trained(write(tmp_path, measured_at(poses)), tmp_path / "run", configuration))


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
        rounds.append(1)
        return {name: part * (1e9 if len(rounds) > 1 else 1) for name, part in parts.items()}

    monkeypatch.setattr(FactorisedLearner, "losses", growing)
    with pytest.raises(DivergedError, match="held back is"):
        trained(responses, tmp_path, FACTORISED)
    kept = load_checkpoint(tmp_path, torch.device("cpu"))
    assert kept["rounds"] == 1
    assert (tmp_path / "log.csv").read_text().count("\n") == 2


# Killed.

KILLED_AT = [
    pytest.param("training.runs._write_whole", 1, id="before anything is written"),
    pytest.param("training.runs._write_whole", 2, id="between the files that say what the run is"),
    pytest.param("training.train._Loop._choose_precision", 1, id="before the first step"),
    *(pytest.param("training.train._Loop._step", number, id=f"before step {number}") for number in range(1, 7)),
    pytest.param("torch.optim.AdamW.step", 3, id="before parameters change"),
    pytest.param("training.train.append_log", 2, id="before a round is logged"),
    pytest.param("training.train.save_checkpoint", 1, id="before the first checkpoint"),
    pytest.param("training.train.save_checkpoint", 2, id="after a round is logged"),
    pytest.param("torch.save", 2, id="as a checkpoint is written"),
    pytest.param("training.train._Loop._finish", 1, id="before it is finished"),
    pytest.param("training.train.save_checkpoint", 4, id="before the finished field is kept"),
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
        "import training.train as t\n"
        "from training.responses import ImportedDataset\n"
        "from training.runs import Configuration\n"
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

    monkeypatch.setattr("training.train.append_log", torn)
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


def test_the_codec_of_responses_just_long_enough_has_frames():
    for n_fft in (256, 512):
        codec = codec_of(SimpleNamespace(samples=n_fft, sample_rate=RATE, file="r"), n_fft)
        assert codec.frames >= 1
        assert np.isfinite(codec.encode(np.ones(n_fft))[0]).all()
