"""Scenes made on two nodes, one of which is killed in the middle, beside the same scenes made in one process."""

import dataclasses
import hashlib
import subprocess
import sys
from collections import Counter

import h5py
import pytest
from rich.progress import Progress

pytest.importorskip("ray", reason="needs Ray: make cluster-test installs it")

from tests.ray_nodes import ray_nodes
from training.data.dataset import Dataset
from training.evaluation.ablation import ablate
from training.evaluation.run import evaluate_bundles
from training.frontier.candidates import candidates
from training.frontier.sweep import HALVES, Effort, _accuracies, _sample
from training.learning.on_cluster import train_on_cluster
from training.learning.runs import FactorisedRecipe
from training.learning.train import load_checkpoint, train
from training.parallel.jobs import open_jobs
from training.parallel.ray_jobs import ClusterError, connected
from training.simulation.responses import SimulatedResponses
from training.simulation.run import simulate

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]

SILENT = Progress(disable=True)
METHODS = ("nearest", "mean-spectrogram", "image-sources")


class Fatal(Progress):
    """Kills a node of the cluster when some progress was made."""

    def __init__(self, cluster, steps: int) -> None:
        super().__init__(disable=True)
        self.cluster, self.steps = cluster, steps

    def advance(self, *_, **__):
        self.steps -= 1
        if not self.steps:
            self.cluster.remove_node(next(iter(self.cluster.worker_nodes)), allow_graceful=False)


@pytest.fixture(scope="module")
def cluster():
    with ray_nodes(1, 1) as nodes:
        yield nodes


@pytest.fixture
def jobs(cluster):
    with open_jobs(cluster.address, threads=1) as opened:
        yield opened


def digests(dataset: Dataset) -> dict[str, str]:
    """By array of the file."""
    found = {}
    with h5py.File(dataset.folder / "pairs.h5") as file:
        file.visititems(
            lambda name, item: (
                found.update({name: hashlib.sha256(item[()].tobytes()).hexdigest()})
                if isinstance(item, h5py.Dataset)
                else None
            )
        )
    return found


def test_a_scene_has_equal_hashes_although_a_node_was_killed(dataset, tiny_scene, tmp_path, monkeypatch):
    written: Counter[int] = Counter()
    write = Dataset.write

    def counted(self, emitter, takes):
        written[emitter] += 1
        write(self, emitter, takes)

    monkeypatch.setattr(Dataset, "write", counted)
    with ray_nodes(1, 1) as nodes, open_jobs(nodes.address, threads=1) as jobs:
        made = simulate(tiny_scene, tmp_path / "data", seed=dataset.seed, jobs=jobs, progress=Fatal(nodes, 2))
        assert not nodes.worker_nodes
    assert written == dict.fromkeys(range(len(dataset.probes)), 1)
    assert digests(made) == digests(dataset)


def test_a_table_is_that_of_one_process_and_goes_on_where_it_was(dataset, tiny_bundle, jobs, tmp_path):
    options = {"methods": METHODS, "yaws": 2, "draws": 2}
    here, _ = evaluate_bundles([tiny_bundle], dataset.folder, **options)
    keep = tmp_path / "table.partial"

    def interrupted(steps, doing):
        for number in steps:
            if doing == "evaluating" and number == 3:
                raise KeyboardInterrupt
            yield number

    with pytest.raises(KeyboardInterrupt):
        evaluate_bundles([tiny_bundle], dataset.folder, **options, keep=keep, jobs=jobs, track=interrupted)
    assert len(keep.read_text().splitlines()) > 1
    there, _ = evaluate_bundles([tiny_bundle], dataset.folder, **options, keep=keep, jobs=jobs)
    for ours, theirs in zip(here.results, there.results, strict=True):
        assert ours.name == theirs.name
        for metric, errors in ours.errors.items():
            assert errors.tobytes() == theirs.errors[metric].tobytes(), (ours.name, metric)


def test_errors_of_levels_are_those_of_one_process(dataset, tiny_bundle, jobs, tmp_path):
    levels, effort = candidates(tiny_bundle)[:2], Effort(pairs=4, yaws=2)
    trial = dataclasses.replace(tiny_bundle, manifest=tiny_bundle.manifest.model_copy(update={"levels": tuple(levels)}))
    samples = {half: _sample(dataset, trial, half, effort) for half in HALVES}
    from training.parallel.jobs import ALL_CORES

    here, there = (
        _accuracies(trial, samples, levels, tmp_path / name, effort, of, SILENT)
        for name, of in (("here", ALL_CORES), ("there", jobs))
    )
    for name, by_half in here.items():
        for half, errors in by_half.items():
            assert errors.errors == there[name][half].errors
            assert errors.steps == there[name][half].steps
            assert errors.by_pair.tobytes() == there[name][half].by_pair.tobytes()


def test_an_ablation_is_that_of_one_process(dataset, configuration, jobs, tmp_path):
    short = dataclasses.replace(configuration, epochs=2)
    both = {
        "as it is": short,
        "no level correction": dataclasses.replace(short, recipe=FactorisedRecipe(level_correction=False)),
    }
    responses = SimulatedResponses(dataset)
    here = ablate(responses, tmp_path / "here", both, SILENT)
    assert ablate(responses, tmp_path / "there", both, SILENT, jobs=jobs) == here


def test_two_workers_train_as_one_process_with_the_same_batch(dataset, configuration, cluster, tmp_path):
    short = dataclasses.replace(configuration, epochs=4)
    responses = SimulatedResponses(dataset)
    train(responses, tmp_path / "here", short, SILENT)
    train_on_cluster(cluster.address, dataset.folder, tmp_path / "there", short, workers=2)
    here, there = (load_checkpoint(tmp_path / name, "cpu") for name in ("here", "there"))
    assert there["finished"]
    assert here["step"] == there["step"]
    for (step, ours), (same, theirs) in zip(here["curve"], there["curve"], strict=True):
        assert step == same
        assert theirs == pytest.approx(ours, rel=2e-3)
    assert not (tmp_path / "there" / "ray").exists()
    with pytest.raises(ClusterError, match="--workers: 9 workers take a core each, and the cluster has 2"):
        train_on_cluster(cluster.address, dataset.folder, tmp_path / "there", short, workers=9)


def test_the_command_takes_an_address(cluster, dataset, tiny_scene, tmp_path):
    command = [
        sys.executable,
        "-m",
        "training",
        "simulate",
        tiny_scene,
        "-o",
        tmp_path / "data",
        "--seed",
        dataset.seed,
    ]
    done = subprocess.run(
        [str(part) for part in [*command, "--cluster", cluster.address]],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert digests(Dataset.open(tmp_path / "data")).keys() == digests(dataset).keys()


def test_where_no_cluster_answers_the_address_is_told() -> None:
    told = pytest.raises(ClusterError, match=r"--cluster: no Ray cluster answers at 127\.0\.0\.9:1")
    with told, connected("127.0.0.9:1"):
        pass
