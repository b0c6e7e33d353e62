"""The smallest scene, simulated, trained and exported once for all tests."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from rich.progress import Progress

from server.health.check import Effort
from server.rendering import hrtf
from server.rendering.hrtf import HeadFilters
from server.scene.bundle import Bundle
from tests.once_a_run import once
from tests.training.held_out import make_held_out  # noqa: F401  a fixture
from tests.training.traced_once import traced_once
from training.bundling import export as export_module
from training.bundling import noise
from training.bundling.export import export
from training.data.dataset import Dataset
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile
from training.learning.runs import Configuration, claim
from training.learning.train import train
from training.models.encoders import FieldShape
from training.parallel.jobs import LocalJobs
from training.simulation import planner, trial
from training.simulation.level_predictions import LevelPredictions
from training.simulation.plan_predictions import PlanPredictions
from training.simulation.responses import SimulatedResponses
from training.simulation.run import simulate

TINY = Path(__file__).parents[1] / "data" / "tiny.toml"
CONFIGURATION = Configuration(
    epochs=20, batch=16, shape=FieldShape(rank=16, width=32, depth=2, grid_spacing_m=1.0, grid_features=4)
)


@pytest.fixture(scope="session")
def tiny_scene() -> Path:
    return TINY


@pytest.fixture(scope="session")
def apartment() -> SceneFile:
    return SceneFile.read(Path(__file__).parents[2] / "training" / "scenes" / "apartment.toml")


@pytest.fixture(scope="session")
def kemar() -> HeadFilters:
    return hrtf.kemar(24_000)


@pytest.fixture(scope="session")
def configuration() -> Configuration:
    return CONFIGURATION


@pytest.fixture(scope="session", autouse=True)
def brief_health_checks() -> Iterator[None]:
    """Enough to find what is wrong all over; exports are many here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "training.bundling.export.EFFORT", Effort(scattered=12, halved=2, climbing=1, responses=2, field_s=2.0)
        )
        yield


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Sums in parallel are not repeatable."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session", autouse=True)
def single_precision() -> Iterator[None]:
    """The clock decides between precisions, and on a busy machine not always alike."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("training.learning.train.bfloat16_gains", lambda *_: False)
        yield


@pytest.fixture(scope="session", autouse=True)
def _few_draws() -> Iterator[None]:
    """Of noise, for bundles that nobody listens to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(noise, "DRAWS", 2)
        yield


@pytest.fixture(scope="session", autouse=True)
def _traced_once(tmp_path_factory) -> Iterator[None]:
    """An export still compares what it writes with torch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export_module, "to_onnx", traced_once(export_module.to_onnx, tmp_path_factory))
        yield


@pytest.fixture(scope="session", autouse=True)
def _tried_once() -> Iterator[None]:
    """Predictions, whose trial takes a second, are kept for all plans of a scene and its probes: they follow from these
    and from the trial's effort alone. Trials of large scenes are large, so few are kept."""
    kept: dict[tuple[object, ...], PlanPredictions | LevelPredictions] = {}

    def predictions(scene: Any, probes: npt.NDArray[np.float64]) -> PlanPredictions | LevelPredictions:
        said = {name: value for name, value in scene.identity.items() if name != "effects"}
        key = json.dumps(said), probes.tobytes(), trial._OF_PLANS, trial._OF_LEVELS
        kind = LevelPredictions if isinstance(scene, LevelScene) else PlanPredictions
        found = kept.pop(key, None) or kind(scene, probes)
        if len(kept) == 4:
            del kept[next(iter(kept))]
        kept[key] = found  # the latest at the end
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "PlanPredictions", predictions)
        patch.setattr(planner, "LevelPredictions", predictions)
        yield


@pytest.fixture
def brief_trials() -> Iterator[None]:
    """Trials of few rays, for tests of what plans do whatever a trial finds."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("_OF_PLANS", "_OF_LEVELS"):
            effort = getattr(trial, name)
            fewer = {limit: getattr(effort, limit) // 4 for limit in ("first_hits", "most_hits")}
            patch.setattr(trial, name, replace(effort, emitters=effort.emitters // 2, **fewer))
        yield


def _copy(name: str, build: Callable[[Path], object], factory: pytest.TempPathFactory) -> Path:
    """What `build` makes once for all workers, for this one to work on."""
    return shutil.copytree(once(name, build, factory), factory.mktemp("tiny") / name)


@pytest.fixture(scope="session")
def _data_and_run(tmp_path_factory) -> Path:
    def build(folder: Path) -> None:
        made = simulate(TINY, folder / "data", seed=5, jobs=LocalJobs(1), progress=Progress(disable=True))
        train(SimulatedResponses(made), folder / "run", CONFIGURATION, Progress(disable=True))

    return _copy("trained", build, tmp_path_factory)


@pytest.fixture(scope="session")
def dataset(_data_and_run) -> Dataset:
    return Dataset.open(_data_and_run / "data")


@pytest.fixture(scope="session")
def run(_data_and_run, dataset) -> Path:
    claim(_data_and_run / "run", SimulatedResponses(dataset), CONFIGURATION)  # of this worker's copy of the data
    return _data_and_run / "run"


@pytest.fixture(scope="session")
def tiny_bundle(dataset, run, tmp_path_factory) -> Bundle:
    def build(folder: Path) -> None:
        export(SimulatedResponses(dataset), [run], folder / "bundle")

    return Bundle.load(_copy("exported", build, tmp_path_factory) / "bundle")
