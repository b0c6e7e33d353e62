"""The Godot client, run by Godot 3 without a display; the files that Godot 4 reads are parsed by its grammar."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from server.protocol.client_messages import parse_client_message
from tests.clients import guests, one_shots
from tests.clients.vectors import CLIENTS, readme_commands

GODOT = shutil.which("godot3-server")
needs_godot = pytest.mark.skipif(
    GODOT is None, reason="no godot3-server on the PATH (Debian: apt-get install godot3-server)"
)

FOLDER = CLIENTS / "godot"
QUIET = {**os.environ, "LANG": "en_US.UTF-8"}


@pytest.mark.parametrize("name", ["nafir_core.gd", "nafir_ears.gd", "nafir_listener_4.gd"])
def test_what_godot_4_reads_is_of_its_grammar(name):
    parser = pytest.importorskip("gdtoolkit.parser", reason="gdtoolkit is not installed").parser
    assert parser.parse((FOLDER / "nafir" / name).read_text()).children


@needs_godot
def test_poses_messages_and_playing_are_right_in_gdscript(tmp_path):
    driver = CLIENTS.parent / "tests" / "clients" / "godot_driver.gd"
    given = [f"--core={FOLDER}/nafir/nafir_core.gd", f"--vectors={CLIENTS}/vectors/vectors.json"]
    done = subprocess.run(
        [GODOT, "-s", driver, *given], cwd=tmp_path, env=QUIET, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert int(re.search(r"checked (\d+)", done.stdout)[1]) > 300
    texts = [line for line in done.stdout.splitlines() if line.startswith("{")]
    hello, clip, live, gain, move, remove, door = map(parse_client_message, texts)
    assert (hello.scene, hello.listener.pose.position) == ('flat "1"', (1.5, -2.25, 0.25))
    np.testing.assert_allclose(hello.listener.pose.orientation, (0, 0, np.sqrt(0.5), np.sqrt(0.5)), atol=1e-6)
    assert (clip.id, clip.clip, clip.gain_db) == ("npc-ä", "trumpet", -3.5)
    assert (live.id, live.live) == ("mine", True)
    assert (gain.gain_db, move.pose.position, remove.id) == (-6, (1, -3, 2), "mine")
    assert (door.door, door.openness) == ("kitchen", 0.5)
    for name, steps in (("guests ", guests), ("shots ", one_shots)):
        steps.check([line.removeprefix(name) for line in done.stdout.splitlines() if line.startswith(name)])


def command(address: str, *options: str) -> list[str]:
    """What the README tells one to type, for this server and the arithmetic scene."""
    *_, line = readme_commands("godot")
    words = line.replace("127.0.0.1:8000", address).replace("apartment", "flat").split()
    return [*words, *options]


def run(address: str, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(address, *options),
        cwd=CLIENTS.parent,
        env=QUIET,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@needs_godot
@pytest.mark.parametrize(("clip", "rate"), [("trumpet", 48_000), ("live", 0)])
def test_a_real_server_is_heard(served, clip, rate):
    words = command(served, f"--clip={clip}", f"--rate={rate}", "--seconds=60")
    with subprocess.Popen(
        words, cwd=CLIENTS.parent, env=QUIET, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            found = (re.search(r"left (\S+) dB  right (\S+) dB  pose (\d+)  live", line) for line in process.stdout)
            # Of the mixer, after the player: where nothing plays it says -200 dB, and 0 dB until it has mixed once.
            assert any(
                -60 < float(each[1]) < 0 and -60 < float(each[2]) < 0 and int(each[3]) > 20 for each in found if each
            )
        finally:
            process.kill()
        assert process.stderr.read() == ""


@needs_godot
def test_a_refusal_is_said(served):
    done = run(served, "--scene=nowhere")
    assert done.returncode == 1
    assert "unknown_scene" in done.stderr


@needs_godot
def test_a_lost_connection_is_made_again(served):
    from tests import visitor  # importing it skips where there is no playwright

    port = visitor.free_port()
    with subprocess.Popen(
        command(f"127.0.0.1:{port}", "--seconds=60"), cwd=CLIENTS.parent, env=QUIET, stdout=subprocess.PIPE, text=True
    ) as process:

        def until(state: str, pose: int = 0) -> None:
            found = (re.search(r"pose (\d+)  (\w+)", line) for line in process.stdout)
            assert any(each and each[2] == state and int(each[1]) >= pose for each in found)

        with visitor.passing_on(port, f"http://{served}"):
            until("live", 5)
        until("waiting")
        with visitor.passing_on(port, f"http://{served}"):
            until("live", 5)
            process.kill()
