"""The client that turns the head by itself, against the server's own rotation and filters."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from server.acoustics.geometry import Quaternion
from server.acoustics.spherical_harmonics import rotation
from server.field.fields_by_level import FieldsByLevel
from server.rendering.head_decoder import HeadDecoder
from tests.directional_flat import write_directional

pytestmark = pytest.mark.untimed

TURN = Path(__file__).resolve().parents[2] / "client_examples" / "python" / "turn.py"
BLOCK_SIZE = 256


@pytest.fixture(scope="module")
def served_directional(serving, hrtfs, tmp_path_factory):
    """HOST:PORT of a server of a scene that knows directions."""
    levels = FieldsByLevel.load(write_directional(tmp_path_factory.mktemp("directional") / "flat"))
    with serving(levels, hrtfs) as address:
        yield address


@pytest.fixture(scope="module")
def client():
    spec = importlib.util.spec_from_file_location("turn", TURN)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def turn(address, *options):
    command = [sys.executable, str(TURN), "--url", f"ws://{address}/v1/stream", "--scene", "flat", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_the_head_turns_to_the_left_and_nods(client):
    for time_s, yaw, pitch_deg in [(0.0, 0.3, 0), (0.5, 0.3 + np.pi / 8, 10), (1.5, 0.3 + 3 * np.pi / 8, -10)]:
        expected = Quaternion.from_angles(yaw, np.radians(pitch_deg), 0.0)
        np.testing.assert_allclose(client.orientation_at(time_s, 8.0, 0.3), expected, atol=1e-12)


@pytest.mark.parametrize("order", [1, 3])
def test_the_stream_is_heard_turned_and_through_the_heads_filters(client, served_directional, filters, tmp_path, order):
    heard, received = tmp_path / "heard.wav", tmp_path / "received.wav"
    options = ("--seconds", "2", "--order", str(order), "--received", str(received), "-o", str(heard))
    done = turn(served_directional, *options)
    assert done.returncode == 0, done.stderr
    ears, rate = soundfile.read(heard, dtype="float32")
    channels, _ = soundfile.read(received, dtype="float32")
    assert (rate, ears.shape, channels.shape) == (24_000, (len(ears), 2), (len(ears), (order + 1) ** 2))
    assert 2.0 <= len(ears) / rate < 2.1
    assert np.sqrt(np.mean(ears**2)) > 1e-3

    share = (np.arange(BLOCK_SIZE) + 1)[:, None] / BLOCK_SIZE
    turned, before = [], np.eye((order + 1) ** 2)
    for number, block in enumerate(channels.reshape(-1, BLOCK_SIZE, channels.shape[1])):
        after = rotation(client.orientation_at((number + 1) * BLOCK_SIZE / rate, 2.0, np.pi / 2), order)
        turned.append((1 - share) * (block @ before.T) + share * (block @ after.T))
        before = after
    turned = np.concatenate(turned)
    expected = [
        sum(np.convolve(channel, taps) for channel, taps in zip(turned.T, ear, strict=True))[: len(ears)]
        for ear in HeadDecoder.of(filters, order).filters
    ]
    np.testing.assert_allclose(ears.T, expected, atol=1e-5 * np.abs(ears).max())


def test_a_scene_that_knows_no_directions_says_so(served, tmp_path):
    done = turn(served, "-o", str(tmp_path / "heard.wav"))
    assert done.returncode == 1
    assert done.stderr.startswith("no_directions: output: scene flat knows what one head hears")
    assert done.stderr.count("\n") == 1


def test_a_head_there_is_not_is_told(served_directional, tmp_path):
    done = turn(served_directional, "--head", "moomin", "-o", str(tmp_path / "heard.wav"))
    assert (done.returncode, done.stderr) == (1, "unknown_hrtf: there is no HRTF 'moomin', only kemar\n")


def test_a_turn_without_a_server_says_so(tmp_path):
    done = turn("127.0.0.1:1", "-o", str(tmp_path / "heard.wav"))
    assert done.returncode == 1
    assert done.stderr.startswith("ws://127.0.0.1:1/v1/stream: ")
    assert "Traceback" not in done.stderr
