import numpy as np
import pytest
import soundfile

from tests.training.data.importers.conftest import RATE, wave
from training.data.importers.conditioning import Conditioning, SourceError, condition
from training.data.importers.raf import read
from training.data.importers.report import ImportReport

# x ahead, y up, z left, as published.
MICROPHONES = [(0.5, 1.2, -0.3), (0.9, 1.7, 0.4)]
LOUDSPEAKERS = [(3.0, 1.5, 1.0), (-2.0, 1.6, 2.0)]
FACING = {"ahead": (0.0, 0.0, 0.0, 1.0), "aside": (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))}


def place(folder, index, microphone, loudspeaker, quaternion=FACING["ahead"]):
    path = folder / "data" / f"{index:06d}"
    path.mkdir(parents=True)
    (path / "rx_pos.txt").write_text(",".join(map(str, microphone)) + "\n")
    (path / "tx_pos.txt").write_text(",".join(map(str, (*quaternion, *loudspeaker))) + "\n")
    soundfile.write(path / "rir.wav", wave(microphone, loudspeaker).T, RATE, subtype="FLOAT")
    return path


@pytest.fixture
def room(tmp_path):
    pairs = [(microphone, loudspeaker) for loudspeaker in LOUDSPEAKERS for microphone in MICROPHONES]
    for index, (microphone, loudspeaker) in enumerate(pairs):
        place(tmp_path, index, microphone, loudspeaker)
    return tmp_path


def imported(folder):
    report = ImportReport()
    return list(condition(read(folder, report), Conditioning(), report)), report


def test_up_is_the_second_number(room):
    rows, report = imported(room)
    assert not report.skipped
    assert {row.listener[2] for row in rows} == {1.2, 1.7}
    assert {row.emitter[2] for row in rows} == {1.5, 1.6}


def test_positions_follow_the_quaternion_and_fit_the_sound(room):
    rows, _ = imported(room)
    assert {row.emitter for row in rows} == {(x, z, y) for x, y, z in LOUDSPEAKERS}
    for row in rows:
        np.testing.assert_array_equal(row.response, wave(row.listener, row.emitter))


def test_the_data_folder_may_be_named_too(room):
    assert [row.listener for row in imported(room)[0]] == [row.listener for row in imported(room / "data")[0]]


def test_a_loudspeaker_is_kept_the_way_it_first_faced(room):
    place(room, 4, MICROPHONES[0], LOUDSPEAKERS[0], FACING["aside"])
    place(room, 5, (0.0, 1.0, 0.0), LOUDSPEAKERS[0], tuple(-value for value in FACING["ahead"]))  # the same rotation
    rows, report = imported(room)
    assert len(rows) == 5
    assert report.skipped["loudspeaker has another orientation than at first"].examples == ["000004"]


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("rx_pos.txt", "1,2", "rx_pos.txt has not 3 finite numbers"),
        ("rx_pos.txt", "1,2,nan", "rx_pos.txt has not 3 finite numbers"),
        ("rx_pos.txt", "here", "rx_pos.txt has not 3 finite numbers"),
        ("rx_pos.txt", "1,2,0_3", "rx_pos.txt has not 3 finite numbers"),
        ("rx_pos.txt", "1,2,٣", "rx_pos.txt has not 3 finite numbers"),
        ("rx_pos.txt", None, "rx_pos.txt unreadable"),
        ("tx_pos.txt", "0,0,0,1,2,3", "tx_pos.txt has not 7 finite numbers"),
        ("tx_pos.txt", "3.0,1.5,1.0,0,0,0,1", "tx_pos.txt does not begin with a unit quaternion"),
        ("rir.wav", "", "empty file"),
        ("rir.wav", "noise", "unreadable"),
        ("rir.wav", None, "no such file"),
    ],
)
def test_a_response_that_cannot_be_read_is_skipped(room, name, text, reason):
    path = room / "data" / "000002" / name
    path.unlink()
    if text is not None:
        path.write_text(text)
    rows, report = imported(room)
    assert len(rows) == 3
    assert report.skipped[reason].examples == ["000002"]


def test_a_folder_without_responses_is_refused(tmp_path):
    with pytest.raises(SourceError, match="responses"):
        list(read(tmp_path, ImportReport()))
