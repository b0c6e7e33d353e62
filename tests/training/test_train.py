import csv
import dataclasses
import json

import numpy as np
import pytest
import torch
from rich.progress import Progress

from training.models.cells import Cells
from training.models.targets import codec_of, load_targets
from training.responses import SimulatedResponses
from training.runs import Configuration, RunError, dataset_folder
from training.train import load_learner, train


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


def test_learning_beats_the_mean_of_all_poses(dataset, run, tmp_path):
    learner = trained(dataset, run)
    field, responses = learner.field, SimulatedResponses(dataset)
    targets = load_targets(responses, learner.cells, tmp_path, Progress(disable=True))
    flat = torch.from_numpy(np.asarray(targets.flat, dtype=np.float32))
    with torch.no_grad():
        poses = (torch.from_numpy(part) for part in (targets.listener, targets.emitter, targets.yaw))
        predicted = field.in_physical_units(field(*poses))
    for name in ("fine", "phasor"):
        part = field.heads.slices[name]
        error = (predicted - flat)[:, part].square().mean()
        assert error < 0.95 * (flat - flat.mean(dim=0))[:, part].square().mean(), name


def test_corrected_levels_carry_the_power_of_the_training_set(dataset, run, tmp_path):
    """Pooled over the whole set, predicted power is the targets' where the field's log would be too low."""
    learner = trained(dataset, run)
    field, responses = learner.field, SimulatedResponses(dataset)
    targets = load_targets(responses, learner.cells, tmp_path, Progress(disable=True))
    flat = torch.from_numpy(np.asarray(targets.flat, dtype=np.float32))
    with torch.no_grad():
        poses = (torch.from_numpy(part) for part in (targets.listener, targets.emitter, targets.yaw))
        predicted = field.in_physical_units(field(*poses))
    part = field.heads.slices["late"]
    raw, corrected, true = (
        level[:, part].double().mul(2).exp().sum() for level in (predicted, predicted + field.level_correction, flat)
    )
    assert abs(torch.log(corrected / true)) < abs(torch.log(raw / true))
    assert torch.log(corrected / true).abs() < 0.1
    for name in ("phasor", "interaural"):
        assert not field.level_correction[field.heads.slices[name]].any()


@pytest.mark.parametrize("change", [{"seed": 1}, {"epochs": 21}, {"learning_rate": 1e-3}])
def test_a_run_keeps_to_its_configuration(dataset, run, configuration, change):
    with pytest.raises(RunError, match="another configuration"):
        train(SimulatedResponses(dataset), run, dataclasses.replace(configuration, **change), Progress(disable=True))


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
    assert json.loads((run / "run.json").read_text())["shape"]["rank"] == configuration.shape.rank


def test_targets_are_of_the_codec_of_the_data(dataset):
    codec = codec_of(dataset)
    assert (codec.sample_rate, codec.samples) == (dataset.sample_rate, dataset.samples)
    assert Cells(codec).fine_frames < codec.frames
