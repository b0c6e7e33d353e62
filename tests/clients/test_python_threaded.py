"""The Python client for programs without asyncio, against a real server."""

import sys
import threading
import time

import numpy as np
import pytest

from nafir_client import ClosedError, MissingExtraError, Pose, RefusedError, UnreachableError, threaded
from nafir_client.playback import Player
from server.field.fields_by_level import FieldsByLevel
from tests.directional_flat import write_directional
from tests.serving import serving


def connect(address, **options):
    return threaded.connect(f"http://{address}", **{"scene": "flat", **options})


def played(stream, seconds, frames=480):
    """What a sound card would get that reads by a clock of its own."""
    begun_s, out = time.monotonic(), []
    for read in range(round(seconds * stream.output_rate / frames)):
        time.sleep(max(0.0, begun_s + read * frames / stream.output_rate - time.monotonic()))
        out.append(stream.read(frames))
    return np.concatenate(out)


def test_a_clip_is_heard_through_the_buffer(served):
    with connect(served) as stream:
        clip = stream.add_emitter(clip="woman-reading")
        stream.move_listener((2.5, 2.0, 1.5), yaw=0.5)
        clip.move((3.0, 2.0, 1.5))
        clip.set_gain(3.0)
        heard = played(stream, 1.2)
        counts = stream.statistics
    assert heard.shape[1] == 2
    assert np.sqrt(np.mean(heard[-12_000:] ** 2)) > 1e-3
    assert len(counts.pose_to_sound.durations) >= 1


def test_all_that_a_server_sends_ahead_has_room(served):
    with connect(served, buffer_blocks=32, block_size=1_024) as stream:
        played(stream, 0.5)
        assert stream.delay_s > 0.5
        assert stream.statistics.underruns == 0


def test_a_listener_begins_where_the_stream_says(served):
    with connect(served, listener=Pose.of((3.0, 3.0, 1.5), yaw=1.0)) as stream:
        assert stream.listener.position == (3.0, 3.0, 1.5)
        stream.move_listener((3.5, 3.0, 1.5)).result(5)
        assert stream.listener.position == (3.5, 3.0, 1.5)
    with connect(served) as stream:
        assert stream.listener == Pose.of((2.0, 2.5, 1.5), yaw=np.pi / 2)


@pytest.mark.parametrize("is_first", [True, False])
def test_an_on_block_that_raises_ends_its_listener_and_leaves_no_thread(served, is_first):
    def fall(block):
        raise OSError(f"no room for {block.frames} frames")

    stream = connect(served, on_block=fall if is_first else None)
    stream.__enter__()
    other = stream if is_first else stream.add_listener(on_block=fall)
    ends_s = time.monotonic() + 10
    while other.failure is None and time.monotonic() < ends_s:
        time.sleep(0.01)
    assert "no room for 256 frames" in str(other.failure)
    assert isinstance(other.failure.__cause__, OSError)
    if not is_first:
        assert stream.failure is None
        assert stream.add_listener(id=other.id).failure is None  # the server has the other no more
    with pytest.raises(OSError, match="no room"):
        stream.close()
    assert not stream._thread.is_alive()
    stream.close()


def test_reading_never_waits_and_is_silent_without_a_stream(served):
    stream = connect(served)
    assert not stream.read(100).any()
    with stream:
        stream.add_emitter(clip="trumpet")
        longest_s = 0.0
        for _ in range(300):
            begun_s = time.thread_time()
            stream.read(4_096)  # far more than comes
            longest_s = max(longest_s, time.thread_time() - begun_s)
        assert longest_s < 0.1
    assert isinstance(stream.failure, ClosedError)
    assert not stream.read(100_000)[-50_000:].any()


def test_what_is_written_from_another_thread_is_heard(served):
    with connect(served) as stream:
        live = stream.add_emitter()
        noise = np.random.default_rng(1).standard_normal(24_000).astype(np.float32) / 10

        def microphone():
            for start in range(0, len(noise), 480):
                live.write(noise[start : start + 480])
                time.sleep(480 / 24_000)

        thread = threading.Thread(target=microphone)
        thread.start()
        heard = played(stream, 1.0)
        thread.join()
    assert np.sqrt(np.mean(heard[-8_000:] ** 2)) > 1e-3


def test_refusals_come_to_the_thread_that_asked(served):
    with connect(served) as stream:
        with pytest.raises(RefusedError, match="unknown_clip"):
            stream.add_emitter(clip="kazoo")
        later = stream.add_emitter_later(clip="trumpet", id="a")
        clip = later.result(10)
        assert clip.id == "a"
        with pytest.raises(ValueError, match="'a' plays a clip"):
            clip.write(np.zeros(10))
        clip.remove()
    stream.move_listener((2.0, 2.0, 1.5))  # after the end nothing happens
    with pytest.raises(RefusedError, match="unknown_scene"), connect(served, scene="moon"):
        pass
    with pytest.raises(UnreachableError), connect("127.0.0.1:1"):
        pass


def test_blocks_and_messages_can_be_noted_on_their_way(served):
    blocks, messages = [], []
    with connect(served, on_block=blocks.append, on_message=messages.append) as stream:
        stream.add_emitter(clip="trumpet", id="a")
        played(stream, 0.2)
    assert [block.sequence for block in blocks] == list(range(len(blocks)))
    assert "emitter_added" in {message["type"] for message in messages}


@pytest.fixture(scope="module")
def served_directional(hrtfs, tmp_path_factory):
    levels = FieldsByLevel.load(write_directional(tmp_path_factory.mktemp("directional") / "flat"))
    with serving(levels, hrtfs) as address:
        yield address


@pytest.mark.parametrize("sample_rate", [pytest.param(24_000, marks=pytest.mark.long), 48_000])
def test_two_ears_hear_an_ambisonic_stream_and_turn_at_once(served_directional, sample_rate):
    with connect(served_directional, output="ambisonics", head="kemar", sample_rate=sample_rate) as stream:
        assert (stream.channels, stream.welcome.channels) == (2, 4)
        # To the left of one who looks north, and to the right of one who looks south.
        stream.add_emitter(clip="woman-reading", position=(1.0, 2.5, 1.5))
        stream.move_listener((4.0, 2.5, 1.5), yaw=np.pi / 2)
        facing_north = np.sqrt(np.mean(played(stream, 1.5)[-sample_rate:] ** 2, axis=0))
        stream.move_listener((4.0, 2.5, 1.5), yaw=-np.pi / 2)
        facing_south = np.sqrt(np.mean(played(stream, 1.0)[1_000:] ** 2, axis=0))
    assert facing_north[0] > 1.1 * facing_north[1]
    assert facing_south[1] > 1.1 * facing_south[0]


def test_of_ambisonics_one_listener_has_ears_and_another_the_channels(served_directional):
    with connect(served_directional, output="ambisonics", head="kemar") as stream:
        left, raw = stream.add_listener((4.0, 2.5, 1.5), yaw=np.pi / 2, head="kemar"), stream.add_listener()
        assert (stream.channels, left.channels, raw.channels) == (2, 2, 4)
        with pytest.raises(ValueError, match="output_rate: a head hears the stream's own rate"):
            stream.add_listener(head="kemar", output_rate=48_000)
        # To the left of one who looks north, and to the right of one who looks south.
        stream.add_emitter(clip="woman-reading", position=(1.0, 2.5, 1.5))
        facing_north = played(left, 1.0)
        left.move((4.0, 2.5, 1.5), yaw=-np.pi / 2)
        facing_south = played(left, 1.0)[1_000:]
        assert played(raw, 0.3).any()
    north, south = (np.sqrt(np.mean(sound**2, axis=0)) for sound in (facing_north, facing_south))
    assert north[0] > 1.1 * north[1]
    assert south[1] > 1.1 * south[0]


def test_a_head_for_another_output_is_refused(served):
    with pytest.raises(ValueError, match="head: belongs to the output ambisonics"), connect(served, head="kemar"):
        pass


def test_a_player_without_its_library_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'nafir-client\[play\]'"):
        Player(None)


class SoundCard:
    """What a player uses of sounddevice: a stream whose callback a thread of the card's calls for every 240 frames."""

    class PortAudioError(Exception):
        pass

    def __init__(self):
        self.played = []
        self.options = {}

    def OutputStream(self, *, callback, **options):  # noqa: N802  its name
        self.options, self._callback, self._is_open = options, callback, True
        self._thread = threading.Thread(target=self._play)
        return self

    def start(self):
        self._thread.start()

    def close(self):
        self._is_open = False
        self._thread.join()

    def _play(self):
        while self._is_open:
            out = np.full((240, self.options["channels"]), np.nan, np.float32)
            self._callback(out, 240, None, None)
            self.played.append(out)
            time.sleep(240 / self.options["samplerate"])


def test_a_player_fills_the_sound_card_at_the_rate_of_the_stream(served, monkeypatch):
    card = SoundCard()
    monkeypatch.setitem(sys.modules, "sounddevice", card)
    with connect(served) as stream, Player(stream, device=3):
        stream.add_emitter(clip="woman-reading")
        time.sleep(0.8)
    assert (card.options["samplerate"], card.options["channels"], card.options["device"]) == (24_000, 2, 3)
    heard = np.concatenate(card.played)
    assert np.isfinite(heard).all()
    assert np.sqrt(np.mean(heard**2)) > 1e-4
