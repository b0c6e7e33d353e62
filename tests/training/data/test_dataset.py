import threading
import time
from dataclasses import replace

import h5py
import numpy as np
import pytest
from rich.progress import Progress

from training.data.dataset import TAKES, Dataset, DatasetError, own_duration_s
from training.data.scene_file import HISTOGRAM_BIN_S
from training.data.shared_tail import FADE_S, TRAINING, SharedTail
from training.data.simulation_plan import SimulationPlan
from training.parallel.jobs import LocalJobs
from training.simulation.run import prepared, simulate

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
def test_energies_read_are_those_simulated_with_the_tail_that_all_share(dataset, take):
    """Held-out pairs share that of the take, and pairs to train on their own."""
    simulation = resimulated(dataset)
    assert simulation.tail is not None
    emitter, _ = dataset.pairs(held_out=True)[0]
    number = TAKES.index(take)
    listeners = (np.delete(np.arange(len(dataset.probes)), emitter), np.flatnonzero(dataset.held_out[emitter]))[number]
    tails = [number if held_out else TRAINING for held_out in dataset.held_out[emitter, listeners]]
    assert len(set(tails)) == 2 - number
    own = simulation.energies(emitter, listeners, number)
    drawn = np.stack([simulation.tail.join(*of_pair) for of_pair in zip(tails, own, strict=True)])
    found = dataset.read_energy(np.column_stack([np.full_like(listeners, emitter), listeners]), take)
    assert found.shape[-1] == dataset.scene.simulation.histogram_bins
    np.testing.assert_allclose(found, drawn, rtol=0.01)


def test_late_energies_of_held_out_pairs_are_in_no_training_pair(dataset):
    """Of one room, where late sound is the same at all places: equally loud, and traced with other rays."""
    late = round((dataset.effects.tail_start_s + FADE_S) / HISTOGRAM_BIN_S) + 1
    trained, first = (dataset.read_energy(dataset.pairs(held_out=held_out)) for held_out in (False, True))
    second = dataset.read_energy(dataset.pairs(held_out=True), TAKES[1])
    tails = [energies[:, :, :, late:] for energies in (trained, first, second)]
    for energies in tails:
        assert (energies == energies[:1]).all()
    levels = [10 * np.log10(energies[0].sum(axis=0, dtype=float) + 1e-30) for energies in tails]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        heard = levels[one] > levels[one].max() - 30
        assert (levels[one] != levels[other])[heard].mean() > 0.99
        np.testing.assert_allclose(tails[one][0].sum(), tails[other][0].sum(), rtol=0.2)


def test_files_of_earlier_versions_have_one_tail_for_all_pairs_of_a_take(dataset):
    old = replace(dataset)
    old.__dict__["tail"] = SharedTail(dataset.tail.start_s, dataset.tail.energies[: len(TAKES)])
    late = np.stack([old.read_energy(old.pairs(held_out=held_out)[:1])[0, ..., -20:] for held_out in (False, True)])
    np.testing.assert_array_equal(*late)


def test_no_response_is_stored_and_a_tail_that_all_share_once(dataset, tiny_scene, tmp_path):
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        assert set(file) == {"done", "held_out", "log_energy", "probes", "tail", "yaws"}
        assert file["log_energy"].shape[-1] < 0.4 * dataset.scene.simulation.histogram_bins
        assert set(file["tail"]) == {"energies", "start_s"}
    whole = Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    with h5py.File(whole.folder / "pairs.h5", "r") as file:
        assert file["log_energy"].shape[-1] == whole.scene.simulation.histogram_bins
        assert "tail" not in file


def test_halves_of_the_held_out_pairs_have_no_couple_in_common_and_are_all(dataset):
    choice, report = (dataset.held_out_half(half).tolist() for half in ("choice", "report"))
    assert sorted(choice + report) == dataset.pairs(held_out=True).tolist()
    couples = [{tuple(sorted(pair)) for pair in half} for half in (choice, report)]
    assert not couples[0] & couples[1]
    assert all([listener, emitter] in half for half in (choice, report) for emitter, listener in half)
    assert len(couples[1]) - len(couples[0]) in (0, 1)


def test_a_single_couple_is_in_both_halves(dataset):
    held_out = np.zeros_like(dataset.held_out)
    held_out[1, 2] = held_out[2, 1] = True
    single = replace(dataset, held_out=held_out)
    assert all(single.held_out_half(half).tolist() == [[1, 2], [2, 1]] for half in ("choice", "report"))


def test_of_the_second_take_only_held_out_pairs_are_stored(dataset):
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        logarithms = file["log_energy"][()]
    is_there = np.isfinite(logarithms).any(axis=(3, 4, 5))
    np.testing.assert_array_equal(is_there[0], ~np.eye(len(dataset.probes), dtype=bool))
    np.testing.assert_array_equal(is_there[1], dataset.held_out)


def test_what_is_a_receivers_own_lasts_until_the_tail_has_set_in(dataset):
    own_s = own_duration_s(dataset.scene, dataset.effects)
    assert 0 <= own_s - (dataset.effects.tail_start_s + FADE_S) < HISTOGRAM_BIN_S
    assert own_duration_s(dataset.scene, EVERYTHING) == dataset.scene.simulation.duration_s


def test_takes_are_traced_independently_and_agree_on_the_level(dataset):
    pairs = dataset.pairs(held_out=True)
    first, second = (dataset.read_energy(pairs, take).astype(float) for take in TAKES)
    assert not np.array_equal(first, second)
    assert np.sum(first) == pytest.approx(np.sum(second), rel=0.3)


def test_an_interrupted_simulation_goes_on_to_the_same_data(dataset, tiny_scene, tmp_path):
    folder, progress = tmp_path / "data", Impatient(2)
    with pytest.raises(KeyboardInterrupt):
        simulate(tiny_scene, folder, seed=dataset.seed, jobs=LocalJobs(2), progress=progress)
    assert time.monotonic() - progress.lost_at < 15
    assert not any(thread.name.startswith("nafir-job") for thread in threading.enumerate())
    with pytest.raises(DatasetError, match="4 emitters are not simulated yet"):
        Dataset.open(folder)

    resumed = simulate(tiny_scene, folder, seed=dataset.seed, jobs=LocalJobs(1), progress=Progress(disable=True))
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


@pytest.mark.parametrize(("earlier", "told"), [(2, "the first reflections too"), (4, "responses of one head")])
def test_a_dataset_of_an_earlier_format_is_refused_with_what_it_holds(tiny_scene, tmp_path, earlier, told):
    Dataset.create(tmp_path, tiny_scene, 0, EVERYTHING)
    with h5py.File(tmp_path / "pairs.h5", "r+") as file:
        file.attrs["format"] = earlier
    with pytest.raises(DatasetError, match=f"holds {told}, expected 5 to 7: simulate into an empty"):
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
