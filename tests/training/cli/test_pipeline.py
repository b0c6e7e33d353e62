"""From a scene file to sound: simulate, train, export, load, hear, serve."""

import dataclasses
import io
import re
import time

import numpy as np
import pytest
import soundfile
from rich.progress import Progress
from starlette.testclient import TestClient

from server.acoustics.decibels import power_to_db
from server.api.app import create_app
from server.api.settings import Settings
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.responses.full_response import FullResponse
from training.bundling.export import export
from training.evaluation.run import evaluate_bundles
from training.learning.train import train
from training.parallel.jobs import LocalJobs
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses
from training.simulation.run import simulate


@pytest.fixture(scope="module")
def tiny_field(tiny_bundle):
    return AcousticField.load(tiny_bundle)


def level_db(response):
    return power_to_db(np.sum(np.asarray(response, dtype=np.float64) ** 2, axis=-1))


def test_responses_are_finite_and_arrive_in_time(tiny_field, dataset):
    plan, bounds = dataset.plan, tiny_field.bundle.manifest.bounds
    rng = np.random.default_rng(0)
    ends = rng.uniform(bounds.minimum, bounds.maximum, (2, 30, 3))
    responses = tiny_field.impulse_responses(*ends, rng.uniform(-np.pi, np.pi, 30))
    assert responses.shape == (30, 2, dataset.samples)
    assert np.isfinite(responses).all()
    assert (level_db(responses) > -40).all()
    arrives = plan.path_length_m(*ends) / 343 * dataset.sample_rate
    for response, sample in zip(responses, arrives, strict=True):
        np.testing.assert_array_equal(response[:, : int(sample)], 0)


def test_the_ear_towards_the_emitter_is_louder(tiny_field):
    listener, emitter = (2.0, 1.0, 1.5), (2.0, 2.4, 1.5)  # due north
    whole = FullResponse.through_kemar(tiny_field)
    facing_east, facing_west = level_db(whole.impulse_responses([listener] * 2, [emitter] * 2, [0.0, np.pi]))
    assert facing_east[0] > facing_east[1] + 1
    assert facing_west[1] > facing_west[0] + 1


def test_it_is_louder_nearby(tiny_field):
    emitter = (0.8, 0.8, 1.5)
    whole = FullResponse.through_kemar(tiny_field)
    near, far = level_db(
        whole.impulse_responses([(1.6, 0.9, 1.5), (3.4, 2.4, 1.5)], [emitter] * 2, [np.pi, np.pi])
    ).mean(axis=-1)
    assert near > far + 1


def test_levels_are_those_of_the_simulation(tiny_field, dataset):
    pairs = dataset.pairs(held_out=True)
    differences = []
    for emitter, listener in pairs:
        reference = References(dataset).reflected(emitter, listener)
        shape = (len(dataset.yaws), 3)
        predicted = tiny_field.impulse_responses(
            np.broadcast_to(dataset.probes[listener], shape),
            np.broadcast_to(dataset.probes[emitter], shape),
            dataset.yaws,
        )
        differences.append(level_db(predicted) - level_db(reference))
    assert np.abs(np.mean(differences)) < 3


def test_a_field_of_a_room_without_reflections_is_silent(tiny_scene, configuration, tmp_path):
    """Open air: the direct sound is all there is, and the field has none of it."""
    scene = tmp_path / "open_air.toml"
    scene.write_text(re.sub(r"absorption = .*", f"absorption = {[1.0] * 7}", tiny_scene.read_text()))
    progress = Progress(disable=True)
    dataset = simulate(scene, tmp_path / "data", seed=0, jobs=LocalJobs(1), progress=progress)
    responses = SimulatedResponses(dataset)
    train(responses, tmp_path / "run", dataclasses.replace(configuration, epochs=1), progress)
    field = AcousticField.load(export(responses, [tmp_path / "run"], tmp_path / "bundle"))
    ends = np.random.default_rng(0).uniform((0.5, 0.5, 1.2), (3.5, 2.5, 1.8), (2, 20, 3))
    assert (level_db(field.impulse_responses(*ends, np.zeros(20))) < -60).all()


def test_evaluation_reports_every_metric(tiny_field, dataset):
    evaluation, _ = evaluate_bundles([tiny_field.bundle], dataset.folder)
    assert evaluation.pairs == len(dataset.pairs(held_out=True))
    summaries = evaluation.of("standard").summaries
    assert all(summaries[name].mean is not None for name in ("t60", "c50"))


def test_the_server_serves_it(tiny_field):
    query = {"listener": "2,1,1.5", "emitter": "2,2.4,1.5", "yaw_deg": 90}
    with TestClient(create_app(Settings(ir_workers=1), scenes={"tiny": FieldsByLevel([tiny_field])})) as client:
        for _ in range(200):
            if client.get("/readyz").status_code == 200:
                break
            time.sleep(0.05)
        answer = client.get("/v1/scenes/tiny/impulse-response", params={**query, "format": "wav"})
    assert answer.status_code == 200
    samples, rate = soundfile.read(io.BytesIO(answer.content), dtype="float32")
    assert rate == tiny_field.sample_rate
    whole = FullResponse.through_kemar(tiny_field)
    expected = whole.impulse_responses([(2, 1, 1.5)], [(2, 2.4, 1.5)], [np.pi / 2])[0]
    np.testing.assert_allclose(samples.T, expected, atol=1e-6)
