"""`nafir-client listen` and `nafir listen`, against a real server."""

import re
import sys
import tomllib

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
from tests.clients.vectors import CLIENTS, readme_commands


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


def test_the_last_of_the_readmes_three_lines_listens(served, tmp_path):
    install, serve, listen = readme_commands("python")
    assert (install, serve) == ("pip install 'client_examples/python[listen]'", "nafir serve &")
    output = tmp_path / "heard.wav"
    program, *arguments = listen.replace("127.0.0.1:8000", served).split()
    assert program in tomllib.loads((CLIENTS / "python" / "pyproject.toml").read_text())["project"]["scripts"]
    main([*arguments, "--scene", "flat", "--seconds", "0.5", "--silent", "-o", str(output)])
    assert recorded(output)[0] > 0


def readme_programs():
    """The Python in the README."""
    text = (CLIENTS / "python" / "README.md").read_text()
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def test_the_readmes_program_for_asyncio_prints_the_peaks_of_blocks(served, capsys):
    program = readme_programs()[0].replace("127.0.0.1:8000", served).replace("apartment", "flat")
    program = program.replace("abs(block.samples).max())", "abs(block.samples).max()) or block.sequence < 99 or stop()")

    class StopError(Exception):
        pass

    def stop():
        raise StopError

    with pytest.raises(StopError):
        exec(program, {"stop": stop})
    peaks = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines()]
    assert len(peaks) == 100
    assert max(peaks) > 1e-4


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
