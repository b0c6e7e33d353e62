"""Batches that a device makes of what it holds are those that the processor makes."""

import numpy as np
import pytest
import torch
from rich.progress import Progress

from training.learning.held import HeldTargets
from training.learning.naf import NafLearner
from training.learning.runs import Configuration, NafRecipe
from training.models.naf import NafShape
from training.simulation.responses import SimulatedResponses

CPU = torch.device("cpu")


def prepared(dataset, *, expected=False, domain="spectrogram") -> NafLearner:
    torch.manual_seed(0)
    shape = NafShape(width=8, grid_features=4, domain=domain)
    recipe = NafRecipe(points=60, expected=expected)
    learner = NafLearner(SimulatedResponses(dataset), Configuration.naf(shape, recipe))
    learner.prepare(Progress(disable=True))
    return learner


@pytest.mark.parametrize("kind", [{}, {"expected": True}, {"domain": "time"}])
def test_batches_are_the_same_wherever_they_are_made(dataset, kind):
    learner = prepared(dataset, **kind)
    rows = np.array([30, 2, 17])
    (*poses, _), (values, indices) = learner.batch(rows, np.random.default_rng(1))
    learner.hold(CPU)
    (*held_poses, _), (held, held_indices) = learner.batch(rows, np.random.default_rng(1))
    assert torch.equal(indices, held_indices)
    for one, other in zip(poses, held_poses, strict=True):
        assert torch.equal(one, other)
    assert held.shape == values.shape
    off = (held - values).abs()
    # Where there is all but silence, the phase is that of rounding.
    sounding = values[..., :1] > np.log(1e-3) if values.shape[-1] == 2 else torch.ones_like(off, dtype=torch.bool)
    turns = torch.minimum(off, (off - 2 * torch.pi).abs())
    assert turns[sounding.expand_as(turns)].max() < 2e-3
    assert off[..., 0].max() < 2e-3


def test_a_field_learns_as_well_from_what_is_held(dataset):
    learner = prepared(dataset)
    rows = np.arange(40)
    learner.initialise(rows, 0)

    @torch.no_grad()
    def loss() -> float:
        inputs, targets = learner.batch(rows[:8], np.random.default_rng(2))
        return float(torch.stack(list(learner.losses(learner.field(*inputs), targets).values())).sum())

    before = loss()
    learner.hold(CPU)
    assert loss() == pytest.approx(before, rel=0.01)


def test_measured_responses_are_not_held(dataset):
    learner = NafLearner(SimulatedResponses(dataset), Configuration.naf(NafShape(width=8), NafRecipe(points=5)))
    with pytest.raises(RuntimeError, match="as they are needed"):
        learner.hold(CPU)


def test_only_a_gpu_with_room_holds_anything(monkeypatch):
    flat = np.zeros((10, 100), np.float16)
    assert not HeldTargets.fit(flat, CPU)
    free = {"bytes": 2 * flat.nbytes}
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free["bytes"], 0))
    assert HeldTargets.fit(flat, torch.device("cuda", 0))
    free["bytes"] -= 1
    assert not HeldTargets.fit(flat, torch.device("cuda", 0))
