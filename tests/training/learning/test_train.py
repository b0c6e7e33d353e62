import csv
import dataclasses
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.progress import Progress
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from training.learning import train as train_module
from training.learning.factorised import FactorisedLearner
from training.learning.kinds import learner_of
from training.learning.naf import NafLearner
from training.learning.pairs import split
from training.learning.precision import bfloat16_gains
from training.learning.processes import Processes
from training.learning.runs import (
    CHECKPOINT,
    Configuration,
    FactorisedRecipe,
    NafRecipe,
    RecipeError,
    RunError,
    configure,
    dataset_folder,
    minutes_of,
)
from training.learning.train import DivergedError, load_learner, train
from training.models.cells import Cells
from training.models.level_correction import InterpolatedLevels, PowerBalance
from training.models.naf import NafShape
from training.models.stored_targets import load_targets
from training.models.targets import codec_of
from training.simulation.responses import SimulatedResponses


class Impatient(Progress):
    """Interrupts, as Ctrl-C does, after so many epochs."""

    def __init__(self, patience):
        super().__init__(disable=True)
        self._patience = patience

    def update(self, *arguments, **changes):
        super().update(*arguments, **changes)
        self._patience -= "description" in changes
        if self._patience == 0:
            raise KeyboardInterrupt


def losses(run, column):
    with (run / "log.csv").open(newline="") as file:
        return [float(row[column]) for row in csv.DictReader(file)]


def trained(dataset, run):
    return load_learner(SimulatedResponses(dataset), run)


def test_an_interrupted_run_goes_on_to_the_same_field(dataset, run, configuration, tmp_path):
    responses = SimulatedResponses(dataset)
    with pytest.raises(KeyboardInterrupt):
        train(responses, tmp_path, configuration, Impatient(7))
    with pytest.raises(RunError, match=f"7 of {configuration.epochs} epochs"):
        load_learner(responses, tmp_path)
    train(responses, tmp_path, configuration, Progress(disable=True))

    whole, pieced = (trained(dataset, folder).field.state_dict() for folder in (run, tmp_path))
    for name, values in whole.items():
        assert torch.equal(pieced[name], values), name
    assert losses(tmp_path, "training") == losses(run, "training")


def test_a_finished_run_is_left_as_it_is(dataset, run, configuration):
    before = (run / "checkpoint.pt").read_bytes()
    train(SimulatedResponses(dataset), run, configuration, Progress(disable=True))
    assert (run / "checkpoint.pt").read_bytes() == before


def test_the_loss_falls(run, configuration):
    training = losses(run, "training")
    assert len(training) == configuration.epochs
    assert np.mean(training[-3:]) < 0.8 * np.mean(training[:3])


def told(learner, targets):
    """Poses of a field's targets as its inputs."""
    paths = learner.site.paths(targets.listener, targets.emitter)
    return [torch.from_numpy(part) for part in (targets.listener, targets.emitter, targets.yaw, paths)]


def test_learning_beats_the_mean_of_all_poses(dataset, run, tmp_path):
    learner = trained(dataset, run)
    field, responses = learner.field, SimulatedResponses(dataset)
    targets = load_targets(responses, learner.cells, tmp_path, Progress(disable=True), expected=True)
    flat = torch.from_numpy(np.asarray(targets.flat, dtype=np.float32))
    with torch.no_grad():
        predicted = field.in_physical_units(field(*told(learner, targets)))
    for name in ("fine", "phasor"):
        part = field.heads.slices[name]
        error = (predicted - flat)[:, part].square().mean()
        assert error < 0.95 * (flat - flat.mean(dim=0))[:, part].square().mean(), name


def test_corrected_levels_carry_the_power_of_the_training_set(dataset, configuration, tmp_path):
    """Pooled over the whole set, what is heard has the targets' power where the field's log would be too low: of
    responses as they were drawn, with no error of energies to lift it."""
    recipe = FactorisedRecipe(expected=False, energy_weight=0.0)
    train(
        SimulatedResponses(dataset),
        tmp_path / "run",
        dataclasses.replace(configuration, recipe=recipe),
        Progress(disable=True),
    )
    learner = trained(dataset, tmp_path / "run")
    field, responses = learner.field, SimulatedResponses(dataset)
    targets = load_targets(responses, learner.cells, tmp_path, Progress(disable=True))
    flat = torch.from_numpy(np.asarray(targets.flat, dtype=np.float32))
    with torch.no_grad():
        features = field.encoder(*told(learner, targets))
        predicted = field.in_physical_units(field.coefficients_of(features) @ field.basis)
        correction = field.level_correction[field.encoder.sight(features)[:, 0].long()]
    levels, part = field.heads.levels, field.heads.slices["late"]
    heard = InterpolatedLevels(learner.cells, responses.channels)
    raw, corrected, true = (
        level[:, part].double().mul(2).exp().sum()
        for level in (heard(predicted[:, levels]), heard((predicted + correction)[:, levels]), flat)
    )
    assert abs(torch.log(corrected / true)) < abs(torch.log(raw / true))
    assert torch.log(corrected / true).abs() < 0.1
    # To cells themselves as much is not missing: sound decays within them.
    of_cells = PowerBalance(field.heads.areas)
    sight = field.encoder.sight(features)
    of_cells.add(flat[:, levels], predicted[:, levels], sight)
    uncorrected = predicted[:, levels] + of_cells.deficit()[sight[:, 0].long()]
    errors = []
    for corrected in (uncorrected, (predicted + correction)[:, levels]):
        balance = PowerBalance(field.heads.areas)
        balance.add(flat[:, levels], heard(corrected), sight)
        errors.append(float(balance.deficit()[:, part].square().mean()))
    assert errors[1] < 0.5 * errors[0]
    for name in ("phasor", "interaural"):
        assert not field.level_correction[:, field.heads.slices[name]].any()


def test_a_run_says_how_long_it_took_with_its_targets(dataset, run, tmp_path):
    training_s = losses(run, "seconds")[-1]
    learner = learner_of(SimulatedResponses(dataset), Configuration.read(run))
    learner.prepare(Progress(disable=True))
    assert learner.prepared_s > 0
    # What the targets of this dataset once took, whoever computes them now.
    assert 60 * minutes_of(run) == pytest.approx(training_s + learner.prepared_s, abs=0.5)
    with pytest.raises(RunError, match="holds no checkpoint"):
        minutes_of(tmp_path)


@pytest.mark.parametrize("change", [{"seed": 1}, {"epochs": 21}, {"learning_rate": 1e-3}])
def test_a_run_keeps_to_its_configuration(dataset, run, configuration, change):
    with pytest.raises(RunError, match="another configuration"):
        train(SimulatedResponses(dataset), run, dataclasses.replace(configuration, **change), Progress(disable=True))


def test_a_run_of_another_network_is_refused_with_a_message(dataset, run, tmp_path):
    other = shutil.copytree(run, tmp_path / "run")
    checkpoint = other / CHECKPOINT
    state = torch.load(checkpoint, weights_only=False)
    state["field"]["level_correction"] = state["field"]["level_correction"][0]
    torch.save(state, checkpoint)
    with pytest.raises(RunError, match="another version of this program; train again"):
        load_learner(SimulatedResponses(dataset), other)


def test_a_run_keeps_to_its_data(dataset, run, configuration):
    other = SimulatedResponses(dataclasses.replace(dataset, seed=dataset.seed + 1))
    with pytest.raises(RunError, match="another scene or seed"):
        train(other, run, configuration, Progress(disable=True))
    with pytest.raises(RunError, match="another scene or seed"):
        load_learner(other, run)


def test_a_run_knows_where_its_data_lie(dataset, run):
    assert dataset_folder(run) == dataset.folder.resolve()


@pytest.mark.parametrize("content", [None, "{", "[]", '{"shape": {"rank": 1, "colour": 2}}', '{"seed": 1}'])
def test_what_is_no_run_says_so(tmp_path, content):
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    with pytest.raises(RunError, match=str(tmp_path)):
        Configuration.read(tmp_path)


def test_configuration_survives_its_file(run, configuration):
    assert Configuration.read(run) == configuration
    stored = json.loads((run / "run.json").read_text())
    assert stored["shape"]["rank"] == configuration.shape.rank
    assert stored["recipe"]["lessons"] == configuration.recipe.distilled_poses  # the name that earlier runs have


def test_targets_are_of_the_codec_of_the_data(dataset):
    codec = codec_of(dataset)
    assert (codec.sample_rate, codec.samples) == (dataset.sample_rate, dataset.samples)
    assert Cells(codec).fine_frames < codec.frames


@pytest.mark.parametrize(("examples", "batch"), [(100, 32), (12_800, 32), (12_801, 64), (30_000, 96)])
def test_an_epoch_of_many_pairs_has_larger_steps_and_not_more(examples, batch):
    assert configure("directional").examples_of_a_step(examples) == batch


def test_the_papers_network_has_the_papers_batch_however_many_responses_there_are():
    assert configure("naf").examples_of_a_step(1_000_000) == 20


@pytest.fixture
def naf_configuration():
    return Configuration.naf(
        NafShape(width=16, grid_features=4, grid_spacing_m=1.0), NafRecipe(points=30), epochs=3, batch=4
    )


def test_a_run_interrupted_within_an_epoch_goes_on_to_the_same_field(dataset, naf_configuration, tmp_path, monkeypatch):
    responses = SimulatedResponses(dataset)
    train(responses, tmp_path / "whole", naf_configuration, Progress(disable=True))
    # A checkpoint after every step; steps are counted by what they read.
    monkeypatch.setattr(train_module, "_CHECKPOINT_S", 0.0)
    losses_of, calls = NafLearner.losses, []

    def impatient(self, *given):
        calls.append(0)
        if len(calls) == 22:
            raise KeyboardInterrupt
        return losses_of(self, *given)

    with monkeypatch.context() as patch:
        patch.setattr(NafLearner, "losses", impatient)
        with pytest.raises(KeyboardInterrupt):
            train(responses, tmp_path / "pieces", naf_configuration, Progress(disable=True))
    reached = torch.load(tmp_path / "pieces" / "checkpoint.pt", weights_only=True)
    assert reached["epochs"] % 1 > 0
    train(responses, tmp_path / "pieces", naf_configuration, Progress(disable=True))
    whole, pieces = (load_learner(responses, tmp_path / name).field.state_dict() for name in ("whole", "pieces"))
    for name, values in whole.items():
        assert torch.equal(pieces[name], values), name
    assert losses(tmp_path / "pieces", "training") == losses(tmp_path / "whole", "training")


@pytest.mark.parametrize(
    "field",
    [
        "naf",
        *(pytest.param(f"naf-{name}", marks=pytest.mark.long) for name in ("whole", "dual", "no-grid", "time-domain")),
    ],
)
def test_every_variant_of_the_papers_network_learns(dataset, field, tmp_path):
    usual = configure(field, seed=1, epochs=30, batch=4, points=60, learning_rate=3e-3)
    small = dataclasses.replace(usual, shape=dataclasses.replace(usual.shape, width=32, grid_features=4))
    train(SimulatedResponses(dataset), tmp_path, small, Progress(disable=True))
    assert Configuration.read(tmp_path) == small
    assert small.name == field
    training = losses(tmp_path, "training")
    assert np.mean(training[-3:]) < 0.95 * training[0]


@pytest.fixture
def keep_time(monkeypatch):
    """Has a step and a look at a batch of what is held back take so many seconds; gives a list of those looks."""

    def keep_time(*, step_s, look_s):
        losses_of, clock, looks = FactorisedLearner.losses, SimpleNamespace(now_s=0.0), []

        def slow(self, *given):
            if torch.is_grad_enabled():
                clock.now_s += step_s
            else:
                clock.now_s += look_s
                looks.append(look_s)
            return losses_of(self, *given)

        monkeypatch.setattr(FactorisedLearner, "losses", slow)
        monkeypatch.setattr(Processes, "clock_s", lambda _: clock.now_s)
        return looks

    return keep_time


def test_minutes_end_a_run_and_count_over_its_pieces(dataset, configuration, tmp_path, keep_time):
    keep_time(step_s=0.0625, look_s=0.0)
    responses = SimulatedResponses(dataset)
    timed = dataclasses.replace(configuration, minutes=7.5 / 60)
    with pytest.raises(KeyboardInterrupt):
        train(responses, tmp_path, timed, Impatient(12))
    with pytest.raises(RunError, match=r"of 0\.125 minutes"):
        load_learner(responses, tmp_path)
    train(responses, tmp_path, timed, Progress(disable=True))
    np.testing.assert_allclose(losses(tmp_path, "seconds"), 7.5 * np.arange(1, 21) / 20, atol=0.0626)
    assert losses(tmp_path, "seconds")[-1] >= 7.5


@pytest.mark.parametrize(("look_s", "least_s"), [pytest.param(0.5, 40, marks=pytest.mark.long), (4.0, 15)])
def test_minutes_count_looks_at_what_is_held_back_and_every_round_trains(
    dataset, configuration, tmp_path, keep_time, look_s, least_s
):
    """Rounds of 3 s, and a look that takes less than one, or more."""
    looks = keep_time(step_s=0.25, look_s=look_s)
    train(
        SimulatedResponses(dataset), tmp_path, dataclasses.replace(configuration, minutes=1.0), Progress(disable=True)
    )
    state, logged_s = torch.load(tmp_path / CHECKPOINT, weights_only=False), losses(tmp_path, "seconds")
    trained_s = 0.25 * state["step"]
    assert state["seconds"] == pytest.approx(trained_s + sum(looks))
    assert logged_s[-1] == pytest.approx(state["seconds"])
    assert 60 <= state["seconds"] < 60 + 0.25 + sum(looks) / len(logged_s)
    assert trained_s >= least_s


def test_without_progress_on_what_is_held_back_a_run_stops_and_keeps_the_best(dataset, configuration, tmp_path):
    # With such a rate it only gets worse.
    hasty = dataclasses.replace(configuration, epochs=60, patience=3, learning_rate=0.05)
    train(SimulatedResponses(dataset), tmp_path, hasty, Progress(disable=True))
    sums = np.sum([losses(tmp_path, name) for name in ("fine", "late", "phasor", "interaural", "energy")], axis=0)
    assert len(sums) < 60
    assert np.argmin(sums) == len(sums) - 4
    learner = trained(dataset, tmp_path)
    learner.prepare(Progress(disable=True))
    _, held_back = split(learner.responses, share=1.0, seed=hasty.seed)
    inputs, targets = learner.batch(held_back, None)
    with torch.no_grad():
        found = sum(float(part) for part in learner.losses(learner.field(*inputs), targets).values())
    assert found == pytest.approx(sums.min(), rel=1e-3)


def test_a_run_pauses_when_its_time_is_over_and_goes_on_to_the_same_field(dataset, naf_configuration, tmp_path):
    responses = SimulatedResponses(dataset)
    train(responses, tmp_path / "whole", naf_configuration, Progress(disable=True))
    pieces = 0
    while not train(responses, tmp_path / "pieces", naf_configuration, Progress(disable=True), pause_after_s=0.02):
        pieces += 1
    assert pieces > 1
    whole, pieced = (load_learner(responses, tmp_path / name).field.state_dict() for name in ("whole", "pieces"))
    for name, values in whole.items():
        assert torch.equal(pieced[name], values), name


def test_a_run_that_moves_to_another_machine_chooses_its_precision_anew(
    dataset, naf_configuration, tmp_path, monkeypatch
):
    """A graphics card has units for bfloat16, and many a processor emulates it."""
    responses = SimulatedResponses(dataset)
    monkeypatch.setattr(train_module, "bfloat16_gains", lambda *_: True)
    with monkeypatch.context() as patch:
        patch.setattr(Processes, "machine", "a graphics card")
        assert not train(responses, tmp_path, naf_configuration, Progress(disable=True), pause_after_s=0.0)
    assert torch.load(tmp_path / CHECKPOINT, weights_only=True)["bfloat16"]
    monkeypatch.setattr(train_module, "bfloat16_gains", lambda *_: False)
    assert train(responses, tmp_path, naf_configuration, Progress(disable=True))
    assert not torch.load(tmp_path / CHECKPOINT, weights_only=True)["bfloat16"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_run_goes_from_a_gpu_to_the_processor_and_back(dataset, naf_configuration, tmp_path, monkeypatch):
    responses = SimulatedResponses(dataset)
    train(responses, tmp_path, naf_configuration, Progress(disable=True), pause_after_s=1.0)
    with monkeypatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)
        train(responses, tmp_path, naf_configuration, Progress(disable=True), pause_after_s=1.0)
    assert train(responses, tmp_path, naf_configuration, Progress(disable=True))
    assert np.isfinite(losses(tmp_path, "training")).all()


def test_minutes_are_of_the_processor_so_that_others_take_none_of_them(dataset, configuration, tmp_path):
    """The clock runs on while nothing is computed; the budget does not."""
    slept = []

    class Sleepy(Progress):
        def update(self, *arguments, **changes):
            super().update(*arguments, **changes)
            time.sleep(0.2)
            slept.append(0.2)

    began_s, began_cpu_s = time.monotonic(), time.process_time()
    timed = dataclasses.replace(configuration, minutes=1.0 / 60)
    train(SimulatedResponses(dataset), tmp_path, timed, Sleepy(disable=True))
    counted_s = torch.load(tmp_path / CHECKPOINT, weights_only=True)["seconds"]
    assert 1.0 <= counted_s <= time.process_time() - began_cpu_s
    assert time.monotonic() - began_s > counted_s + 0.9 * sum(slept)


@pytest.mark.parametrize("broken", ["loss", "gradient"])
def test_a_run_that_diverges_says_so_and_keeps_its_checkpoint(dataset, configuration, tmp_path, monkeypatch, broken):
    losses_of, calls = FactorisedLearner.losses, []

    def diverging(self, prediction, targets):
        calls.append(0)
        parts = losses_of(self, prediction, targets)
        if len(calls) > 40 and torch.is_grad_enabled():
            # Square roots are finite at zero, their derivatives are not.
            zero = prediction.sum() * 0
            parts["broken"] = zero + float("nan") if broken == "loss" else torch.sqrt(zero)
        return parts

    monkeypatch.setattr(FactorisedLearner, "losses", diverging)
    with pytest.raises(DivergedError, match="lower learning rate"):
        train(SimulatedResponses(dataset), tmp_path, configuration, Progress(disable=True))
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert state["epochs"] >= 1
    assert all(torch.isfinite(values).all() for values in state["field"].values())
    assert all(np.isfinite(losses(tmp_path, "training")))


TRAINING_OF_ARGUMENTS = """
import os, socket, sys, torch
from pathlib import Path
from rich.progress import Progress
from training.simulation.responses import open_responses
from training.learning.runs import Configuration
from training.learning import train as train_module
torch.set_num_threads(1)
train_module.bfloat16_gains = lambda *_: False
def go_on():
    run = Path(sys.argv[2])
    responses = open_responses(Path(sys.argv[1]))
    train_module.train(responses, run.parent / "two", Configuration.read(run), Progress(disable=True))
"""
AS_ONE_OF_TWO = "go_on()"
AS_BOTH = """
with socket.create_server(("127.0.0.1", 0)) as probe:
    port = str(probe.getsockname()[1])
os.environ.update(WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=port)
other = os.fork()
os.environ["RANK"] = os.environ["LOCAL_RANK"] = "0" if other else "1"
go_on()
if other:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(other, 0)[1]))
"""
"""What torchrun does, and imports are done once for both."""


@pytest.mark.parametrize(
    ("launcher", "start"),
    [
        pytest.param((), AS_BOTH, id="told by the environment"),
        pytest.param(
            ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"),
            AS_ONE_OF_TWO,
            id="by torchrun",
            marks=pytest.mark.long,
        ),
    ],
)
def test_two_processes_learn_what_one_does(dataset, configuration, tmp_path, launcher, start):
    """Half a batch each, gradients averaged: the same steps up to rounding."""
    script = tmp_path / "script.py"
    script.write_text(TRAINING_OF_ARGUMENTS + start)
    short = dataclasses.replace(configuration, epochs=2)
    train(SimulatedResponses(dataset), tmp_path / "one", short, Progress(disable=True))
    done = subprocess.run(
        [sys.executable, *launcher, script, dataset.folder, tmp_path / "one"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    one, two = (trained(dataset, tmp_path / name).field.state_dict() for name in ("one", "two"))
    for name, values in one.items():
        torch.testing.assert_close(two[name], values, rtol=1e-3, atol=2e-4, msg=name)
    for column in ("training", "fine", "late"):
        np.testing.assert_allclose(losses(tmp_path / "two", column), losses(tmp_path / "one", column), rtol=1e-3)


def test_tensorboard_shows_what_the_log_says(run, configuration):
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    assert set(events.Tags()["scalars"]) >= {"training/loss", "training/learning_rate", "held_back/fine"}
    for tag, column in (("training/loss", "training"), ("held_back/late", "late")):
        shown = events.Scalars(tag)
        assert len(shown) == configuration.epochs
        np.testing.assert_allclose([point.value for point in shown], losses(run, column), rtol=1e-4)


def test_bfloat16_is_chosen_where_it_is_faster():
    def taking(seconds):
        return lambda bfloat16: time.sleep(seconds[bfloat16])

    cpu = torch.device("cpu")
    assert bfloat16_gains(taking({False: 0.05, True: 0.02}), cpu)
    assert not bfloat16_gains(taking({False: 0.03, True: 0.029}), cpu)
    assert not bfloat16_gains(taking({False: 0.025, True: 0.2}), cpu)
    assert not bfloat16_gains(taking({False: 0.004, True: 0.001}), cpu)


@pytest.mark.parametrize(
    ("field", "options", "told"),
    [
        ("nerf", {}, "there is no 'nerf'"),
        ("naf", {"rank": 64}, "only a factorised or directional field"),
        ("directional", {"points": 100}, "whole responses"),
        ("directional", {"teacher": Path("run")}, "only a factorised field"),
        ("factorised", {"points": 100}, "whole responses"),
        ("naf", {"epochs": 3, "minutes": 1.0}, "in epochs or in minutes"),
    ],
)
def test_options_that_a_field_has_not_are_refused(field, options, told):
    with pytest.raises(RunError, match=told):
        configure(field, **options)


def test_swapped_ends_are_refused_where_a_head_listens(dataset, configuration, tmp_path):
    swapped = dataclasses.replace(configuration, recipe=FactorisedRecipe(swap=True))
    with pytest.raises(RecipeError, match="head"):
        train(SimulatedResponses(dataset), tmp_path, swapped, Progress(disable=True))
