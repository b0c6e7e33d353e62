from dataclasses import replace

import h5py
import numpy as np
import pytest

from training.data.dataset import DatasetError
from training.data.importers.report import ImportReport
from training.data.responses import (
    FILE,
    ImportedDataset,
    Measurement,
    ResponsesError,
    choose_held_out,
)
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses, open_responses

RATE = 8000


def measurements(points=6, yaws=(0.0, 1.0), *, channels=2, seed=3):
    """Every point heard from every other, of lengths that differ."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(0, 5, (points, 3))
    for e, emitter in enumerate(positions):
        for r, listener in enumerate(positions):
            if e != r:
                for yaw in yaws:
                    response = rng.standard_normal((channels, int(rng.integers(20, 60)))).astype(np.float32)
                    yield Measurement(tuple(listener), tuple(emitter), response, RATE, yaw)


def imported(folder, rows=None, **options):
    rows = measurements() if rows is None else rows
    return ImportedDataset.write(folder, rows, ImportReport(), layout="test", source="somewhere", **options)


def test_what_is_imported_is_read_back(tmp_path):
    rows = list(measurements())
    written = imported(tmp_path, rows, seed=4)
    for responses in (written, open_responses(tmp_path)):
        assert (responses.sample_rate, responses.channels) == (RATE, 2)
        assert responses.samples == max(row.response.shape[1] for row in rows)
        np.testing.assert_array_equal(responses.listener, [row.listener for row in rows])
        np.testing.assert_array_equal(responses.emitter, [row.emitter for row in rows])
        np.testing.assert_array_equal(responses.yaw, [row.yaw for row in rows])
        assert responses.report.read == len(rows)
        chosen = [7, 2, 2, len(rows) - 1]
        for row, response in zip(chosen, responses.read(chosen), strict=True):
            given = rows[row].response
            np.testing.assert_array_equal(response[:, : given.shape[1]], given)
            assert not response[:, given.shape[1] :].any()


def test_rows_of_a_pair_differ_in_yaw_only(tmp_path):
    responses = imported(tmp_path)
    assert responses.pair.max() + 1 == 6 * 5
    for pair in range(6 * 5):
        rows = responses.pair == pair
        assert sorted(responses.yaw[rows]) == [0.0, 1.0]
        assert len(np.unique(responses.listener[rows], axis=0)) == len(np.unique(responses.emitter[rows], axis=0)) == 1


def test_sound_arrives_after_the_time_it_takes(tmp_path):
    rows = [Measurement((3.43, 0.0, 0.0), (0.0, 0.0, 0.0), np.ones((1, 4), np.float32), RATE)] * 2
    assert imported(tmp_path, rows).onset_s == pytest.approx(0.01)


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_couples_of_points_are_held_out_whole(tmp_path, share):
    responses = imported(tmp_path, held_out_share=share, seed=1)
    assert len(np.unique(responses.pair[responses.held_out])) == 2 * round(share * 15)
    held = {
        (tuple(emitter), tuple(listener))
        for emitter, listener, out in zip(responses.emitter, responses.listener, responses.held_out, strict=True)
        if out
    }
    kept = {
        (tuple(emitter), tuple(listener))
        for emitter, listener, out in zip(responses.emitter, responses.listener, responses.held_out, strict=True)
        if not out
    }
    assert held == {(listener, emitter) for emitter, listener in held}
    assert not held & kept


def test_another_seed_holds_out_others(tmp_path):
    first, same, other = (imported(tmp_path, seed=seed, held_out_share=0.4).held_out for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, same)
    assert (first != other).any()


def test_one_couple_is_trained_on_and_no_share_holds_out_none():
    emitter, listener = np.zeros((1, 3)), np.ones((1, 3))
    assert not choose_held_out(emitter, listener, 0.5, 0).any()
    ends = np.random.default_rng(0).uniform(size=(2, 9, 3))
    assert not choose_held_out(*ends, 0.0, 0).any()


def test_an_import_replaces_an_earlier_one_whole_or_not_at_all(tmp_path):
    before = imported(tmp_path)

    def interrupted():
        yield from list(measurements(seed=8))[:3]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        imported(tmp_path, interrupted())
    np.testing.assert_array_equal(ImportedDataset.open(tmp_path).read([0]), before.read([0]))
    after = imported(tmp_path, measurements(points=3, seed=8))
    assert len(after.yaw) == 12


def test_a_simulation_is_not_overwritten(dataset):
    with pytest.raises(DatasetError, match="simulated"):
        imported(dataset.folder)


@pytest.mark.parametrize(
    ("change", "field"),
    [({"sample_rate": 2 * RATE}, "sample_rate"), ({"response": np.ones((1, 4), np.float32)}, "channels")],
)
def test_measurements_must_be_alike(tmp_path, change, field):
    rows = list(measurements())
    with pytest.raises(ResponsesError, match=f"somewhere: {field}: .* in row 5"):
        imported(tmp_path, [*rows[:5], replace(rows[5], **change)])


def test_an_import_of_nothing_says_why(tmp_path):
    report = ImportReport()
    report.skip("a.wav", "empty file")
    with pytest.raises(ResponsesError, match=r"responses: none could be read \(1 empty file\)"):
        ImportedDataset.write(tmp_path, [], report, layout="test", source="somewhere")
    with pytest.raises(ResponsesError, match=r"no such file; nafir-train simulate .* import"):
        ImportedDataset.open(tmp_path)


@pytest.mark.parametrize("name", ["responses", "listener", "emitter", "yaw", "held_out"])
@pytest.mark.parametrize("damage", ["missing", "shape"])
def test_damaged_fields_are_named(tmp_path, name, damage):
    imported(tmp_path)
    with h5py.File(tmp_path / FILE, "r+") as file:
        content = file.pop(name)[()]
        if damage == "shape":
            file[name] = content[:-1, ..., None]
    with pytest.raises(ResponsesError, match=f"{FILE}: {name}: "):
        ImportedDataset.open(tmp_path)


@pytest.mark.parametrize(
    ("attribute", "value"), [("format", 99), ("report", "{}"), ("report", "no"), ("sample_rate", 0)]
)
def test_damaged_attributes_are_named(tmp_path, attribute, value):
    imported(tmp_path)
    with h5py.File(tmp_path / FILE, "r+") as file:
        file.attrs[attribute] = value
    with pytest.raises(ResponsesError, match=f"{FILE}: {attribute}: "):
        ImportedDataset.open(tmp_path)


def test_poses_must_be_finite(tmp_path):
    imported(tmp_path)
    with h5py.File(tmp_path / FILE, "r+") as file:
        file["emitter"][2, 1] = np.nan
    with pytest.raises(ResponsesError, match="emitter: has values that are not finite"):
        ImportedDataset.open(tmp_path)


@pytest.mark.parametrize("content", [b"", b"no HDF5"])
def test_what_is_no_hdf5_says_so(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(ResponsesError, match=f"{FILE}: file: "):
        ImportedDataset.open(tmp_path)


def test_a_report_survives_its_storage(tmp_path):
    report = ImportReport()
    for name in "abcd":
        report.skip(name, "empty")
    report.skip("table", "no partner", count=7)
    report.note("ears swapped")
    report.note("ears swapped")
    stored = ImportedDataset.write(tmp_path, measurements(), report, layout="test", source="here").report
    assert stored == report
    assert (stored.skipped["empty"].count, stored.skipped["empty"].examples) == (4, ["a", "b", "c"])
    assert (stored.skipped["no partner"].count, stored.notes) == (7, ["ears swapped"])


def test_simulated_rows_are_those_of_the_dataset(dataset):
    responses = open_responses(dataset.folder)
    assert isinstance(responses, SimulatedResponses)
    probes, yaws = len(dataset.probes), len(dataset.yaws)
    assert len(responses.yaw) == probes * (probes - 1) * yaws
    rows = np.random.default_rng(0).permutation(len(responses.yaw))[:20]
    for row, response in zip(rows, responses.read(rows), strict=True):
        emitter, listener = (
            int(np.flatnonzero((dataset.probes == point).all(axis=-1))[0])
            for point in (responses.emitter[row], responses.listener[row])
        )
        turned = int(np.flatnonzero(dataset.yaws == responses.yaw[row])[0])
        expected = References(dataset).reflected(emitter, listener)[turned]
        np.testing.assert_allclose(response, expected, atol=1e-6)
        assert responses.held_out[row] == dataset.held_out[emitter, listener]
        assert responses.onset_s[row] == dataset.onset_s[emitter, listener]
