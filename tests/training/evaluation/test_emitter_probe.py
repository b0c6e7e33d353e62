import json

import numpy as np
import pytest
import torch
from PIL import Image
from rich.progress import Progress

from training.baselines.held_out import EvaluationError
from training.evaluation.emitter_probe import (
    MFCC,
    TRAINED,
    UNTRAINED,
    explained_variance,
    hidden_features,
    probe_emitters,
)
from training.evaluation.emitter_probe_figure import draw_emitter_probe
from training.learning.runs import Configuration, NafRecipe
from training.learning.train import load_learner, train
from training.models.naf import NafShape
from training.simulation.responses import SimulatedResponses

SHAPE = NafShape(width=16, layers=4, grid_spacing_m=1.0, grid_features=4)


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("naf")
    configuration = Configuration.naf(SHAPE, NafRecipe(points=10), epochs=1)
    with Progress(disable=True) as progress:
        train(SimulatedResponses(dataset), folder, configuration, progress)
    return folder


@pytest.fixture(scope="module")
def probed(run, dataset):
    return probe_emitters(run, dataset.folder, spacing_m=0.4, points=8)


def test_readers_are_fitted_at_a_tenth_as_many_places_as_they_are_tested_at(probed):
    assert probed.fitted == round(0.1 * len(probed.cells))
    assert list(probed.reads) == [TRAINED, UNTRAINED, MFCC]
    x, y = probed.cells[:, 0], probed.cells[:, 1]
    np.testing.assert_allclose(probed.true_m, np.min([x, 4 - x, y, 3 - y], axis=0))


def test_controls_see_the_same_places(probed):
    """All three are tested on the same distances; the trained network and the untrained differ."""
    assert len({read.distance_m.shape for read in probed.reads.values()}) == 1
    assert not np.allclose(probed.reads[TRAINED].distance_m, probed.reads[UNTRAINED].distance_m)
    for read in probed.reads.values():
        assert read.explained == pytest.approx(explained_variance(probed.true_m, read.distance_m))


def test_features_are_what_the_last_layer_reads(run, dataset):
    """They are averages, one listener after another; the last layer makes of them the average of its answers."""
    field = load_learner(SimulatedResponses(dataset), run).field
    emitters, listeners = dataset.probes[:3], dataset.probes[-3:]
    found = hidden_features(field, emitters, listeners, 6, seed=1)
    assert found.shape == (3, 3 * SHAPE.width)
    rng = np.random.default_rng([1, 17])
    indices = [torch.from_numpy(rng.integers(0, size, 6))[None] for size in field.axes]
    ends = [torch.tensor(end[None], dtype=torch.float32) for end in (listeners[2], emitters[1])]
    with torch.no_grad():
        answer = field(*ends, torch.zeros(1), *indices).mean(dim=(1, 2))[0]
        linear = field.last(torch.tensor(found[1, 2 * SHAPE.width : 3 * SHAPE.width], dtype=torch.float32))
    torch.testing.assert_close(linear, answer, rtol=1e-3, atol=1e-4)


def test_an_offset_explains_no_less_variance():
    true = np.arange(10.0)
    assert explained_variance(true, true + 3.0) == 1.0
    assert explained_variance(true, np.zeros(10)) == 0.0


def test_what_was_decoded_is_told_and_drawn(probed, tmp_path):
    told = json.loads(json.dumps(probed.to_json(), allow_nan=False))
    assert told["explained_variance"].keys() == {TRAINED, UNTRAINED, MFCC}
    draw_emitter_probe(probed, tmp_path / "probe.png")
    with Image.open(tmp_path / "probe.png") as picture:
        assert min(picture.size) > 200


def test_other_fields_are_refused(dataset, tmp_path, configuration):
    with Progress(disable=True) as progress:
        train(SimulatedResponses(dataset), tmp_path, configuration, progress)
    with pytest.raises(EvaluationError, match="holds no naf"):
        probe_emitters(tmp_path, dataset.folder)
