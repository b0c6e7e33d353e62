"""The core of the Unreal client, compiled by g++: poses, messages and the buffer before the audio thread."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from server.protocol.client_messages import Hello, MoveEmitter, parse_client_message
from tests.clients import guests, one_shots
from tests.clients.vectors import CLIENTS, TABLE, assert_same_poses, poses, readme_commands

COMPILER = shutil.which("g++")
pytestmark = needs_compiler = pytest.mark.skipif(
    COMPILER is None, reason="no g++ on the PATH (Debian: apt-get install g++)"
)

# As Unreal compiles: no exceptions, no run-time types.
OPTIONS = [
    "-std=c++17",
    "-O1",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wpedantic",
    "-Werror",
    "-fno-rtti",
    "-fno-exceptions",
]


def compiled(source: Path, output: Path) -> Path:
    folders = [f"-I{CLIENTS / 'unreal'}", f"-I{CLIENTS / 'unreal' / 'Nafir'}"]
    command = [COMPILER, *OPTIONS, *folders, str(source), "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return output


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    return compiled(Path(__file__).with_name("unreal_driver.cpp"), tmp_path_factory.mktemp("unreal") / "driver")


@pytest.fixture(scope="module")
def listen(tmp_path_factory) -> Path:
    """As the README compiles it, and as strictly as the driver."""
    output = tmp_path_factory.mktemp("unreal") / "listen"
    _, compile_it, _ = readme_commands("unreal")
    command = compile_it.replace("g++", f"g++ {' '.join(OPTIONS)}").replace("-o listen", f"-o {output}")
    subprocess.run(command.split(), cwd=CLIENTS.parent, check=True)
    return output


def answers(program: Path, *commands: str) -> list[str]:
    done = subprocess.run([program], input="\n".join(commands), capture_output=True, text=True, timeout=60, check=True)
    assert done.stderr == ""
    return done.stdout.splitlines()


def numbers(*values: object) -> str:
    return " ".join(str(value) for value in values)


def test_poses_are_the_servers_and_come_back(program):
    unreal = poses("unreal")
    found = np.array([line.split() for line in answers(program, *(numbers("pose", *each) for each in unreal))], float)
    assert_same_poses(found[:, :7], poses("nafir"))
    assert_same_poses(found[:, 7:], unreal)


def test_a_listener_has_the_bytes_that_the_server_reads(program):
    wanted = TABLE["listener"]
    command = numbers("listener", wanted["pose_id"], *wanted["position"], *wanted["orientation"])
    assert answers(program, command) == [wanted["hex"]]


def test_dry_blocks_have_the_bytes_that_the_server_reads(program):
    blocks = TABLE["dry_blocks"]
    commands = [numbers("dry", each["encoding"], each["id"], each["sequence"], *each["samples"]) for each in blocks]
    assert answers(program, *commands) == [each["hex"] for each in blocks]


def test_audio_blocks_are_read_as_the_server_wrote_them(program):
    blocks = TABLE["audio_blocks"]
    lines = answers(program, *(numbers("block", each["encoding"], each["hex"]) for each in blocks))
    header = ("sequence", "sample_clock", "pose_id", "reverberation_pose_id", "flags")
    for line, wanted in zip(lines, blocks, strict=True):
        *found, channels = map(int, line.split()[:6])
        assert found == [wanted[name] for name in header]
        samples = np.array(line.split()[6:], float).reshape(-1, channels).T
        np.testing.assert_allclose(samples, wanted["channels"], atol=1e-7)


def test_a_damaged_block_is_none(program):
    whole = TABLE["audio_blocks"][1]
    sizes = range(0, len(whole["hex"]), 2)
    shorter = [numbers("block", whole["encoding"], whole["hex"][:size] or "0") for size in sizes]
    other_kind = numbers("block", whole["encoding"], "07" + whole["hex"][2:])
    assert set(answers(program, *shorter, other_kind)) == {"none"}


def test_text_messages_are_valid_and_say_what_was_meant(program):
    messages = list(map(parse_client_message, answers(program, "texts")))
    hello, other, clip, live, move, gain, remove, acknowledge = messages[:8]
    assert isinstance(hello, Hello)
    assert (hello.scene, hello.sample_rate, hello.encoding, hello.buffer_blocks) == ('flat "1"', 24_000, "s16", 4)
    assert hello.listener.pose.position == (1.5, -2.25, 0.1)
    np.testing.assert_allclose(hello.listener.pose.orientation, (0, 0, 0.6, 0.8))
    assert (other.sample_rate, other.block_size, other.encoding) == (None, 512, "f32")
    assert (clip.id, clip.clip, clip.gain_db, clip.loop) == ("a\\b\n", "trumpet", -3.5, False)
    assert (live.id, live.live) == ("npc-ä", True)
    assert isinstance(move, MoveEmitter)
    assert (move.pose_id, move.pose.position) == (2**32 - 1, (1.5, -2.25, 0.1))
    assert (gain.id, gain.gain_db, remove.id, acknowledge.sequence) == ("x", -6, "x", 2**32 - 1)


def test_messages_of_clips_and_of_resuming_are_valid_and_say_what_was_meant(program):
    resume, elsewhere, shot, loop, voice, stop, stop_now, ramp, level, ping, hello, door = map(
        parse_client_message, answers(program, "texts")[8:]
    )
    assert (resume.token, resume.snapshot, resume.sequence) == ('a"b', None, None)
    assert (elsewhere.token, elsewhere.snapshot) == (None, "c2ln")
    assert (elsewhere.sequence, elsewhere.sample_clock) == (7, 2**40)
    # Clocks of the stream are a thousand ahead of the server's here.
    assert (shot.start_at, shot.stop_at, shot.offset_s) == (4000, 0, 0.5)
    assert (shot.loop, shot.remove_when_ended) == (False, True)
    assert (loop.loop_start_s, loop.loop_end_s, loop.loop) == (0.25, 1.5, True)
    assert (voice.live, voice.jitter_ms) == (True, 40)
    assert (stop.stop_at, stop.fade_s, stop_now.stop_at, stop_now.fade_s) == (4000, 0.5, None, 0.01)
    assert (ramp.gain_db, ramp.ramp_s, level.level, ping.id) == (-6, 2.5, "auto", 9)
    assert (hello.level, hello.snapshots) == ("fine", True)
    assert (door.door, door.openness) == ('north "1"', 0.25)


def test_json_is_read_as_python_reads_it(program):
    texts = ['{"a":[1,-2.5e3,true,null,{}],"ü\\"\\u00e9\\u20ac\\n":"\\\\"}', '{"x":{"y":[[],[[]]]}}', "{}"]
    found = answers(program, *(f"json {text}" for text in texts))
    assert [json.loads(line) for line in found] == [json.loads(text) for text in texts]
    broken = ["{", '{"a"}', '{"a":}', '{"a":1,}', '{"a":tru}', '{"a":"\\u12"}', "{}x", "[" * 5000, '{"a":-}', '"a']
    assert set(answers(program, *(f"json {text}" for text in broken))) == {"refused"}


def test_a_stream_goes_on_if_the_server_has_handled_the_orders_that_are_gone(program):
    assert answers(program, "resume 1101", "resume 0") == ["resume go on 1 resume", "resume drop 0 hello"]


def test_doors_stay_as_the_game_has_them_over_lost_connections(program):
    assert [set(line.split()) for line in answers(program, "doors")] == [
        {"kitchen=0.75"},
        {"kitchen=0.5", "attic=1"},
        {"kitchen=0"},
        {"kitchen=0", "attic=1"},
    ]


def test_listeners_stay_as_the_game_has_them_whatever_becomes_of_the_connection(program):
    guests.check(answers(program, "guests"))


def test_what_plays_once_and_was_heard_is_not_begun_again_by_another_server(program):
    one_shots.check(answers(program, "shots"))


def test_the_component_is_of_the_engines_types():
    """By stand-ins for them: that it is C++, and what it takes for granted of the engine, is all that this says."""
    stub = Path(__file__).with_name("unreal_stub")
    component = CLIENTS / "unreal" / "Nafir" / "NafirListener.cpp"
    options = [*OPTIONS, "-Wno-unused-parameter", "-fsyntax-only", f"-I{stub}"]
    done = subprocess.run([COMPILER, *options, component], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def play(program, *, stream_rate=24_000, output_rate=48_000, skew=0.0, hertz=440.0, seconds=4.0, held=(-1.0, -1.0)):
    """Underruns, and what is heard of a tone of amplitude 0.5."""
    [line] = answers(program, numbers("play", stream_rate, output_rate, skew, hertz, seconds, *held))
    underruns, *heard = line.split()
    return int(underruns), np.array(heard, float)


@pytest.mark.parametrize(("stream_rate", "output_rate"), [(24_000, 48_000), (24_000, 44_100), (48_000, 48_000)])
def test_a_tone_comes_out_as_a_tone(program, stream_rate, output_rate):
    underruns, heard = play(program, stream_rate=stream_rate, output_rate=output_rate)
    assert underruns == 0
    last = heard[-output_rate:]
    window = np.hanning(len(last))
    spectrum = np.abs(np.fft.rfft(last * window)) / window.sum() * 2
    at = round(440 * len(last) / output_rate)
    assert spectrum[at - 2 : at + 3].max() == pytest.approx(0.5, rel=0.02)
    elsewhere = np.delete(spectrum, range(at - 60, at + 61))
    assert 20 * np.log10(elsewhere.max() / 0.5) < -70


@pytest.mark.parametrize("skew", [-0.0005, 0.0005])
def test_clocks_that_differ_cost_neither_gaps_nor_delay(program, skew):
    underruns, heard = play(program, skew=skew, seconds=60, hertz=100.0)
    assert underruns == 0
    late = heard[24_000:]
    assert np.abs(np.diff(late)).max() < 1.2 * 0.5 * 2 * np.pi * 100 / 48_000


def test_a_stall_fades_and_what_comes_after_is_not_late_for_ever(program):
    underruns, heard = play(program, seconds=8, hertz=100.0, held=(2.0, 3.0))
    assert underruns == 1
    silent = np.convolve(np.abs(heard), np.ones(480), "same") < 1e-9
    assert silent[int(2.4 * 48_000) : int(2.9 * 48_000)].all()
    assert not silent[int(3.2 * 48_000) :].any()
    assert np.abs(np.diff(heard[9_600:])).max() < 0.02  # a jump from a peak of the tone would be of 0.5


def test_a_real_server_is_heard(listen, served):
    _, _, line = readme_commands("unreal")
    host, port = served.split(":")
    given = line.replace("127.0.0.1", host).replace("8000", port).replace("apartment", "flat").split()[1:]
    command = [listen, *given, "trumpet", "5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    lines = re.findall(r"left ([\d.]+)  right ([\d.]+)  pose (\d+)  Live", done.stdout)
    left, right, pose = np.array(lines, float).T
    assert len(lines) >= 10
    assert left.max() > 1e-3
    # The clip is half a metre to the left of where the listener looks.
    assert np.sum(left**2) > np.sum(right**2)
    assert pose[-1] > 50


def test_a_refusal_is_said(listen, served):
    command = [listen, *served.split(":"), "nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "unknown_scene" in done.stderr
