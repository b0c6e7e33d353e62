"""Twelve measured responses with surveyed positions: their sound arrives when, and in the order, geometry says."""

from pathlib import Path

import numpy as np
import pytest

from server.acoustics.decay import onset_sample
from training.data.importers.conditioning import Conditioning, condition
from training.data.importers.meshrir import read
from training.data.importers.report import ImportReport
from training.data.responses import ImportedDataset

DECHORATE = Path(__file__).parents[3] / "data" / "measured" / "dechorate.npz"


@pytest.fixture(scope="module")
def room():
    with np.load(DECHORATE) as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def imported(room, tmp_path_factory):
    source, folder = tmp_path_factory.mktemp("meshrir"), tmp_path_factory.mktemp("data")
    np.save(source / "pos_mic.npy", room["microphones"])
    np.save(source / "pos_src.npy", room["loudspeaker"][np.newaxis])
    for index, response in enumerate(room["responses"]):
        np.save(source / f"ir_{index}.npy", response[np.newaxis])
    report = ImportReport()
    measurements = condition(read(source, report), Conditioning(), report)
    return ImportedDataset.write(folder, measurements, report, layout="meshrir", source=str(source))


def test_samples_survive_the_import(room, imported):
    np.testing.assert_array_equal(imported.read(range(12))[:, 0], room["responses"])


def test_sound_arrives_when_geometry_says(imported):
    onset = onset_sample(imported.read(range(12)))[:, 0]
    late = onset - imported.onset_s * imported.sample_rate
    # It was 25 degrees warm there: at 346 m/s, 3 m take 4 samples less than at 343 m/s.
    assert late.max() < 1
    assert late.min() > -6


def test_sound_arrives_when_listeners_marked_it(room, imported):
    onset = onset_sample(imported.read(range(12)))[:, 0]
    late = onset - room["direct_s"] * imported.sample_rate
    assert np.abs(late).max() < 6


def test_what_is_farther_is_heard_later(imported):
    onset = onset_sample(imported.read(range(12)))[:, 0]
    np.testing.assert_array_equal(np.argsort(onset), np.argsort(imported.onset_s))
