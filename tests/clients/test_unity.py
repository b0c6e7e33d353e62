"""The Unity client, compiled and run by Mono: poses, messages, playback, and a real server."""

import json
import re
import shutil
import subprocess
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import ListenerPose, parse_client_message
from tests.clients.vectors import CLIENTS, TABLE, assert_same_poses, poses, readme_commands
from tests.serving import serving
from tests.two_rooms import write_two_rooms

COMPILER, MONO = shutil.which("mcs"), shutil.which("mono")
pytestmark = needs_mono = pytest.mark.skipif(
    COMPILER is None or MONO is None, reason="no mono on the PATH (Debian: apt-get install mono-mcs mono-runtime)"
)

FOLDER = CLIENTS / "unity"
_PATIENCE_S = 120.0


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    """The driver with the components, whose types of Unity are stand-ins."""
    output = tmp_path_factory.mktemp("unity") / "Driver.exe"
    own = [Path(__file__).with_name(name) for name in ("UnityDriver.cs", "UnityEngineStub.cs")]
    sources = [*own, *sorted((FOLDER / "Nafir").glob("*.cs"))]
    done = subprocess.run(
        [COMPILER, "-langversion:7", "-warnaserror", f"-out:{output}", *sources],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return output


@pytest.fixture(scope="module")
def listen(tmp_path_factory) -> Path:
    """As the README compiles it."""
    output = tmp_path_factory.mktemp("unity") / "Listen.exe"
    _, compile_it, _ = readme_commands("unity")
    command = compile_it.replace("-out:Listen.exe", f"-out:{output}")
    subprocess.run(["bash", "-c", command], cwd=CLIENTS.parent, check=True)
    return output


def answers(program: Path, *commands: str) -> list[str]:
    done = subprocess.run(
        [MONO, program], input="\n".join(commands), capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def numbers(*values: object) -> str:
    return " ".join(str(value) for value in values)


def test_poses_are_the_servers_and_come_back(program):
    unity = poses("unity")
    found = np.array([line.split() for line in answers(program, *(numbers("pose", *each) for each in unity))], float)
    assert_same_poses(found[:, :7], poses("nafir"), atol=2e-6)
    assert_same_poses(found[:, 7:], unity, atol=2e-6)


def test_binary_messages_are_those_of_the_server(program):
    listener = TABLE["listener"]
    commands = [numbers("listener", listener["pose_id"], *listener["position"], *listener["orientation"])]
    dry = [each for each in TABLE["dry_blocks"] if each["encoding"] == "s16"]
    commands += [numbers("dry", each["id"], each["sequence"], *each["samples"]) for each in dry]
    wet = [each for each in TABLE["audio_blocks"] if each["encoding"] == "s16"]
    commands += [numbers("block", each["hex"]) for each in wet]
    assert dry
    assert wet
    found = answers(program, *commands)
    assert found[: 1 + len(dry)] == [listener["hex"], *(each["hex"] for each in dry)]
    header = ("sequence", "sample_clock", "pose_id", "reverberation_pose_id", "flags")
    for line, wanted in zip(found[1 + len(dry) :], wet, strict=True):
        *read, channels = map(int, line.split()[:6])
        assert read == [wanted[name] for name in header]
        samples = np.array(line.split()[6:], float).reshape(-1, channels).T
        np.testing.assert_allclose(samples, wanted["channels"], atol=1e-7)


def test_a_damaged_block_is_none(program):
    whole = next(each for each in TABLE["audio_blocks"] if each["encoding"] == "s16")["hex"]
    shorter = [numbers("block", whole[:size]) for size in range(0, len(whole), 2)]
    assert set(answers(program, *shorter, numbers("block", "07" + whole[2:]))) == {"none"}


def test_text_messages_are_valid_and_say_what_was_meant(program):
    [line] = answers(program, "texts")
    messages = list(map(parse_client_message, line.split("\t")))
    hello, other, clip, live, move, gain, remove, acknowledge = messages[:8]
    assert (hello.scene, hello.sample_rate, hello.encoding, hello.buffer_blocks) == ('flat "1"', 24_000, "s16", 4)
    np.testing.assert_allclose(hello.listener.pose.position, (1.5, -2.25, 0.1), rtol=1e-6)
    np.testing.assert_allclose(hello.listener.pose.orientation, (0, 0, 0.6, 0.8), rtol=1e-6)
    assert (other.sample_rate, other.block_size) == (None, 512)
    assert (clip.id, clip.clip, clip.gain_db, clip.loop) == ("a\\b\n", "trumpet", -3.5, False)
    assert (live.id, live.live) == ("npc-ä", True)
    assert move.pose_id == 2**32 - 1
    assert (gain.id, gain.gain_db, remove.id, acknowledge.sequence) == ("x", -6, "x", 2**32 - 1)


def test_messages_of_clips_and_of_resuming_are_valid_and_say_what_was_meant(program):
    [line] = answers(program, "texts")
    resume, elsewhere, shot, loop, voice, stop, stop_now, ramp, level, ping, hello, door = map(
        parse_client_message, line.split("\t")[8:20]
    )
    assert (resume.token, resume.snapshot, resume.sequence) == ('a"b', None, None)
    assert (elsewhere.token, elsewhere.snapshot) == (None, "c2ln")
    assert (elsewhere.sequence, elsewhere.sample_clock) == (7, 2**40)
    # Clocks of the stream are a thousand ahead of the server's here.
    assert (shot.start_at, shot.stop_at, shot.offset_s) == (4000, 0, 0.5)
    assert (shot.loop, shot.remove_when_ended) == (False, True)
    assert (loop.loop_start_s, loop.loop_end_s, loop.loop) == (0.25, 1.5, True)
    assert (voice.live, voice.jitter_ms) == (True, 40)
    assert (stop.stop_at, stop.fade_s, stop_now.stop_at) == (4000, 0.5, None)
    assert stop_now.fade_s == pytest.approx(0.01)
    assert (ramp.gain_db, ramp.ramp_s, level.level, ping.id) == (-6, 2.5, "auto", 9)
    assert (hello.level, hello.snapshots) == ("fine", True)
    assert (door.door, door.openness) == ('north "1"', 0.25)


def test_messages_about_listeners_are_valid_and_say_what_was_meant(program):
    text, *pose = answers(program, "texts", numbers("number", 7, 1.5, -2.25, 0.5, 0, 0, 0.6, 0.8))
    hello, headed, other, left, acknowledge = map(parse_client_message, text.split("\t")[20:])
    assert hello.listeners == 3
    assert (headed.id, headed.hrtf) == ('p"2', "kemar")
    np.testing.assert_allclose(headed.pose.position, (1.5, -2.25, 0.1), rtol=1e-6)
    assert (other.id, other.hrtf, left.id) == ("p3", None, "p3")
    assert (acknowledge.sequence, acknowledge.listener) == (7, 'p"2')
    moved = ListenerPose.parse_binary(bytes.fromhex(pose[0]))
    assert (moved.index, moved.pose_id, moved.position) == (7, 7, (1.5, -2.25, 0.5))


def test_json_is_read_as_python_reads_it(program):
    texts = ['{"a":[1,-2.5e3,true,null,{}],"ü\\"\\u00e9\\n":"\\\\"}', '{"x":{"y":[[],[[]]]}}', "{}"]
    found = answers(program, *(f"json {text}" for text in texts))
    assert [json.loads(line) for line in found] == [json.loads(text) for text in texts]


def test_what_is_no_json_object_is_refused(program):
    broken = ["", "[1]", "{", '{"a"}', '{"a":}', '{"a":1,}', '{"a":tru}', '{"a":"\\u12"}', "{}x", "[" * 5000, '{"a":-}']
    assert set(answers(program, *(f"json {text}" for text in broken))) == {"refused"}


def play(program, *, stream_rate=24_000, output_rate=48_000, skew=0.0, hertz=440.0, seconds=4.0, held=(-1.0, -1.0)):
    """Underruns, and what is heard of a tone of amplitude 0.5."""
    [line] = answers(program, numbers("play", stream_rate, output_rate, skew, hertz, seconds, *held))
    underruns, *heard = line.split()
    return int(underruns), np.array(heard, float)


def test_a_tone_comes_out_as_a_tone(program):
    underruns, heard = play(program, output_rate=44_100)
    assert underruns == 0
    last = heard[-44_100:]
    window = np.hanning(len(last))
    spectrum = np.abs(np.fft.rfft(last * window)) / window.sum() * 2
    assert spectrum[438:443].max() == pytest.approx(0.5, rel=0.02)
    elsewhere = np.delete(spectrum, range(380, 501))
    assert 20 * np.log10(elsewhere.max() / 0.5) < -70


def test_clocks_that_differ_cost_no_gaps(program):
    for skew in (-0.0005, 0.0005):
        underruns, heard = play(program, skew=skew, seconds=15, hertz=100.0)
        assert underruns == 0
        assert np.abs(np.diff(heard[24_000:])).max() < 1.2 * 0.5 * 2 * np.pi * 100 / 48_000


def test_a_stall_fades_and_what_comes_after_is_not_late_for_ever(program):
    underruns, heard = play(program, seconds=8, hertz=100.0, held=(2.0, 3.0))
    assert underruns == 1
    silent = np.convolve(np.abs(heard), np.ones(480), "same") < 1e-9
    assert silent[int(2.4 * 48_000) : int(2.9 * 48_000)].all()
    assert not silent[int(3.2 * 48_000) :].any()
    assert np.abs(np.diff(heard[9_600:])).max() < 0.02


@contextmanager
def listening(listen, address, source):
    """What a listener says, who is there until it is let go of; for a minute or two at most."""
    command = [MONO, listen, address, "flat", source, "60"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        limit = threading.Timer(_PATIENCE_S, process.kill)
        limit.start()
        try:
            yield process.stdout
        finally:
            limit.cancel()
            process.kill()


@pytest.mark.parametrize("source", ["trumpet", "live"])
def test_a_real_server_is_heard(listen, served, source):
    with listening(listen, served, source) as lines:
        found = (re.search(r"left ([\d.]+)  right ([\d.]+)  pose (\d+)  Live", line) for line in lines)
        assert any(
            min(float(each[1]), float(each[2])) > 1e-3 and int(each[3]) > 20 for each in found if each is not None
        )


def test_a_refusal_is_said(listen, served):
    command = [MONO, listen, served, "nowhere", "trumpet", "60"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert done.returncode == 1
    assert "unknown_scene" in done.stderr


def test_a_lost_connection_is_made_again(listen, served):
    from tests import visitor  # importing it skips where there is no playwright

    port = visitor.free_port()
    with listening(listen, f"127.0.0.1:{port}", "trumpet") as lines:

        def until(state: str, loudness: float = 0.0) -> None:
            assert any(state in line and float(re.search(r"left ([\d.]+)", line)[1]) >= loudness for line in lines)

        with visitor.passing_on(port, f"http://{served}"):
            until("Live", 1e-3)
        until("Waiting")
        with visitor.passing_on(port, f"http://{served}"):
            until("Live", 1e-3)


def test_the_components_play_in_a_game(program, served):
    [line] = answers(program, f"components ws://{served}/v1/stream flat")
    state, heard, left, after, *pose = line.split()
    assert state == "Live"
    assert float(heard) > 1e-3
    assert float(left) == 0
    assert float(after) < 0.01 * float(heard)
    # The scene's origin stands elsewhere in the game, turned by a quarter.
    np.testing.assert_allclose(np.array(pose, float), [2, 2.5, 1.5, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-5)


def test_one_shots_and_what_is_stopped_end_and_a_refusal_is_told(program, served):
    assert answers(program, f"shots ws://{served}/v1/stream flat trumpet") == ["6  unknown_clip"]


def test_a_second_camera_plays_what_is_heard_there(program, served):
    [line] = answers(program, f"cameras ws://{served}/v1/stream flat trumpet")
    own, near, after = map(float, line.split())
    assert near > 2 * own > 2e-3
    assert after == 0


def test_doors_move_and_one_that_the_scene_lacks_is_told(program, tmp_path, hrtfs):
    levels = FieldsByLevel.load(write_two_rooms(tmp_path / "scene"))
    with serving(levels, hrtfs) as address:
        assert answers(program, f"doors ws://{address}/v1/stream two-rooms") == ["3 unknown_door Live"]


def test_a_clip_that_has_ended_does_not_begin_again_before_the_game_is_told(program, served):
    assert answers(program, f"ending ws://{served}/v1/stream flat trumpet") == ["True 0"]


def test_a_microphone_is_heard(program, served):
    [loudest] = answers(program, f"microphone ws://{served}/v1/stream flat")
    assert float(loudest) > 1e-3
