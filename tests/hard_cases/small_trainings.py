"""Trainings of seconds, on a few responses measured in a row."""

import numpy as np
import pytest
import torch
from rich.progress import Progress

from tests.training.conftest import one_thread, single_precision  # noqa: F401 - else not repeatable
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement
from training.learning.runs import Configuration, NafRecipe
from training.learning.train import load_learner, train
from training.models.encoders import FieldShape
from training.models.naf import NafShape

RATE, SAMPLES = 8_000, 1_200
FACTORISED = Configuration(
    epochs=3, batch=4, shape=FieldShape(rank=4, width=16, depth=2, grid_spacing_m=1.0, grid_features=4)
)
NAF = Configuration.naf(NafShape(width=16), NafRecipe(points=40), epochs=3, batch=4)
KINDS = pytest.mark.parametrize(
    "configuration", [pytest.param(FACTORISED, id="factorised"), pytest.param(NAF, id="naf")]
)
GRID = [((float(x), float(y), 1.5), (1.4, 1.6, 1.2)) for x in range(4) for y in range(3)]


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
