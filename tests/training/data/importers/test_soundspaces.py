import numpy as np
import pytest
import soundfile

from tests.training.data.importers.conftest import RATE, wave
from training.data.importers.conditioning import Conditioning, SourceError, condition
from training.data.importers.report import ImportReport
from training.data.importers.soundspaces import heading_to_yaw, read, read_points

POINTS = {0: (0.0, 0.0, 1.5), 1: (3.0, 0.0, 1.5), 3: (0.5, 2.5, 1.5)}  # indices have gaps
# Where each heading looks, from the documentation: 0 along +y, clockwise.
AHEAD = {0: (0.0, 1.0), 90: (1.0, 0.0), 180: (0.0, -1.0), 270: (-1.0, 0.0)}


@pytest.fixture
def scene(tmp_path):
    """Written with headings as vectors, so that the importer's arithmetic is not its own test."""
    lines = [f"{index:04d}\t{x}\t{y}\t{z}" for index, (x, y, z) in POINTS.items()]
    (tmp_path / "points.txt").write_text("\n".join(lines) + "\n")
    for azimuth, (ahead_x, ahead_y) in AHEAD.items():
        (tmp_path / str(azimuth)).mkdir()
        for receiver, listener in POINTS.items():
            for source, emitter in POINTS.items():
                if receiver != source:
                    response = wave(listener, emitter, np.arctan2(ahead_y, ahead_x))
                    path = tmp_path / str(azimuth) / f"{receiver}_{source}.wav"
                    soundfile.write(path, response.T, RATE, subtype="FLOAT")
    return tmp_path


def imported(folder, **options):
    report = ImportReport()
    return list(condition(read(folder, report, **options), Conditioning(), report)), report


@pytest.mark.parametrize("azimuth", AHEAD)
def test_a_clockwise_heading_from_north_becomes_a_counter_clockwise_yaw_from_east(azimuth):
    yaw = heading_to_yaw(azimuth)
    np.testing.assert_allclose((np.cos(yaw), np.sin(yaw)), AHEAD[azimuth], atol=1e-12)
    assert -np.pi <= yaw < np.pi


def test_turning_right_lowers_the_yaw():
    assert heading_to_yaw(30) == pytest.approx(heading_to_yaw(20) - np.radians(10))


def test_poses_and_samples_are_those_of_the_files(scene):
    rows, report = imported(scene)
    assert len(rows) == 4 * 6
    assert not report.skipped
    for row in rows:
        assert row.sample_rate == RATE
        assert row.listener in POINTS.values()
        np.testing.assert_array_equal(row.response, wave(row.listener, row.emitter, row.yaw))
    assert len({(row.listener, row.emitter, round(row.yaw, 6)) for row in rows}) == 24
    assert any("100%" in note for note in report.notes)


def test_receiver_comes_first_in_a_file_name(scene):
    for path in scene.glob("*/*.wav"):
        if path.stem != "1_3":
            path.unlink()
    rows, _ = imported(scene)
    assert {(row.listener, row.emitter) for row in rows} == {(POINTS[1], POINTS[3])}


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda path: path.write_bytes(b""), "empty file"),
        (lambda path: path.write_bytes(path.read_bytes()[:20]), "unreadable"),
        (lambda path: path.write_bytes(b"not sound at all" * 9), "unreadable"),
        (lambda path: soundfile.write(path, np.zeros((0, 2)), RATE), "empty"),
        (lambda path: soundfile.write(path, np.zeros((90, 2)), RATE), "silent"),
        (lambda path: soundfile.write(path, np.ones((90, 4)) / 2, RATE), "not 2 channels"),
        (lambda path: path.unlink(), "missing at this azimuth"),
        (lambda path: path.rename(path.with_name("1_7.wav")), "a point that points.txt does not have"),
        (lambda path: path.rename(path.with_name("notes.txt")), "not named <receiver>_<source>.wav"),
    ],
)
def test_a_response_that_is_not_there_is_counted_as_missing(scene, damage, reason):
    damage(scene / "90" / "1_0.wav")
    rows, report = imported(scene)
    assert len(rows) == 23
    assert report.skipped[reason].count >= 1
    assert report.skipped[reason].examples[0].startswith("90/1") or reason.startswith("not named")


def test_a_point_heard_from_itself_is_skipped(scene):
    soundfile.write(scene / "0" / "1_1.wav", np.ones((90, 2)) / 2, RATE)
    rows, report = imported(scene)
    assert len(rows) == 24
    assert report.skipped["emitter where the listener is"].examples == ["0/1_1.wav"]


def test_points_are_found_where_a_download_has_them(scene, tmp_path_factory):
    root = tmp_path_factory.mktemp("download")
    metadata = root / "metadata" / "replica" / "room"
    metadata.mkdir(parents=True)
    responses = root / "binaural_rirs" / "replica" / "room"
    responses.parent.mkdir(parents=True)
    (scene / "points.txt").rename(metadata / "points.txt")
    responses.symlink_to(scene)
    with pytest.raises(SourceError, match=r"points\.txt: file"):
        imported(responses)
    responses.unlink()
    scene.rename(responses)
    assert len(imported(responses)[0]) == 24
    assert len(imported(responses, points=metadata / "points.txt")[0]) == 24


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "points"),
        ("0\t1\t2\n", "line 1"),
        ("0\t1\t2\t3\n\n1\t1\tb\t3\n", "line 3"),
        ("0\t1\t2\tnan\n", "line 1"),
        ("0\t1\t2\t3\n0\t1\t2\t4\n", "line 2"),
    ],
)
def test_malformed_points_are_named_by_line(tmp_path, text, field):
    path = tmp_path / "points.txt"
    path.write_text(text)
    with pytest.raises(SourceError, match=f"points.txt: {field}: "):
        read_points(path)


def test_a_folder_without_azimuths_is_refused(scene):
    for azimuth in AHEAD:
        (scene / str(azimuth)).rename(scene / f"a{azimuth}")
    with pytest.raises(SourceError, match="azimuths"):
        imported(scene)
