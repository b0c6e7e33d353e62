import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from server.acoustics.decibels import amplitude_to_db
from server.acoustics.geometry import Pose
from server.assets.clips import ClipLibrary
from server.field.field import AcousticField
from server.offline.render import PathPoint, RenderedEmitter, render
from server.responses.direct_sound import DirectSound
from server.scene.effects import EffectName

pytestmark = pytest.mark.untimed

LIVE = Path(__file__).resolve().parents[2] / "client_examples" / "python" / "live.py"


def live(address, *options):
    command = [sys.executable, str(LIVE), "--url", f"ws://{address}/v1/stream", "--scene", "flat", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_what_is_sent_comes_back_as_the_room_has_it(served, bundle, filters, tmp_path):
    sent, wet = tmp_path / "sent.wav", tmp_path / "wet.wav"
    clip = ClipLibrary(24_000).load("woman-reading").samples[:48_000]
    soundfile.write(sent, clip, 24_000, subtype="FLOAT")
    # Every effect, as the render below has it, so that no plan comes between.
    effects = [f"--effect={name}=on" for name in EffectName]
    for _ in range(5):  # far ahead, and again where the machine was busy for longer even than that
        done = live(served, "--input", str(sent), "--ahead", "30", *effects, "-o", str(wet))
        assert done.returncode == 0, done.stderr
        if "0 underruns, 0 samples dropped" in done.stdout:
            break
    else:
        pytest.fail(done.stdout)
    heard, rate = soundfile.read(wet, dtype="float32")
    assert rate == 24_000

    start = bundle.manifest.start
    emitter = RenderedEmitter(clip, Pose(start.emitter))
    path = [PathPoint.at(0, Pose.from_yaw(start.listener, np.radians(start.listener_yaw_deg)))]
    expected = render(AcousticField.load(bundle), DirectSound.of(bundle, filters), [emitter], path).T
    # It begins with a block, as soon as two have arrived.
    lags = [256 * blocks for blocks in range(30)]
    errors = [np.sqrt(np.mean((heard[lag : lag + 48_000] - expected[:48_000]) ** 2)) for lag in lags]
    assert amplitude_to_db(min(errors) / np.sqrt(np.mean(expected[:48_000] ** 2))) < -80


def test_without_a_recording_it_claps(served, tmp_path):
    wet = tmp_path / "wet.wav"
    done = live(served, "-o", str(wet))
    assert done.returncode == 0, done.stderr
    heard, rate = soundfile.read(wet)
    assert np.sqrt(np.mean(heard[:rate] ** 2)) > 1e-3


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--scene", "moon"), "unknown_scene: there is no scene 'moon'"),
        (("--url", "ws://127.0.0.1:1/v1/stream"), "ws://127.0.0.1:1/v1/stream: "),
        (("--input", "absent.wav"), "absent.wav: "),
        (("--effect", "telepathy=on"), "unknown_effect: "),
    ],
)
def test_what_cannot_be_is_said_in_one_line(served, options, complaint):
    done = live(served, *options)
    assert done.returncode == 1
    assert done.stderr.startswith(complaint)
    assert done.stderr.count("\n") == 1
