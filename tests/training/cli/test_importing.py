import json

import numpy as np
import pytest
import soundfile

from tests.training.data.importers.conftest import wave
from training.cli.main import main
from training.simulation.responses import open_responses

RATE = 16_000
MICROPHONES = np.array([[x, 0.0, 0.0] for x in np.linspace(0.0, 1.0, 6)])
LOUDSPEAKERS = np.array([[0.5, 2.0, 0.0], [0.5, -1.0, 0.3]])


@pytest.fixture
def nafir_train(monkeypatch, capfd):
    """Runs the command; gives its exit code, standard output and standard error."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["nafir-train", "import", *map(str, arguments)])
        try:
            main()
        except SystemExit as left:
            return left.code, *capfd.readouterr()
        return 0, *capfd.readouterr()

    return run


@pytest.fixture
def meshrir(tmp_path):
    folder = tmp_path / "source"
    folder.mkdir()
    np.save(folder / "pos_mic.npy", MICROPHONES)
    np.save(folder / "pos_src.npy", LOUDSPEAKERS)
    for index, microphone in enumerate(MICROPHONES[:5]):
        np.save(folder / f"ir_{index}.npy", np.concatenate([wave(microphone, at) for at in LOUDSPEAKERS]))
    return folder


def test_an_import_is_told_in_a_table(nafir_train, meshrir, tmp_path):
    code, out, _ = nafir_train("meshrir", meshrir, "-o", tmp_path / "data", "--source-rate", RATE)
    assert code == 0
    assert "skipped: no such file" in out
    assert "ir_5.npy" in out
    assert "9 pairs to train on and 1 held out, 1 channel of 800 samples at 16000 Hz" in out


def test_an_import_is_told_in_json_and_kept(nafir_train, meshrir, tmp_path):
    arguments = ("meshrir", meshrir, "-o", tmp_path / "data", "--source-rate", RATE, "--json")
    code, out, _ = nafir_train(*arguments, "--held-out", "0.3", "--seed", "5")
    assert code == 0
    told = json.loads(out)
    assert (told["responses"], told["pairs"], told["held_out_pairs"], told["channels"]) == (10, 10, 3, 1)
    dataset = open_responses(tmp_path / "data")
    assert dataset.report.to_json() == told["report"]
    assert (dataset.layout, dataset.source) == ("meshrir", str(meshrir))
    assert dataset.held_out.sum() == 3
    again = json.loads(nafir_train(*arguments, "--held-out", "0.3", "--seed", "5")[1])
    assert again == told
    np.testing.assert_array_equal(open_responses(tmp_path / "data").held_out, dataset.held_out)


def test_every_layout_can_be_asked_for_another_rate_and_length(nafir_train, tmp_path):
    scene = tmp_path / "scene"
    (scene / "90").mkdir(parents=True)
    (scene / "points.txt").write_text("0\t0\t0\t1.5\n1\t2\t1\t1.5\n")
    soundfile.write(scene / "90" / "0_1.wav", wave((0, 0, 1.5), (2, 1, 1.5), 0.0).T, RATE, subtype="FLOAT")
    room = tmp_path / "room"
    (room / "data" / "000000").mkdir(parents=True)
    (room / "data" / "000000" / "rx_pos.txt").write_text("0,1,0")
    (room / "data" / "000000" / "tx_pos.txt").write_text("0,0,0,1,2,1,0")
    soundfile.write(room / "data" / "000000" / "rir.wav", wave((0, 0, 1), (2, 0, 1)).T, RATE, subtype="FLOAT")
    for layout, source, channels in (("soundspaces", scene, 2), ("raf", room, 1)):
        output = tmp_path / layout
        code, *_ = nafir_train(layout, source, "-o", output, "--sample-rate", "8000", "--duration-s", "0.04")
        assert code == 0
        dataset = open_responses(output)
        assert (dataset.sample_rate, dataset.samples, dataset.channels) == (8000, 320, channels)
        at = np.abs(dataset.read([0])[0]).argmax(axis=-1)
        assert np.abs(at / 8000 - dataset.onset_s[0]).max() < 4e-4


@pytest.mark.parametrize(
    ("layout", "source", "told"),
    [
        ("meshrir", "{tmp}/absent", "{tmp}/absent: source: no such file"),
        ("meshrir", "{tmp}", "pos_mic.npy: file: no such file"),
        ("soundspaces", "{tmp}", "points.txt: file: cannot be read"),
        ("raf", "{tmp}", "{tmp}: responses: no folder has a tx_pos.txt"),
        ("sofa", "{tmp}", "file: a SOFA file's name ends in .sofa"),
    ],
)
def test_bad_sources_are_told_in_a_line(nafir_train, tmp_path, layout, source, told):
    code, _, err = nafir_train(layout, source.format(tmp=tmp_path), "-o", tmp_path / "data")
    assert code == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith("nafir-train: ")
    assert told.format(tmp=tmp_path) in last
    assert not (tmp_path / "data").exists()


def test_a_published_split_says_what_is_held_out(nafir_train, meshrir, tmp_path):
    split = tmp_path / "split.json"
    parts = {"train": [f"{m}_0" for m in range(5)], "test": ["0_1", "3_1"], "validation": ["1_1"]}
    split.write_text(json.dumps(parts))
    arguments = ("meshrir", meshrir, "-o", tmp_path / "data", "--source-rate", RATE, "--json", "--split", split)
    code, out, _ = nafir_train(*arguments)
    assert code == 0
    skipped = json.loads(out)["report"]["skipped"]
    assert skipped["of the split's validation part"]["examples"] == ["ir_1.npy[1]"]
    assert skipped["not in the split"]["count"] == 2
    dataset = open_responses(tmp_path / "data")
    held_out = {tuple(dataset.listener[row]) for row in np.flatnonzero(dataset.held_out)}
    assert held_out == {tuple(MICROPHONES[0]), tuple(MICROPHONES[3])}
    assert len(dataset.yaw) == 7
