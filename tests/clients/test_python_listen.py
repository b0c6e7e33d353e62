"""`nafir-client listen` and `nafir listen`, against a real server."""

import sys

import numpy as np
import pytest
import soundfile
from rich.console import Console
from typer.testing import CliRunner

from nafir_client import threaded
from nafir_client.command_line import main
from nafir_client.listening import Meter
from nafir_client.wire import Block
from server.cli.main import app
from server.core.errors import NafirError
from server.offline.render import read_path


def recorded(output):
    """The RMS of a recording and the points of its path."""
    samples, rate = soundfile.read(output, dtype="float32")
    return np.sqrt(np.mean(samples**2)), read_path(output.with_suffix(".csv"), rate)


def test_a_walk_is_recorded_with_its_path(served, tmp_path, capsys):
    output = tmp_path / "heard.wav"
    main(
        [
            "listen",
            f"ws://{served}",
            "--scene",
            "flat",
            "--seconds",
            "1",
            "--walk-s",
            "1",
            "--silent",
            "-o",
            str(output),
        ]
    )
    loudness, points = recorded(output)
    assert loudness > 1e-4
    assert len({point.pose.position for point in points}) > 3
    said = capsys.readouterr().out
    assert f"{output}: " in said
    assert "underruns" in said


def test_one_who_stays_hears_from_one_place(served, tmp_path):
    output = tmp_path / "heard.wav"
    wish = [
        "listen",
        f"http://{served}",
        "--scene",
        "flat",
        "--seconds",
        "0.6",
        "--stay",
        "--silent",
        "-o",
        str(output),
    ]
    done = CliRunner().invoke(app, wish)
    assert done.exit_code == 0, done.output
    _, points = recorded(output)
    assert {point.pose.position for point in points} == {(2.0, 2.5, 1.5)}


@pytest.mark.parametrize(
    ("wish", "complaint"),
    [
        (["--scene", "moon", "--silent", "-o", "a.wav"], "unknown_scene: there is no scene 'moon'"),
        (["--scene", "flat", "--clip", "kazoo", "--silent", "-o", "a.wav"], "unknown_clip: "),
        (["--scene", "flat", "--silent"], "silent: nothing is played and nothing written"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(served, tmp_path, monkeypatch, capsys, wish, complaint):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["listen", f"ws://{served}", "--seconds", "1", *wish])
    assert ended.value.code == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith(f"error: {complaint}")
    assert isinstance(
        CliRunner().invoke(app, ["listen", f"ws://{served}", "--seconds", "1", *wish]).exception, NafirError
    )


def test_without_the_package_the_servers_command_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "nafir_client.listening", None)
    done = CliRunner().invoke(app, ["listen"])
    assert isinstance(done.exception, NafirError)
    assert "pip install 'client_examples/python[listen]'" in str(done.exception)


def block(*peaks):
    return Block(0, 0, 0, 0, np.array([peaks, [0.0] * len(peaks)], np.float32), False, False, False, 0.0)


def test_the_meter_shows_peaks_at_once_and_falls_slowly():
    meter = Meter()
    meter.note(block(1.0, 0.1))
    np.testing.assert_allclose(meter.levels_db(), [0, -20], atol=1e-5)
    meter.note(block(0.0, 0.5))
    assert -0.5 < meter.levels_db()[0] < 0
    assert meter.levels_db()[1] == pytest.approx(-6, abs=0.1)
    for _ in range(1_000):
        meter.note(block(0.0, 0.0))
    assert max(meter.levels_db()) < -100


def test_the_meter_of_a_stream_names_its_channels_and_its_level(served):
    meter, console = Meter(), Console(width=120)
    with threaded.connect(f"ws://{served}", scene="flat", on_block=meter.note) as stream:
        stream.add_emitter(clip="trumpet")
        with console.capture() as shown:
            console.print(meter.table(stream, 1.5))
    for word in ("left", "right", "1.5 s of A flat", "standard", "late", "underruns", "round trip"):
        assert word in shown.get()
