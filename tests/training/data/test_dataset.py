import threading
import time
from dataclasses import replace

import h5py
import numpy as np
import pytest
from rich.progress import Progress

from training.data.dataset import SPEED_OF_SOUND, TAKES, Dataset, DatasetError, own_duration_s
from training.data.shared_tail import FADE_S
from training.data.simulation_plan import SimulationPlan
from training.simulation.run import prepared, simulate
from training.simulation.tracing import RoomTracer

EVERYTHING = SimulationPlan.everything(2, 500)


class Impatient(Progress):
    """Interrupts, as Ctrl-C does, after so many emitters."""

    def __init__(self, patience):
        super().__init__(disable=True)
        self._patience = patience

    def advance(self, *arguments):
        super().advance(*arguments)
        self._patience -= 1
        if self._patience == 0:
            self.lost_at = time.monotonic()
            raise KeyboardInterrupt


def stored(folder):
    arrays = {}
    with h5py.File(folder / "pairs.h5", "r") as file:
        file.visititems(lambda name, item: arrays.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return arrays


def resimulated(dataset):
    return prepared(dataset.scene, seed=dataset.seed, plan=dataset.effects)


def test_couples_are_held_out_in_both_directions(dataset):
    np.testing.assert_array_equal(dataset.held_out, dataset.held_out.T)
    assert not np.diag(dataset.held_out).any()


def test_the_share_held_out_is_that_of_the_scene(dataset):
    probes = len(dataset.probes)
    couples = probes * (probes - 1) / 2
    assert dataset.held_out.sum() / 2 == round(dataset.scene.simulation.held_out_share * couples)
    trained, held_out = (len(dataset.pairs(held_out=held_out)) for held_out in (False, True))
    assert trained + held_out == probes * (probes - 1)


@pytest.mark.parametrize("take", TAKES)
def test_what_is_read_is_what_was_simulated_with_the_tail_that_all_share(dataset, take):
    simulation = resimulated(dataset)
    assert simulation.tail is not None
    emitter, _ = dataset.pairs(held_out=True)[0]
    listeners = np.flatnonzero(dataset.held_out[emitter])
    everyone = np.delete(np.arange(len(dataset.probes)), emitter)
    number = TAKES.index(take)
    drawn = {listener: whole for listener, _, whole in simulation.take(emitter, (everyone, listeners)[number], number)}
    found = dataset.read(np.column_stack([np.full_like(listeners, emitter), listeners]), take)
    for listener, response in zip(listeners, found, strict=True):
        np.testing.assert_array_equal(response, drawn[listener])


def test_energies_read_are_those_simulated(dataset):
    simulation = resimulated(dataset)
    everyone = np.arange(1, len(dataset.probes))
    drawn = np.stack([energy for _, energy, _ in simulation.take(0, everyone, 0)])
    found = dataset.read_energy(np.column_stack([np.zeros_like(everyone), everyone]))
    np.testing.assert_allclose(found, drawn, rtol=0.01)


def test_a_tail_that_all_share_is_stored_once(dataset, tiny_scene, tmp_path):
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        assert file["reflected"].shape[-1] < 0.4 * dataset.samples
        assert file["tail/noise"].shape[1:] == (2 * len(dataset.yaws), 2 * dataset.sample_rate)
    whole = Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    with h5py.File(whole.folder / "pairs.h5", "r") as file:
        assert file["reflected"].shape[-1] == whole.samples
        assert "tail" not in file


def test_what_is_a_receivers_own_outlasts_its_images(dataset):
    settings = dataset.scene.simulation
    own_s = own_duration_s(dataset.scene, dataset.effects)
    assert dataset.effects.tail_start_s + FADE_S <= own_s < settings.duration_s
    plan = replace(dataset.effects, image_order=5)
    tracer = RoomTracer.of(dataset.scene, plan, dataset.probes)
    images = zip(tracer.images(dataset.probes[0]), dataset.probes, strict=True)
    latest_m = max(np.linalg.norm(positions - place, axis=-1).max() for (positions, _), place in images)
    assert latest_m / SPEED_OF_SOUND < own_duration_s(dataset.scene, plan)


def test_second_takes_share_the_mirrors_and_not_the_noise(dataset):
    pairs = dataset.pairs(held_out=True)
    first, second = (dataset.read(pairs, name).astype(float) for name in ("reflected", "repeats"))
    assert not np.array_equal(first, second)
    for (emitter, listener), one, other in zip(pairs, first, second, strict=True):
        onset = round(dataset.onset_s[emitter, listener] * dataset.sample_rate)
        # Mirrors in two walls are heard this early here, between what is diffuse.
        head = slice(onset, onset + round(0.008 * dataset.sample_rate))
        assert np.corrcoef(one[..., head].ravel(), other[..., head].ravel())[0, 1] > 0.2
        tail = slice(onset + 800, None)
        assert abs(np.corrcoef(one[..., tail].ravel(), other[..., tail].ravel())[0, 1]) < 0.2
    # Independent simulations of one room agree on its level.
    assert np.sum(first**2) == pytest.approx(np.sum(second**2), rel=0.3)


def test_an_interrupted_simulation_goes_on_to_the_same_data(dataset, tiny_scene, tmp_path):
    folder, progress = tmp_path / "data", Impatient(2)
    with pytest.raises(KeyboardInterrupt):
        simulate(tiny_scene, folder, seed=dataset.seed, workers=2, progress=progress)
    assert time.monotonic() - progress.lost_at < 15
    assert not any(thread.name.startswith("simulate") for thread in threading.enumerate())
    with pytest.raises(DatasetError, match="4 emitters are not simulated yet"):
        Dataset.open(folder)

    resumed = simulate(tiny_scene, folder, seed=dataset.seed, workers=1, progress=Progress(disable=True))
    assert resumed.remaining() == []
    whole, pieced = stored(dataset.folder), stored(folder)
    assert whole.keys() == pieced.keys()
    for name, values in whole.items():
        np.testing.assert_array_equal(pieced[name], values, err_msg=name)


def test_a_start_interrupted_halfway_can_be_repeated(tiny_scene, tmp_path):
    (tmp_path / "scene.toml").write_text("half a fi")
    (tmp_path / "pairs.partial").write_bytes(b"\x89HDF")
    dataset = Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    assert dataset.remaining() == list(range(len(dataset.probes)))


def test_a_folder_keeps_to_its_scene_and_seed(dataset, tiny_scene, tmp_path):
    with pytest.raises(DatasetError, match="another scene or seed"):
        Dataset.create(dataset.folder, tiny_scene, dataset.seed + 1, dataset.effects)
    other = tmp_path / "other.toml"
    other.write_text(tiny_scene.read_text().replace("rays = 500", "rays = 501"))
    with pytest.raises(DatasetError, match="another scene or seed"):
        Dataset.create(dataset.folder, other, dataset.seed, dataset.effects)


def test_a_folder_keeps_to_the_plan_it_was_begun_by(tiny_scene, tmp_path):
    Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    fewer = SimulationPlan.everything(2, 400)
    with pytest.raises(DatasetError, match="another plan of effects"):
        Dataset.create(tmp_path, tiny_scene, 0, fewer)
    reasoned = replace(EVERYTHING, cost_s=1.5)  # the same data, whatever they were said to cost
    assert Dataset.create(tmp_path, tiny_scene, 0, reasoned).effects == EVERYTHING


def test_a_dataset_from_before_plans_has_everything_but_bent_sound(tiny_scene, tmp_path):
    Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    with h5py.File(tmp_path / "pairs.h5", "r+") as file:
        del file.attrs["effects"]
    assert Dataset.open(tmp_path, finished=False).effects == replace(EVERYTHING, diffraction=False)


def test_a_dataset_from_when_every_pair_had_its_tail_is_read_and_not_gone_on_with(tiny_scene, tmp_path):
    dataset = Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    response = np.random.default_rng(0).standard_normal((len(dataset.yaws), 2, dataset.samples)).astype(np.float16)
    with h5py.File(tmp_path / "pairs.h5", "r+") as file:
        file.attrs["format"] = 3
        del file["tail_begin"]
        file["reflected"][0, 1] = response
    opened = Dataset.open(tmp_path, finished=False)
    np.testing.assert_array_equal(opened.read(np.array([[0, 1]]))[0], response.astype(np.float32))
    with pytest.raises(DatasetError, match="was begun in format 3; choose an empty folder"):
        Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)


def test_a_dataset_that_holds_the_first_reflections_is_refused_by_name(tiny_scene, tmp_path):
    Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    with h5py.File(tmp_path / "pairs.h5", "r+") as file:
        file.attrs["format"] = 2
    with pytest.raises(DatasetError, match="holds the first reflections too, expected 4: simulate into an empty"):
        Dataset.open(tmp_path, finished=False)


@pytest.mark.parametrize("damage", ["missing", "empty", "truncated", "format"])
def test_what_is_no_dataset_says_so(tiny_scene, tmp_path, damage):
    Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    path = tmp_path / "pairs.h5"
    if damage == "missing":
        path.unlink()
    elif damage == "format":
        with h5py.File(path, "r+") as file:
            file.attrs["format"] = 99
    else:
        path.write_bytes(b"" if damage == "empty" else path.read_bytes()[:500])
    with pytest.raises(DatasetError, match=str(tmp_path)):
        Dataset.open(tmp_path, finished=False)
