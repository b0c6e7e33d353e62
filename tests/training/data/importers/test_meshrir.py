import numpy as np
import pytest

from server.acoustics.decay import onset_sample
from tests.training.data.importers.conftest import RATE, wave
from training.data.dataset import SPEED_OF_SOUND
from training.data.importers.conditioning import Conditioning, SourceError, condition
from training.data.importers.meshrir import read
from training.data.importers.report import ImportReport

MICROPHONES = np.array([[x, y, 0.3] for x in (-0.5, 0.0, 0.5) for y in (-0.4, 0.4)])
LOUDSPEAKERS = np.array([[2.0, 1.0, 0.0], [-1.5, 2.0, 0.4]])


@pytest.fixture
def folder(tmp_path):
    np.save(tmp_path / "pos_mic.npy", MICROPHONES)
    np.save(tmp_path / "pos_src.npy", LOUDSPEAKERS)
    for index, microphone in enumerate(MICROPHONES):
        rows = [wave(microphone, loudspeaker)[0] for loudspeaker in LOUDSPEAKERS]
        np.save(tmp_path / f"ir_{index}.npy", np.stack(rows).astype(np.float64))
    return tmp_path


def imported(folder, **conditioning):
    report = ImportReport()
    named = read(folder, report, source_rate=RATE)
    return list(condition(named, Conditioning(**conditioning), report)), report


def test_each_response_has_the_positions_it_was_measured_at(folder):
    rows, report = imported(folder)
    assert len(rows) == len(MICROPHONES) * len(LOUDSPEAKERS)
    assert not report.skipped
    ends = [(np.array(row.listener), np.array(row.emitter)) for row in rows]
    expected = [(microphone, loudspeaker) for microphone in MICROPHONES for loudspeaker in LOUDSPEAKERS]
    np.testing.assert_array_equal(ends, expected)
    for row in rows:
        assert (row.sample_rate, row.yaw) == (RATE, 0.0)
        np.testing.assert_array_equal(row.response, wave(row.listener, row.emitter))


def test_latency_of_the_equipment_is_taken_off(folder):
    for path in folder.glob("ir_*.npy"):
        np.save(path, np.pad(np.load(path), ((0, 0), (37, 0))))
    rows, _ = imported(folder, latency_samples=37)
    for row in rows:
        np.testing.assert_array_equal(row.response, wave(row.listener, row.emitter))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda path: path.unlink(), "no such file"),
        (lambda path: path.write_bytes(b""), "unreadable"),
        (lambda path: path.write_bytes(path.read_bytes()[:200]), "unreadable"),
        (lambda path: np.save(path, np.ones(40)), "not 2 rows of samples"),
        (lambda path: np.save(path, np.ones((3, 40))), "not 2 rows of samples"),
        (lambda path: np.save(path, np.array([["a"] * 4] * 2)), "not 2 rows of samples"),
    ],
)
def test_a_microphone_that_cannot_be_read_is_skipped(folder, damage, reason):
    damage(folder / "ir_3.npy")
    rows, report = imported(folder)
    assert len(rows) == (len(MICROPHONES) - 1) * len(LOUDSPEAKERS)
    assert report.skipped.keys() == {reason}
    assert report.skipped[reason].count == len(LOUDSPEAKERS)
    assert report.skipped[reason].examples == ["ir_3.npy"]


def test_a_microphone_without_a_position_is_skipped(folder):
    np.save(folder / "ir_6.npy", np.ones((2, 10)))
    rows, report = imported(folder)
    assert len(rows) == len(MICROPHONES) * len(LOUDSPEAKERS)
    assert report.skipped["no such microphone in pos_mic.npy"].examples == ["ir_6.npy"]


@pytest.mark.parametrize("name", ["pos_mic.npy", "pos_src.npy"])
@pytest.mark.parametrize(
    ("content", "field"),
    [(None, "file"), (b"no array", "file"), (np.ones(3), "positions"), (np.ones((4, 2)), "positions")],
)
def test_positions_that_cannot_be_read_are_named(folder, name, content, field):
    (folder / name).unlink()
    if isinstance(content, bytes):
        (folder / name).write_bytes(content)
    elif content is not None:
        np.save(folder / name, content)
    with pytest.raises(SourceError, match=f"{name}: {field}: "):
        list(read(folder, ImportReport()))


def test_sound_of_the_measured_office_arrives_when_geometry_says(measured_office):
    report = ImportReport()
    rows = list(condition(read(measured_office, report), Conditioning(), report))
    assert len(rows) == 192
    assert not report.skipped
    distance = np.array([np.linalg.norm(np.subtract(row.emitter, row.listener)) for row in rows])
    onset = np.array([int(onset_sample(row.response)[0]) for row in rows])
    early = onset - distance / SPEED_OF_SOUND * 48_000
    # 6 samples are 4 cm: the size of a loudspeaker, and the reach of its first 20 dB.
    assert np.median(np.abs(early)) < 2
    assert np.abs(early).max() < 6
    # Microphones 3 cm apart on a line: what is clearly farther is heard later.
    loudspeakers = np.array([row.emitter for row in rows])
    for loudspeaker in np.unique(loudspeakers, axis=0):
        of_one = (loudspeakers == loudspeaker).all(axis=-1)
        farther = distance[of_one][:, None] - distance[of_one] > 6 / 48_000 * SPEED_OF_SOUND
        assert (onset[of_one][:, None] > onset[of_one])[farther].all()
