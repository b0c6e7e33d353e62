import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from training.data.dataset import DatasetError
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset, Measurement
from training.models import stored_targets
from training.models.cells import Cells
from training.models.stored_targets import load_targets
from training.models.targets import LEAD_SAMPLES, align, codec_of, flat_targets
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses

SILENT = Progress(disable=True)


def only_file(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_rows_belong_to_their_poses(dataset, tmp_path):
    cells = Cells(codec_of(SimulatedResponses(dataset)))
    targets = load_targets(SimulatedResponses(dataset), cells, tmp_path, SILENT)
    assert len(targets.flat) == len(dataset.pairs(held_out=False)) * len(dataset.yaws)
    for row in (0, 7, len(targets.flat) - 1):
        emitter, listener = (
            np.flatnonzero(np.isclose(dataset.probes, end[row], atol=1e-5).all(axis=1))[0]
            for end in (targets.emitter, targets.listener)
        )
        assert not dataset.held_out[emitter, listener]
        yaw = np.flatnonzero(np.isclose(dataset.yaws, targets.yaw[row]))[0]
        response = References(dataset).reflected(emitter, listener)[yaw]
        delay = dataset.onset_s[emitter, listener] * dataset.sample_rate - LEAD_SAMPLES
        np.testing.assert_allclose(flat_targets(align(response, delay), cells), targets.flat[row], atol=5e-3)


@pytest.mark.parametrize("expected", [False, True])
def test_targets_are_computed_once(dataset, tmp_path, monkeypatch, expected):
    responses = SimulatedResponses(dataset)
    cells = Cells(codec_of(responses))
    first = np.array(load_targets(responses, cells, tmp_path, SILENT, expected=expected).flat)
    with monkeypatch.context() as patched:
        patched.delattr(stored_targets, "_Expected" if expected else "_Drawn")
        again = load_targets(responses, cells, tmp_path, SILENT, expected=expected)
        np.testing.assert_array_equal(again.flat, first)
    other = load_targets(responses, Cells(codec_of(responses), fine_frames=16), tmp_path, SILENT, expected=expected)
    assert other.flat.shape[1] != first.shape[1]


def test_an_interrupted_computation_goes_on_where_it_was(dataset, tmp_path, monkeypatch):
    responses = SimulatedResponses(dataset)
    cells = Cells(codec_of(responses))
    whole = np.array(load_targets(responses, cells, tmp_path / "whole", SILENT).flat)
    computed = []
    drawn = stored_targets._Drawn

    class Interrupted(drawn):
        stops_at: int | None = 3

        def of_rows(self, rows):
            if len(computed) == self.stops_at:
                raise KeyboardInterrupt
            computed.append(rows[0])
            return super().of_rows(rows)

    monkeypatch.setattr(stored_targets, "_Drawn", Interrupted)
    monkeypatch.setattr(stored_targets, "_FLUSH_S", 0.0)
    monkeypatch.setattr(stored_targets, "_PAIRS_AT_A_TIME", 1)
    with pytest.raises(KeyboardInterrupt):
        load_targets(responses, cells, tmp_path / "pieces", SILENT)
    monkeypatch.setattr(Interrupted, "stops_at", None)
    np.testing.assert_array_equal(load_targets(responses, cells, tmp_path / "pieces", SILENT).flat, whole)
    assert len(computed) == len(set(computed)) == len(dataset.pairs(held_out=False))


def imported(folder: Path, level: float) -> ImportedDataset:
    rng = np.random.default_rng(0)
    measurements = (
        Measurement((x, 0, 1), (0, 2, 1), (level * rng.standard_normal((1, 2000))).astype(np.float32), 16_000)
        for x in range(6)
    )
    return ImportedDataset.write(folder, measurements, ImportReport(), layout="made up", source="here")


def test_responses_imported_anew_have_new_targets(tmp_path):
    """Of the same poses: nothing but their content differs."""
    quiet = imported(tmp_path / "data", 0.1)
    cells = Cells(codec_of(quiet), known_frames=12)
    before = np.array(load_targets(quiet, cells, tmp_path / "targets", SILENT).flat, dtype=np.float64)
    loud = imported(tmp_path / "data", 0.2)
    os.utime(loud.file, ns=(0, loud.file.stat().st_mtime_ns + 1_000_000))  # clocks of file systems are coarse
    after = np.array(load_targets(loud, cells, tmp_path / "targets", SILENT).flat, dtype=np.float64)
    assert np.median(after[:, :1000] - before[:, :1000]) == pytest.approx(np.log(2), abs=0.01)


def test_two_processes_do_not_write_the_same_targets(dataset, tmp_path):
    responses = SimulatedResponses(dataset)
    cells = Cells(codec_of(responses))
    load_targets(responses, cells, tmp_path, SILENT)
    holder = "import h5py, sys; file = h5py.File(sys.argv[1], 'r+'); print('holds', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", holder, str(only_file(tmp_path))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "holds\n"
        with pytest.raises(DatasetError, match="another process"):
            load_targets(responses, cells, tmp_path, SILENT)
        other.stdin.close()


def test_measured_responses_have_no_expectation(tmp_path):
    measured = imported(tmp_path / "data", 0.1)
    with pytest.raises(DatasetError, match="simulated responses only"):
        load_targets(measured, Cells(codec_of(measured), known_frames=12), tmp_path, SILENT, expected=True)


def test_a_damaged_file_is_named(dataset, tmp_path):
    responses = SimulatedResponses(dataset)
    cells = Cells(codec_of(responses))
    load_targets(responses, cells, tmp_path, SILENT)
    path = only_file(tmp_path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DatasetError, match=path.name):
        load_targets(responses, cells, tmp_path, SILENT)
