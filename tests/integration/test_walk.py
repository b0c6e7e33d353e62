import csv
import re
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import soundfile
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import serve

from server.acoustics.decibels import amplitude_to_db
from server.acoustics.geometry import Pose
from server.api.catalogue import describe_scene
from server.assets.clips import ClipLibrary
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import RenderedEmitter, read_path, render
from server.protocol.client_messages import SetLevel
from server.protocol.server_messages import EmitterAdded, Welcome
from server.responses.direct_sound import DirectSound
from server.scene.bundle import write_bundle
from server.scene.manifest import QualityLevel

pytestmark = pytest.mark.untimed

WALK = Path(__file__).resolve().parents[2] / "client_examples" / "python" / "walk.py"


def walk(address, *options):
    command = [sys.executable, str(WALK), "--url", f"ws://{address}/v1/stream", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture(scope="module")
def steady(serving, bundle, hrtfs):
    """HOST:PORT of a server whose quality no load lowers: lowered, samples are not those of an offline render."""
    with serving(FieldsByLevel.load(bundle), hrtfs, steps_down=False) as address:
        yield address


def test_what_a_walker_heard_is_what_an_offline_render_of_his_path_says(steady, bundle, filters, tmp_path):
    heard = tmp_path / "heard.wav"
    done = walk(steady, "--scene", "flat", "--clip", "woman-reading", "--seconds", "3", "-o", str(heard))
    assert done.returncode == 0, done.stderr
    live, rate = soundfile.read(heard, dtype="float32")
    assert rate == 24_000
    assert 3.0 <= len(live) / rate < 4.0
    assert np.sqrt(np.mean(live**2)) > 1e-3

    path = read_path(tmp_path / "path.csv", rate)
    assert path[0].sample == path[0].reverberation_sample
    # Of some 90 poses, even on a busy machine.
    assert len({point.sample for point in path}) > 30
    assert len({point.reverberation_sample for point in path}) > 30
    clip = ClipLibrary(rate).load("woman-reading")
    emitter = RenderedEmitter(clip, Pose(bundle.manifest.start.emitter), loop=True)
    direct_sound = DirectSound.of(bundle, filters)
    fields = FieldsByLevel.load(bundle)
    offline = render(fields.default, direct_sound, [emitter], path, length=len(live), levels=fields)
    difference = np.sqrt(np.mean((live - offline.T) ** 2)) / np.sqrt(np.mean(live**2))
    assert amplitude_to_db(difference) < -90


def test_the_command_that_a_walk_prints_renders_it_again(steady, bundle, tmp_path):
    heard, again = tmp_path / "heard.wav", tmp_path / "again.wav"
    done = walk(steady, "--scene", "flat", "--clip", "trumpet", "--seconds", "1", "-o", str(heard))
    command = re.search(r"nafir (render .*)", done.stdout)[1].split()
    command[command.index("flat")] = str(bundle.folder)
    command[command.index("again.wav")] = str(again)
    run = [sys.executable, "-c", "from server.cli.main import main; main()", *command]
    subprocess.run(run, check=True, capture_output=True, timeout=60)
    live, _ = soundfile.read(heard, dtype="float32")
    offline, _ = soundfile.read(again, dtype="float32")
    np.testing.assert_array_equal(offline, live)


@pytest.fixture
def levels(bundle, tmp_path):
    """The scene's own, and a rougher one, whose emitters share a tail."""
    rough = QualityLevel(name="rough", field="arithmetic", frames=8, shared_tail=True)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    manifest = bundle.manifest.model_copy(update={"levels": (*bundle.manifest.levels, rough)})
    return FieldsByLevel.load(write_bundle(tmp_path / "scene", manifest, files))


@contextmanager
def changing(address, levels_by_pose):
    """HOST:PORT of a way to a server on which a level is chosen after so many poses."""

    def answer(socket, server):
        try:
            for message in server:
                socket.send(message)
        except ConnectionClosed:
            pass

    def relay(socket):
        poses = 0
        with connect(f"ws://{address}/v1/stream", compression=None, max_size=None) as server:
            answering = threading.Thread(target=answer, args=(socket, server))
            answering.start()
            for message in socket:
                server.send(message)
                poses += isinstance(message, bytes)
                if isinstance(message, bytes) and poses in levels_by_pose:
                    server.send(SetLevel(level=levels_by_pose[poses]).serialize())
        answering.join()

    with serve(relay, "127.0.0.1", 0, compression=None, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield "{}:{}".format(*server.socket.getsockname())
        server.shutdown()
        thread.join()


def test_a_walk_whose_level_changes_is_rendered_again_by_the_command_it_prints(serving, levels, hrtfs, tmp_path):
    heard, again = tmp_path / "heard.wav", tmp_path / "again.wav"
    options = ("--scene", levels.bundle.id, "--clip", "trumpet", "--level", "standard", "--seconds", "3")
    with serving(levels, hrtfs, steps_down=False) as address, changing(address, {30: "rough", 60: "standard"}) as way:
        done = walk(way, *options, "-o", str(heard))
    assert done.returncode == 0, done.stderr
    with (tmp_path / "path.csv").open(newline="") as stream:
        named = [row["level"] for row in csv.DictReader(stream) if row["level"]]
    assert [name for name, before in zip(named, [None, *named], strict=False) if name != before] == [
        "standard",
        "rough",
        "standard",
    ]
    command = re.search(r"nafir (render .*)", done.stdout)[1].split()
    command[command.index(levels.bundle.id)] = str(levels.bundle.folder)
    command[command.index("again.wav")] = str(again)
    run = [sys.executable, "-c", "from server.cli.main import main; main()", *command]
    subprocess.run(run, check=True, capture_output=True, timeout=60)
    live, _ = soundfile.read(heard, dtype="float32")
    offline, _ = soundfile.read(again, dtype="float32")
    np.testing.assert_array_equal(offline, live)


def test_a_walk_where_there_is_no_such_scene_says_so(served, tmp_path):
    done = walk(served, "--scene", "moon", "-o", str(tmp_path / "heard.wav"))
    assert done.returncode == 1
    assert done.stderr.strip() == "unknown_scene: there is no scene 'moon'"


def test_a_walk_at_a_level_there_is_not_says_which_there_are(served, tmp_path):
    done = walk(served, "--scene", "flat", "--level", "best", "-o", str(tmp_path / "heard.wav"))
    assert done.returncode == 1
    assert done.stderr.strip() == "unknown_level: 'best' is none of auto, standard"


def test_a_walk_without_a_server_says_so(tmp_path):
    done = walk("127.0.0.1:1", "-o", str(tmp_path / "heard.wav"))
    assert done.returncode == 1
    assert done.stderr.startswith("ws://127.0.0.1:1/v1/stream: ")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("url", ["http://127.0.0.1/", "ws://{served}/v1/elsewhere"])
def test_a_walk_to_the_wrong_address_says_so_in_one_line(served, tmp_path, url):
    url = url.format(served=served)
    done = walk(served, "--url", url, "-o", str(tmp_path / "heard.wav"))
    assert done.returncode == 1
    assert done.stderr.startswith(f"{url}: ")
    assert done.stderr.count("\n") == 1


def test_a_walk_whose_server_goes_away_says_so_in_one_line(field, tmp_path):
    welcome = Welcome(
        session="s",
        scene=describe_scene(FieldsByLevel([field])),
        sample_rate=24_000,
        block_size=256,
        channels=2,
        encoding="f32",
        buffer_blocks=8,
        window=40,
        ir_samples=4_000,
        hrtf="kemar",
        level="standard",
    )

    def leave_midway(socket):
        socket.recv()
        socket.send(welcome.serialize())
        socket.send(EmitterAdded(id="clip", sample_clock=0).serialize())
        for _ in range(5):
            socket.recv()  # the walk is under way
        socket.close(1011, "internal_error")

    with serve(leave_midway, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        address = "{}:{}".format(*server.socket.getsockname())
        done = walk(address, "-o", str(tmp_path / "heard.wav"))
        server.shutdown()
        thread.join()
    assert done.returncode == 1
    assert done.stderr.startswith(f"ws://{address}/v1/stream: received 1011")
    assert done.stderr.count("\n") == 1
