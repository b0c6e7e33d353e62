"""One value that cannot be, in any array of a dataset: told as it is opened, in a line that names the pair."""

import shutil

import h5py
import numpy as np
import pytest

from training.cli.main import main
from training.data.dataset import Dataset
from training.data.dataset_check import DatasetError
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement, ResponsesError
from training.simulation.responses import open_responses


@pytest.fixture
def spoilt(dataset, tmp_path):
    """A copy with one value changed; gives its folder."""

    def change(name, at, value):
        folder = tmp_path / "spoilt"
        shutil.copytree(dataset.folder, folder)
        with h5py.File(folder / "pairs.h5", "r+") as file:
            file[name][at] = value
        return folder

    return change


def pair_of(dataset, *, held_out):
    emitter, listener = dataset.pairs(held_out=held_out)[-1]
    return int(emitter), int(listener)


@pytest.mark.parametrize("value", [np.nan, np.inf, 81.0])
@pytest.mark.parametrize("take", [0, 1])
def test_an_energy_that_cannot_be_is_told_with_its_pair(dataset, spoilt, take, value):
    emitter, listener = pair_of(dataset, held_out=take == 1)
    folder = spoilt("log_energy", (take, emitter, listener, 2, 3, 4), value)
    told = rf"pairs\.h5: log_energy: the pair of emitter {emitter} and listener {listener} has energies that are not"
    for opened in (Dataset.open, open_responses):
        with pytest.raises(DatasetError, match=told):
            opened(folder)


def test_energies_that_are_stored_otherwise_are_told(spoilt):
    folder = spoilt("yaws", 0, 0)
    with h5py.File(folder / "pairs.h5", "r+") as file:
        energies = file["log_energy"][()]
        del file["log_energy"]
        file["log_energy"] = energies
    with pytest.raises(DatasetError, match=r"log_energy: is not stored pair by pair; simulate"):
        Dataset.open(folder)


def test_no_energy_is_an_energy(dataset, spoilt):
    emitter, listener = pair_of(dataset, held_out=False)
    Dataset.open(spoilt("log_energy", (0, emitter, listener, 2, 3, 4), -np.inf))


@pytest.mark.parametrize(
    ("name", "at", "value", "told"),
    [
        ("tail/energies", (0, 0, 0, 0), -1.0, r"tail\.energies: has values that are negative"),
        ("tail/energies", (0, 0, 0, 0), np.nan, r"tail\.energies"),
        ("tail/start_s", (), -0.1, r"tail\.start_s"),
        ("probes", (0, 0), np.nan, "probes"),
        ("yaws", (0,), np.inf, "yaws"),
    ],
)
def test_what_all_pairs_share_is_looked_at_too(spoilt, name, at, value, told):
    with pytest.raises(DatasetError, match=told):
        Dataset.open(spoilt(name, at, value))


@pytest.mark.parametrize("name", ["log_energy", "held_out", "probes", "yaws", "tail/energies"])
def test_arrays_of_another_shape_are_named(dataset, tmp_path, name):
    shutil.copytree(dataset.folder, tmp_path / "spoilt")
    with h5py.File(tmp_path / "spoilt" / "pairs.h5", "r+") as file:
        kept = file[name][...]
        del file[name]
        file[name] = kept[:, :-1] if kept.ndim > 3 else kept[..., :-1]
    with pytest.raises(DatasetError, match=rf"{name.replace('/', '.')}: has shape"):
        Dataset.open(tmp_path / "spoilt")


@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_commands_end_in_that_one_line(dataset, spoilt, tiny_bundle, tmp_path, monkeypatch, capfd, command):
    emitter, listener = pair_of(dataset, held_out=command == "evaluate")
    folder = spoilt("log_energy", (0, emitter, listener, 0, 0, 0), np.nan)
    arguments = [folder, "-o", tmp_path / "run"] if command == "train" else [tiny_bundle.folder, folder]
    monkeypatch.setattr("sys.argv", ["nafir-train", command, *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    err = capfd.readouterr().err
    assert "Traceback" not in err
    assert f"log_energy: the pair of emitter {emitter} and listener {listener}" in err.strip().splitlines()[-1]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_imported_response_that_is_no_number_is_told_with_its_row_and_ends(tmp_path, value):
    rows = [Measurement((0.0, 0.0, 1.0), (float(x), 2.0, 1.0), np.ones((1, 400), np.float32), 16_000) for x in range(9)]
    ImportedDataset.write(tmp_path, rows, ImportReport(), layout="raf", source="room")
    with h5py.File(tmp_path / "responses.h5", "r+") as file:
        file["responses"][7, 0, 399] = value
    told = r"responses: row 7 \(listener \[0\.0, 0\.0, 1\.0\], emitter \[7\.0, 2\.0, 1\.0\]\) has samples that are not"
    with pytest.raises(ResponsesError, match=told):
        open_responses(tmp_path)
