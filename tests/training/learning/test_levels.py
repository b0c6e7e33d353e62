"""Fields of levels: learned, exported and measured as those of floor plans are, with storeys told apart."""

from pathlib import Path

import numpy as np
import pytest
import torch
from rich.progress import Progress

from server.acoustics.geometry import FloorPlan
from server.field.fields_by_level import FieldsByLevel
from server.responses.full_response import FullResponse
from server.scene.bundle import BUNDLED, Bundle
from training.baselines.held_out import open_held_out, require_same_scene
from training.bundling.export import export
from training.data.dataset import Dataset
from training.data.dataset_check import DatasetError
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile
from training.frontier.accuracy import SampledPairs
from training.learning.runs import RunError, configure
from training.learning.train import train
from training.models.encoders import FeatureGrid
from training.models.site import Extent, Site
from training.models.targets import codec_of
from training.parallel.jobs import open_jobs
from training.simulation.responses import SimulatedResponses
from training.simulation.run import simulate

APARTMENT = SceneFile.read(Path(__file__).resolve().parents[3] / "training/scenes/apartment.toml")
QUIET = Progress(disable=True)


def level() -> LevelScene:
    """The apartment as a mesh, with few probes and rays."""
    brief = {"rays": 300, "duration_s": 0.25, "arrival_directions": 6, "yaws": 1, "sample_rate": 16_000}
    few = {"spacing_m": 2.0, "wall_clearance_m": 0.3}
    settings = {
        "id": "level",
        "probes": APARTMENT.probes.model_copy(update=few),
        "simulation": APARTMENT.simulation.model_copy(update=brief),
    }
    return LevelScene.of_plan(APARTMENT.model_copy(update=settings))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    scene = tmp_path_factory.mktemp("level") / "scene"
    level().write(scene)
    folder = tmp_path_factory.mktemp("data") / "level"
    with open_jobs(None, threads=1) as jobs:
        return simulate(scene, folder, seed=3, jobs=jobs, progress=QUIET)


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert train(SimulatedResponses(dataset), folder, configure("directional", rank=16, width=32, epochs=4), QUIET)
    return folder


@pytest.fixture(scope="module")
def bundle(dataset, run, tmp_path_factory) -> Bundle:
    return export(SimulatedResponses(dataset), [run], tmp_path_factory.mktemp("bundle") / "level", checked=False)


def test_a_bundle_of_a_level_has_its_mesh_and_its_field(bundle, dataset):
    assert bundle.manifest.format_version == 4
    assert bundle.manifest.geometry is None
    assert bundle.mesh.to_bytes() == dataset.place.place.mesh.to_bytes()
    assert [field.predicts for field in bundle.manifest.fields.values()] == ["directions"]
    assert bundle.manifest.start == APARTMENT.start


def test_it_is_heard_as_one_hears_that_of_a_floor_plan(bundle):
    """Late sound is there behind the direct sound and the first reflections, and is finite."""
    field = FieldsByLevel.load(bundle).default
    start = bundle.manifest.start
    heard = FullResponse.through_kemar(field).impulse_responses([start.listener], [start.emitter], np.array([0.0]))[0]
    assert np.isfinite(heard).all()
    assert np.sum(heard[:, heard.shape[1] // 4 :] ** 2) > 0


def test_the_network_is_told_of_paths_in_the_mesh(dataset):
    site = Site.of(SimulatedResponses(dataset))
    listeners, emitters = dataset.probes[:4], dataset.probes[-4:]
    expected = dataset.place.surroundings.sound_paths(343.0).describe(listeners, emitters).described
    np.testing.assert_array_equal(site.paths(listeners, emitters), expected)
    assert site.extent.floors_m == (0.0,)
    assert site.extent.hides


def test_held_out_pairs_and_accuracy_are_of_the_level(dataset, bundle):
    with open_held_out(dataset.folder) as held_out:
        assert held_out.name == "level (simulated)"
        emitter, listener = dataset.pairs(held_out=True).T
        ends = dataset.probes[emitter], dataset.probes[listener]
        np.testing.assert_array_equal(held_out.visible, dataset.place.surroundings.is_visible(*ends))
    require_same_scene(bundle, dataset)
    sample = SampledPairs(dataset, codec_of(SimulatedResponses(dataset)), pairs=2, yaws=1, seed=0)
    assert sample.size == (2, 1)


def test_a_bundle_of_another_place_is_not_compared_with_it(dataset):
    with pytest.raises(DatasetError, match="is not of the scene of"):
        require_same_scene(Bundle.load(BUNDLED / "apartment"), dataset)


def test_a_run_is_on_its_own_level(run, tmp_path):
    """Also if only a mesh is another."""
    other = level()
    moved = LevelScene(other.file, other.mesh.only(np.arange(len(other.mesh.triangles)) != 0), ())
    with open_jobs(None, threads=1) as jobs:
        moved.write(tmp_path / "scene")
        changed = simulate(tmp_path / "scene", tmp_path / "data", seed=3, jobs=jobs, progress=QUIET)
    with pytest.raises(RunError, match="another scene or seed"):
        train(SimulatedResponses(changed), run, configure("directional", rank=16, width=32, epochs=4), QUIET)


class TestStoreys:
    LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([6.0, 5.0, 6.0])
    TWO = Extent(LOW, HIGH, hides=True, floors_m=(0.0, 3.0))

    def test_features_of_a_place_are_those_of_its_storey(self):
        grid = FeatureGrid(self.TWO, 0.5, 4)
        with torch.no_grad():
            grid._features.copy_(grid._nodes[:, 2:].expand(-1, 4))
            below, above = grid(torch.tensor([[2.2, 2.7, 1.6], [2.2, 2.7, 4.4]]))
        torch.testing.assert_close(below, torch.full((4,), 1.5), atol=1e-3, rtol=0)
        torch.testing.assert_close(above, torch.full((4,), 4.5), atol=1e-3, rtol=0)

    def test_a_floor_plan_has_one_grid_in_plan(self):
        plan = FloorPlan(((0, 0), (6, 0), (6, 5), (0, 5)), 3.0)
        flat = FeatureGrid(Extent.of_plan(plan), 0.5, 4)
        assert flat._nodes.shape == (13 * 11, 2)
        assert FeatureGrid(self.TWO, 0.5, 4)._nodes.shape == (2 * 13 * 11, 3)
