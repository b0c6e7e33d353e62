import json

import numpy as np
import pytest
import soundfile

from tests.training.data.importers.conftest import RATE, wave
from training.data.importers.acousticrooms import read
from training.data.importers.conditioning import Conditioning, SourceError, condition
from training.data.importers.report import ImportReport

SOURCES = {0: (2.0, 1.0, 1.5), 1: (-1.5, 2.0, 1.2)}
RECEIVERS = {0: (0.0, 0.0, 1.4), 12: (0.5, -0.4, 1.4)}
ROOM = "Cafe/Cafe_idx_7"


def write_room(folder, room=ROOM, responses="single_channel_ir"):
    audio, metadata = folder / responses / room, folder / "metadata" / room
    for path in (audio, metadata):
        path.mkdir(parents=True)
    for source, emitter in SOURCES.items():
        for receiver, listener in RECEIVERS.items():
            told = {"src_loc": list(emitter), "rec_loc": list(listener)}
            # As published: zeros before the number, however many digits it has.
            (metadata / f"S00{source}_R00{receiver}.json").write_text(json.dumps(told))
            path = audio / f"S{source:03d}_R{receiver:03d}_hybrid_IR.wav"
            soundfile.write(path, wave(listener, emitter).T, RATE, subtype="FLOAT")
    return folder


@pytest.fixture
def dataset(tmp_path):
    return write_room(tmp_path)


def imported(folder, **options):
    report = ImportReport()
    return list(condition(read(folder, report, **options), Conditioning(), report)), report


@pytest.mark.parametrize("responses", ["single_channel_ir", "single_channel_ir_1"])
def test_each_response_has_the_places_of_its_metadata(tmp_path, responses):
    rows, report = imported(write_room(tmp_path, responses=responses))
    assert not report.skipped
    ends = {(row.listener, row.emitter) for row in rows}
    assert ends == {(listener, emitter) for listener in RECEIVERS.values() for emitter in SOURCES.values()}
    for row in rows:
        np.testing.assert_array_equal(row.response, wave(row.listener, row.emitter))
    assert {row.name for row in rows} == {f"{ROOM}/S00{s}_R0{r:02d}" for s in SOURCES for r in RECEIVERS}


def test_one_room_of_several_has_to_be_chosen(dataset):
    write_room(dataset, "Office/Office_idx_3")
    with pytest.raises(SourceError, match=r"--room.*Cafe/Cafe_idx_7, Office/Office_idx_3"):
        imported(dataset)
    rows, _ = imported(dataset, room="Office/Office_idx_3")
    assert {row.name.rsplit("/", 1)[0] for row in rows} == {"Office/Office_idx_3"}
    with pytest.raises(SourceError, match="'Office' is not there"):
        imported(dataset, room="Office")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (None, "no metadata (S001_R0012.json)"),
        ("here", "S001_R0012.json has no src_loc and rec_loc"),
        ('{"src_loc": [1, 2, 3]}', "S001_R0012.json has no src_loc and rec_loc"),
        ('{"src_loc": [1, 2], "rec_loc": [1, 2]}', "S001_R0012.json has not three finite numbers for each place"),
    ],
)
def test_a_response_without_places_is_skipped(dataset, text, reason):
    path = dataset / "metadata" / ROOM / "S001_R0012.json"
    path.unlink() if text is None else path.write_text(text)
    rows, report = imported(dataset)
    assert len(rows) == 3
    assert report.skipped[reason].examples == [f"{ROOM}/S001_R012"]


def test_a_file_of_another_name_is_told(dataset):
    (dataset / "single_channel_ir" / ROOM / "notes.txt").write_text("")
    assert imported(dataset)[1].skipped["not named S<source>_R<receiver>_hybrid_IR.wav"].count == 1


def test_a_folder_without_responses_is_refused(tmp_path):
    with pytest.raises(SourceError, match="responses"):
        imported(tmp_path)
