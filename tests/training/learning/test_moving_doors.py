"""Fields of levels whose doors move: simulated and learned in states drawn at random, measured in others."""

from dataclasses import replace
from pathlib import Path
from shutil import copytree, ignore_patterns

import h5py
import numpy as np
import pytest
import torch
from rich.progress import Progress

from server.acoustics.decibels import power_to_db
from server.acoustics.mesh import TriangleMesh
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle
from tests.two_rooms import BEFORE, BEHIND, SWING, WOOD, door, leaf, rooms
from training.baselines.held_out import open_held_out, require_same_scene
from training.bundling.export import export
from training.data.dataset import Dataset
from training.data.dataset_check import DatasetError
from training.data.door_states import DoorStates, alike
from training.data.levels.level_scene import LevelFile, LevelGeometry, LevelScene, SceneDoor
from training.data.scene_file import SceneFile
from training.evaluation.fields import field_columns
from training.frontier.accuracy import Estimate, SampledPairs
from training.learning.directional import DirectionalLearner
from training.learning.pairs import split
from training.learning.runs import RecipeError, configure
from training.learning.train import load_learner, train
from training.models.site import Site
from training.models.targets import codec_of
from training.parallel.jobs import open_jobs
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses
from training.simulation.run import simulate
from training.simulation.tracing import RoomTracer

APARTMENT = SceneFile.read(Path(__file__).resolve().parents[3] / "training/scenes/apartment.toml")
QUIET = Progress(disable=True)
SETTINGS = {"rays": 200, "duration_s": 0.25, "arrival_directions": 6, "yaws": 1, "sample_rate": 16_000}


def level(openness: float = 1.0) -> LevelScene:
    """Two rooms with a heavy door between them, with few probes and rays."""
    place = rooms()
    moves = SceneDoor(**door(SWING, openness=openness), surface_mass_kg_m2=120.0)
    file = LevelFile(
        id="rooms",
        name="Two rooms",
        description="",
        geometry=LevelGeometry(mesh="geometry.npz", materials={**place.materials, "wood": WOOD}, doors=(moves,)),
        start={"listener": BEFORE, "emitter": BEHIND},
        probes=APARTMENT.probes.model_copy(update={"spacing_m": 1.6, "wall_clearance_m": 0.3}),
        simulation=APARTMENT.simulation.model_copy(update=SETTINGS),
    )
    return LevelScene(file, place.mesh, (leaf(),))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("rooms")
    level().write(folder / "scene")
    with open_jobs(None, threads=1) as jobs:
        return simulate(folder / "scene", folder / "data", seed=3, jobs=jobs, progress=QUIET)


@pytest.fixture(scope="module")
def bundle(dataset, tmp_path_factory) -> Bundle:
    folder = tmp_path_factory.mktemp("run")
    configuration = configure("directional", rank=16, width=32, epochs=30)
    assert train(SimulatedResponses(dataset), folder, configuration, QUIET)
    return export(SimulatedResponses(dataset), [folder], folder / "bundle", checked=False)


@pytest.fixture(scope="module")
def fewer(tmp_path_factory) -> Dataset:
    folder, whole = tmp_path_factory.mktemp("some"), level()
    simulation = whole.simulation.model_copy(update={"listeners": 8})
    file = whole.file.model_copy(update={"simulation": simulation})
    LevelScene(file, rooms().mesh, (leaf(),)).write(folder / "scene")
    with open_jobs(None, threads=1) as jobs:
        return simulate(folder / "scene", folder / "data", seed=3, jobs=jobs, progress=QUIET)


def emitter_with(dataset: Dataset, openness: float) -> int:
    return int(np.argmin(np.abs(dataset.states.openness[:, 0] - openness)))


class TestStates:
    def test_they_are_the_same_for_the_same_seed_and_from_shut_to_open(self):
        one, same, other = (DoorStates.of(level(), 100, seed) for seed in (1, 1, 2))
        np.testing.assert_array_equal(one.openness, same.openness)
        assert (one.openness != other.openness).any()
        assert one.openness.min() == 0
        assert one.openness.max() == 1
        assert len(alike(one.openness)) > 12

    @pytest.mark.parametrize("seed", range(20))
    def test_no_emitter_that_is_trained_on_has_an_unseen_state(self, seed):
        states = DoorStates.of(level(), 60, seed)
        assert 0 < states.unseen.sum() < 20
        seen = {share for (share,) in states.openness[~states.unseen].tolist()}
        assert not seen & {share for (share,) in states.openness[states.unseen].tolist()}

    def test_pairs_are_held_out_whose_emitter_is_unseen(self):
        states = DoorStates.of(level(), 60, 0)
        held_out = states.held_out(np.random.default_rng(0))
        assert not held_out[~states.unseen].any()
        assert 0.4 < held_out[states.unseen].mean() < 0.6
        assert not held_out.diagonal().any()

    def test_a_scene_without_doors_has_none(self):
        still = replace(level(), doors=())
        assert DoorStates.of(still, 5, 0).openness.shape == (5, 0)
        assert not DoorStates.of(APARTMENT, 5, 0).unseen.any()


def test_pairs_in_unseen_states_are_not_trained_on(dataset):
    trained, held_out = dataset.trained, dataset.held_out
    assert not (trained & held_out).any()
    assert not trained[dataset.states.unseen].any()
    assert held_out[dataset.states.unseen].any()
    assert not (trained & held_out.T).any()
    responses = SimulatedResponses(dataset)
    learner = DirectionalLearner(responses, configure("directional", rank=16, width=32, epochs=1))
    told = {share for (share,) in learner._openness.tolist()}
    unseen = dataset.states.openness[dataset.states.unseen].astype(np.float32)
    assert not told & {share for (share,) in unseen.tolist()}
    assert len(learner._openness) == trained.sum()


def test_a_power_that_is_known_one_way_is_learned_both_ways(dataset):
    """Since sound is as loud the other way; where it comes from there is not known."""
    responses = SimulatedResponses(dataset)
    configuration = configure("directional", rank=16, width=32, epochs=1)
    learner = DirectionalLearner(
        responses, replace(configuration, recipe=replace(configuration.recipe, noise_m=0.0, openness_noise=0.0))
    )
    learner.prepare(QUIET)
    rows, validation = split(responses, share=1.0, seed=0)
    (listener, emitter, path, openness), (flat, knows_directions) = learner.batch(rows, np.random.default_rng(0))
    trained = np.flatnonzero(~responses.held_out)[rows]
    true_ends = responses.listener[trained].astype(np.float32), responses.emitter[trained].astype(np.float32)
    exchanged = knows_directions.numpy() == 0
    assert 0.4 < exchanged.mean() < 0.6
    for found, same, other in ((listener, *true_ends), (emitter, *true_ends[::-1])):
        np.testing.assert_array_equal(found, np.where(exchanged[:, None], other, same))
    np.testing.assert_array_equal(openness, responses.openness[trained].astype(np.float32))
    np.testing.assert_array_equal(path, learner.site.paths(listener.numpy(), emitter.numpy(), openness.numpy()))
    _, (as_they_are, known) = learner.batch(rows, None)
    np.testing.assert_array_equal(flat, as_they_are)
    assert known.all()

    prediction = learner.field(listener, emitter, path, openness).detach()
    directions = learner.field.heads.slices["directions"]
    elsewhere = flat.clone()
    elsewhere[exchanged, directions] += 1.0
    before, after = (learner.losses(prediction, (each, knows_directions)) for each in (flat, elsewhere))
    assert before == after
    assert learner.losses(prediction, (elsewhere, known))["directions"] > before["directions"]
    assert learner.batch(validation, None)[1][1].all()


def test_the_network_is_told_of_doors_ajar_with_noise(dataset):
    """With less where they are nearly shut or open, and of those that are as they are; what it is told of paths is of
    where the doors are."""
    responses = SimulatedResponses(dataset)
    learner = DirectionalLearner(responses, configure("directional", rank=16, width=32, epochs=1))
    learner.prepare(QUIET)
    rows, _ = split(responses, share=1.0, seed=0)
    true = responses.openness[np.flatnonzero(~responses.held_out)[rows]].astype(np.float32)
    (listener, emitter, path, openness), _ = learner.batch(rows, np.random.default_rng(0))
    ajar = (true > 0) & (true < 1)
    off = openness.numpy() - true
    assert not off[~ajar].any()
    assert 0.04 < (off[ajar] / (4 * true[ajar] * (1 - true[ajar]))).std() < 0.06
    assert 0 < openness.numpy()[ajar].min() < openness.numpy()[ajar].max() < 1
    np.testing.assert_array_equal(path, learner.site.paths(listener.numpy(), emitter.numpy(), true))
    np.testing.assert_array_equal(learner.batch(rows, None)[0][3], true)


def test_a_run_that_pauses_after_every_step_leaves_out_the_same_features(dataset, tmp_path):
    responses = SimulatedResponses(dataset)
    configuration = configure("directional", rank=8, width=16, epochs=1, batch=16)
    assert train(responses, tmp_path / "whole", configuration, QUIET)
    pauses = 0
    while not train(responses, tmp_path / "paused", configuration, QUIET, pause_after_s=0.0):
        pauses += 1
    assert pauses > 2
    whole, paused = (load_learner(responses, tmp_path / name).field for name in ("whole", "paused"))
    for name, values in whole.state_dict().items():
        torch.testing.assert_close(paused.state_dict()[name], values, rtol=0, atol=0)
    told = [torch.from_numpy(each[:1].astype(np.float32)) for each in (responses.listener, responses.emitter)]
    path, openness = torch.zeros(1, 6), torch.ones(1, 1)
    assert torch.equal(whole(*told, path, openness), whole(*told, path, openness))
    whole.train()
    assert not torch.equal(whole(*told, path, openness), whole(*told, path, openness))


def test_a_field_is_told_of_paths_that_a_server_finds(dataset, bundle):
    site = Site.of(SimulatedResponses(dataset))
    pairs = np.argwhere(dataset.trained)[::7]
    emitter, listener = dataset.probes[pairs[:, 0]], dataset.probes[pairs[:, 1]]
    openness = dataset.states.openness[pairs[:, 0]].astype(np.float32)
    found = site.paths(listener, emitter, openness)
    for number in range(0, len(pairs), 5):
        there = bundle.with_doors(tuple(openness[number].tolist())).surroundings.sound_paths(343.0)
        described = there.describe(listener[number : number + 1], emitter[number : number + 1]).described
        np.testing.assert_allclose(found[number : number + 1], described, atol=1e-4)


def test_a_large_level_has_fewer_states():
    small = level()
    large = TriangleMesh.joined([small.mesh] * (100_000 // len(small.mesh.triangles)))
    counts = [len(alike(DoorStates.of(replace(small, mesh=mesh), 200, 0).openness)) for mesh in (small.mesh, large)]
    assert counts[1] <= 32 < counts[0]


def test_energies_are_of_the_state_of_their_emitter(dataset):
    """Each is what the tracer says of its state, to the precision in which it is stored."""
    for share in (0.0, 1.0):
        emitter = emitter_with(dataset, share)
        listeners = np.flatnonzero(dataset.trained[emitter] | dataset.held_out[emitter])
        stored = dataset.read_energy(np.column_stack([np.full(len(listeners), emitter), listeners])).sum(axis=(1, 2, 3))
        state = level(float(dataset.states.openness[emitter, 0]))
        tracer = RoomTracer.of(state, dataset.effects, dataset.probes[listeners], duration_s=0.25)
        rng = np.random.default_rng([dataset.seed, 2, emitter, 0])
        traced = tracer.energy(dataset.probes[emitter], rays=dataset.effects.rays, rng=rng).sum(axis=(1, 2, 3))
        np.testing.assert_allclose(stored, traced, rtol=1e-3)


class TestSomeListeners:
    """Each emitter is heard at some of the probes only."""

    def test_no_other_pair_is_simulated_or_trained_on(self, fewer):
        heard = fewer.heard
        assert len(heard) > 9
        assert (heard.sum(axis=1) == 8).all()
        assert not heard.diagonal().any()
        assert not (fewer.trained | fewer.held_out)[~heard].any()
        with h5py.File(fewer.folder / "pairs.h5") as file:
            assert file.attrs["format"] == 7
            there = np.isfinite(file["log_energy"][()]).any(axis=(3, 4, 5))
        np.testing.assert_array_equal(there, [fewer.trained | fewer.held_out, fewer.held_out])

    def test_it_is_read_learned_from_and_evaluated_like_any(self, fewer, tmp_path):
        again = Dataset.open(fewer.folder)
        np.testing.assert_array_equal(again.heard, fewer.heard)
        responses = SimulatedResponses(again)
        assert len(np.unique(responses.pair)) == (fewer.trained | fewer.held_out).sum()
        assert train(responses, tmp_path, configure("directional", rank=8, width=16, epochs=1), QUIET)
        with open_held_out(fewer.folder) as held_out:
            assert len(held_out) == fewer.held_out.sum()
            assert np.isfinite(held_out.reference(0)).all()

    def test_a_mask_of_another_shape_is_refused(self, fewer, tmp_path):
        copy = tmp_path / "data"
        copytree(fewer.folder, copy, ignore=ignore_patterns("targets"))
        with h5py.File(copy / "pairs.h5", "r+") as file:
            del file["heard"]
            file["heard"] = fewer.heard[:3]
        with pytest.raises(DatasetError, match="heard: has shape"):
            Dataset.open(copy)


def test_direct_sound_and_onset_are_of_that_state(dataset):
    shut, wide = emitter_with(dataset, 0.0), emitter_with(dataset, 1.0)
    assert dataset.states.openness[shut, 0] == 0
    for emitter in (shut, wide):
        state = level(float(dataset.states.openness[emitter, 0]))
        expected_s = state.path_length_m(dataset.probes[emitter], dataset.probes) / 343.0
        np.testing.assert_allclose(dataset.onset_s[emitter], expected_s)
        pairs = np.column_stack([np.full(len(dataset.probes), emitter), np.arange(len(dataset.probes))])
        sees = state.surroundings.is_visible(dataset.probes[emitter], dataset.probes)
        np.testing.assert_array_equal(dataset.is_visible(pairs), sees)


def test_no_probe_is_where_the_leaf_passes(dataset):
    for share in np.linspace(0, 1, 41):
        tree = level(float(share)).surroundings.tree
        assert tree.distance_m(dataset.probes).min() > 0.2


def test_a_file_says_its_format_and_bad_openness_is_refused(dataset, tmp_path):
    with h5py.File(dataset.folder / "pairs.h5") as file:
        assert file.attrs["format"] == 6
    copy = tmp_path / "data"
    copy.mkdir()
    for path in dataset.folder.iterdir():
        if path.is_file():
            (copy / path.name).write_bytes(path.read_bytes())
    np.testing.assert_array_equal(Dataset.open(copy).states.openness, dataset.states.openness)
    with h5py.File(copy / "pairs.h5", "r+") as file:
        file["openness"][2, 0] = 1.5
    with pytest.raises(DatasetError, match="openness: is not from 0 to 1"):
        Dataset.open(copy)


def test_a_bundle_has_leaves_that_move_and_a_field_that_knows_them(bundle, dataset):
    assert [each.name for each in bundle.doors] == ["between"]
    assert [field.doors for field in bundle.manifest.fields.values()] == [("between",)]
    require_same_scene(bundle, dataset)


def test_less_reverberation_comes_through_a_door_that_is_shut(bundle):
    fields = FieldsByLevel.load(bundle)
    ends = [(6.5, 1.2, 1.5)], [(1.5, 4.0, 1.5)]
    levels_db = []
    for share in (0.0, 1.0):
        heard = fields.with_doors((share,)).default.impulse_responses(*ends, np.zeros(1))
        assert np.isfinite(heard).all()
        levels_db.append(power_to_db(np.sum(heard.astype(np.float64) ** 2) + 1e-12))
    assert levels_db[0] < levels_db[1] - 6


def test_errors_are_measured_in_the_state_of_each_pair(bundle, dataset):
    """Direct sound and first reflections, which no field predicts, are those of the state."""
    sample = SampledPairs(dataset, codec_of(SimulatedResponses(dataset)), pairs=6, yaws=1, seed=0)
    estimate, references = Estimate(FieldsByLevel.load(bundle).default), References(dataset)
    with open_held_out(dataset.folder) as held_out:
        (column,) = field_columns([bundle], held_out)
        for entry in sample.entries:
            index = next(
                index
                for index in range(len(held_out))
                if (held_out.emitters[index] == entry.emitter).all()
                and (held_out.listeners[index] == entry.listener).all()
            )
            assert held_out.openness(index) == entry.openness
            heard = estimate(entry)
            np.testing.assert_allclose(column.source(index, np.array([0])), heard, atol=1e-6)
            number = int(held_out.held_out[index])
            if dataset.is_visible(np.array([divmod(number, len(dataset.probes))]))[0]:
                direct = references.geometric(number)
                peak = np.unravel_index(np.argmax(np.abs(direct)), direct.shape)
                np.testing.assert_allclose(heard[peak], direct[peak], rtol=0.3)


@pytest.mark.parametrize("kind", ["factorised", "naf"])
def test_fields_that_are_not_told_of_doors_are_refused(dataset, kind, tmp_path):
    with pytest.raises(RecipeError, match="not told of them: train directional"):
        train(SimulatedResponses(dataset), tmp_path, configure(kind), QUIET)
