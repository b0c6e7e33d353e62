import itertools
import json
import math
import struct
import threading
import time
from contextlib import contextmanager, suppress

import numpy as np
import pytest
import soundfile
import soxr
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from server.api.app import create_app
from server.api.settings import Settings
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock, DryBlock, DryPackets
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose, Ping, RemoveEmitter
from server.protocol.codecs import libopus
from server.protocol.codecs.libopus import OpusEncoder
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockReader
from server.protocol.server_messages import (
    EmitterAdded,
    EmitterEnded,
    EmitterRemoved,
    Error,
    Pong,
    Status,
    Welcome,
    parse_server_message,
)
from server.runtime.workers import Workers
from server.scene.effects import EffectName
from tests.directional_flat import write_directional

HELLO = Hello(protocol=PROTOCOL, scene="flat")
TALKER = AddEmitter(id="talker", clip="tone", position=(6.0, 3.0, 1.5))


@pytest.fixture(scope="module")
def clip_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips")
    tone = folder / "tone.wav"
    soundfile.write(tone, np.sin(np.arange(24_000) * 0.1) / 4, 24_000)
    broken = folder / "broken.wav"
    broken.write_bytes(b"RIFF but not really")
    noise = folder / "noise.wav"
    spectrum = np.fft.rfft(np.random.default_rng(5).standard_normal(24_000) / 8)
    frequency = np.fft.rfftfreq(24_000, 1 / 48_000)
    samples = np.fft.irfft(spectrum * ((frequency > 100) & (frequency < 10_000))) * np.hanning(24_000)
    soundfile.write(noise, samples, 48_000, subtype="FLOAT")
    return tone, broken, noise


@contextmanager
def serving(settings, bundle, hrtfs):
    scenes = {bundle.folder.name: FieldsByLevel.load(bundle)}
    with TestClient(create_app(settings, scenes=scenes, hrtfs=hrtfs)) as client:
        for _ in range(3_600):  # the first time ever, everything is compiled
            if client.get("/readyz").status_code == 200:
                break
            time.sleep(0.05)
        yield client


@pytest.fixture(scope="module")
def client(bundle, hrtfs, clip_files):
    with serving(Settings(clips=clip_files, hello_timeout_s=0.5), bundle, hrtfs) as client:
        yield client


@pytest.fixture(scope="module")
def client_of_directions(tmp_path_factory, hrtfs, clip_files):
    """Of a server of a scene whose field predicts directions."""
    directional = write_directional(tmp_path_factory.mktemp("scenes") / "flat", towards=(0.0, 0.0, 1.0))
    with serving(Settings(clips=clip_files[:1]), directional, hrtfs) as client:
        yield client


@pytest.fixture
def client_of_few(bundle, hrtfs):
    """Of a server of two streams."""
    with serving(Settings(max_streams=2), bundle, hrtfs) as client:
        yield client


class Ears:
    """A client that says hello, acknowledges every block, and can wait for what it wants to hear."""

    def __init__(self, socket, hello=HELLO):
        self.socket = socket
        self.send(hello)
        self.welcome = self.until(Welcome)
        self.reader = BlockReader(self.welcome)

    def send(self, message):
        self.socket.send_text(message if isinstance(message, str) else message.serialize())

    def receive(self):
        message = self.socket.receive()
        if message["type"] == "websocket.close":
            raise WebSocketDisconnect(message["code"], message.get("reason"))
        if message.get("text") is not None:
            return parse_server_message(message["text"])
        block = self.reader.read(message["bytes"])
        self.send(Acknowledge(sequence=block.sequence))
        return block

    def until(self, kind, condition=lambda _: True):
        for _ in range(2_000):
            message = self.receive()
            if isinstance(message, kind) and condition(message):
                return message
        raise AssertionError(f"no {kind.__name__} came")

    def until_sound(self):
        return self.until(AudioBlock, lambda block: block.samples.any())


@pytest.fixture
def ears(client):
    with client.websocket_connect("/v1/stream") as socket:
        yield Ears(socket)


def test_from_hello_to_sound(ears):
    assert (ears.welcome.sample_rate, ears.welcome.block_size, ears.welcome.channels) == (24_000, 256, 2)
    assert ears.welcome.scene.id == "flat"
    assert ears.welcome.max_emitters == Settings().max_emitters
    first = ears.until(AudioBlock)
    assert (first.sequence, first.sample_clock, first.samples.shape) == (0, 0, (2, 256))
    # Half a metre away, so that the direct sound arrives within the first block.
    ears.send(AddEmitter(id="talker", clip="tone", position=(2.0, 3.0, 1.5)))
    added = ears.until(EmitterAdded)
    assert ears.until_sound().sample_clock == added.sample_clock
    ears.send(RemoveEmitter(id="talker"))
    assert ears.until(EmitterRemoved).id == "talker"
    ears.until(AudioBlock, lambda block: not block.samples.any())


def test_a_sound_that_has_ended_makes_room_for_the_next(client):
    with client.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket)
        (place,) = client.app_state["host"].admission._places
        for number in range(2):
            start_at = ears.until(AudioBlock).sample_clock + 4_800
            door = TALKER.model_copy(
                update={"loop": False, "offset_s": 0.95, "start_at": start_at, "remove_when_ended": True}
            )
            ears.send(door)
            assert ears.until(EmitterAdded).sample_clock == start_at
            assert place.emitters == 1, number
            ended = ears.until(EmitterEnded)
            assert ended.removed
            assert ended.sample_clock > start_at + 1_200
            assert place.emitters == 0


def test_turning_the_head_swaps_the_louder_ear(ears):
    ears.send(TALKER)

    def louder_ear(yaw, pose_id):
        ears.send(ListenerPose(pose_id=pose_id, position=(6.0, 1.0, 1.5), yaw=yaw))
        ears.until(AudioBlock, lambda block: block.reverberation_pose_id == pose_id and not block.is_exchange)
        energy = sum(np.sum(ears.until(AudioBlock).samples ** 2, axis=1) for _ in range(40))
        return int(np.argmax(energy))

    # The talker stands to the north; who looks east has it on the left.
    assert (louder_ear(0.0, 1), louder_ear(math.pi, 2)) == (0, 1)


def test_integer_samples_and_other_block_sizes_are_negotiated(client):
    hello = Hello(protocol=PROTOCOL, scene="flat", encoding="s16", block_size=512, sample_rate=24_000, buffer_blocks=2)
    with client.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, hello)
        assert ears.until(AudioBlock).samples.shape == (2, 512)
        ears.send(TALKER)
        assert 0.001 < np.abs(ears.until_sound().samples).max() <= 1


def opus(**options):
    return Hello(protocol=PROTOCOL, scene="flat", encoding="opus", opus=OpusOptions(**options))


def heard_from_its_beginning(client, hello, seconds=0.5):
    """What a stream hears of a clip from a while after its beginning, when all effects are decided: (2, n)."""
    with client.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, hello)
        ears.send(ListenerPose(pose_id=1, position=(2.0, 3.5, 1.5), yaw=0.3))
        ears.send(AddEmitter(id="talker", clip="tone", position=(2.0, 3.0, 1.5)))
        clock, heard = ears.until(EmitterAdded).sample_clock + 12_000, []
        while sum(piece.shape[1] for piece in heard) < seconds * 24_000:
            block = ears.until(AudioBlock, lambda block: block.sample_clock + block.samples.shape[1] > clock)
            heard.append(block.samples[:, max(0, clock - block.sample_clock) :])
        return np.concatenate(heard, axis=1)[:, : round(seconds * 24_000)].astype(np.float64)


def test_a_stream_in_opus_sounds_like_one_in_floats_at_the_same_clock(client):
    floats = heard_from_its_beginning(client, HELLO)
    for options in ({"bitrate": 128_000}, {"bitrate": 192_000, "frame_ms": 20, "application": "audio"}):
        coded = heard_from_its_beginning(client, opus(**options))
        # A sample more or less would be 0.01 of the energy of this tone.
        assert np.sum((coded - floats) ** 2) / np.sum(floats**2) < 0.003, options


def test_a_welcome_says_how_to_decode(client):
    with client.websocket_connect("/v1/stream") as socket:
        welcome = Ears(socket, opus(frame_ms=5, complexity=0)).welcome
        assert (welcome.encoding, welcome.opus.frame_samples, welcome.opus.look_ahead) == ("opus", 120, 60)
        assert welcome.opus.streams == (2,)
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(HELLO.serialize())
        assert "opus" not in json.loads(socket.receive_text())


def test_ambisonics_in_opus_have_a_stream_for_each_pair(client_of_directions):
    hello = Hello(protocol=PROTOCOL, scene="flat", output="ambisonics", order=2, encoding="opus")
    with client_of_directions.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, hello)
        assert ears.welcome.opus.streams == (2, 2, 2, 2, 1)
        ears.send(TALKER)
        assert ears.until_sound().samples.shape[0] == 9


def test_blocks_are_encoded_on_a_thread_for_it(client, monkeypatch):
    """And neither on the event loop, which all clients share, nor on an audio thread."""
    threads, encode = set(), OpusEncoder.encode

    def watched(encoder, frame):
        threads.add(threading.current_thread().name)
        return encode(encoder, frame)

    monkeypatch.setattr(OpusEncoder, "encode", watched)
    with client.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, opus())
        for _ in range(10):
            ears.until(AudioBlock)
    assert threads
    assert threads <= {"nafir-encoder-0", "nafir-encoder-1"}


def test_a_stream_that_cannot_be_encoded_ends_and_says_so(client, monkeypatch, caplog):
    with client.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, opus())
        ears.until(AudioBlock)
        monkeypatch.setattr(OpusEncoder, "encode", None)
        assert ears.until(Error).code == "internal_error"
        with pytest.raises(WebSocketDisconnect):
            ears.receive()
    assert "could not be encoded" in caplog.text
    monkeypatch.undo()
    assert client.get("/readyz").status_code == 200
    with client.websocket_connect("/v1/stream") as socket:
        Ears(socket, opus()).until(AudioBlock)


def test_where_there_is_no_opus_a_hello_is_told(client, monkeypatch):
    offered = client.get("/v1/encodings").json()["encodings"]
    assert [each["name"] for each in offered] == ["f32", "s16", "opus"]
    assert offered[2]["sample_rates"] == [8_000, 12_000, 16_000, 24_000, 48_000]
    monkeypatch.setattr(libopus, "_library", lambda: None)
    assert [each["name"] for each in client.get("/v1/encodings").json()["encodings"]] == ["f32", "s16"]
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(opus().serialize())
        error = parse_server_message(socket.receive_text())
        assert (error.code, error.field) == ("unsupported_encoding", "encoding")
        with pytest.raises(WebSocketDisconnect):
            socket.receive_text()


def test_live_packets_are_heard_and_broken_ones_refused(ears):
    ears.send(ListenerPose(pose_id=1, position=(2.0, 2.5, 1.5), yaw=0.0))
    ears.send(AddEmitter(id="voice", live=True, position=(2.0, 3.5, 1.5)))
    ears.until(EmitterAdded)
    encoder = OpusEncoder(sample_rate=24_000, channels=1, application="voip", bitrate=32_000, complexity=5)
    tone = np.sin(np.arange(480 * 40) * 2 * np.pi * 8 / 256).astype(np.float32).reshape(40, 480, 1)
    energy = np.zeros(2)
    for sequence, frame in enumerate(tone):
        packet = encoder.encode(frame)
        if sequence == 20:
            continue  # lost
        if sequence == 21:
            ears.socket.send_bytes(DryPackets("voice", 21, 480, (b"\xff\x3f",)).serialize())
            assert ears.until(Error).code == "malformed_block"
        ears.socket.send_bytes(DryPackets("voice", sequence, 480, (packet,)).serialize())
        energy += sum(np.sum(ears.until(AudioBlock).samples ** 2, axis=1) for _ in range(2))
    assert energy[0] > 2 * energy[1] > 0  # it stands to the left
    (live,) = ears.until(Status, lambda status: status.live and status.live[0].samples_concealed).live
    assert (live.id, live.samples_concealed) == ("voice", 480)


def test_a_server_that_is_ready_has_measured_what_the_page_asks_for(client_of_directions, monkeypatch):
    """Its first sound waits for no calibration of ambisonics."""
    from server.api import connection

    monkeypatch.setattr(connection, "calibrate", None)
    with client_of_directions.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, Hello(protocol=PROTOCOL, scene="flat", output="ambisonics", order=1))
        assert ears.welcome.order == 1


def test_a_stream_of_ambisonics_from_hello_to_sound(client_of_directions):
    hello = Hello(protocol=PROTOCOL, scene="flat", output="ambisonics", order=2, encoding="s16")
    with client_of_directions.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, hello)
        assert (ears.welcome.channels, ears.welcome.order) == (9, 2)
        ears.send(TALKER)
        assert ears.until_sound().samples.shape == (9, 256)
        ears.send(ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5), yaw=1.0))
        ears.until(AudioBlock, lambda block: block.reverberation_pose_id == 1)
        turned = ears.until(AudioBlock)
        ears.send(ListenerPose(pose_id=2, position=(2.0, 2.0, 1.5), yaw=2.0))
        block = ears.until(AudioBlock, lambda block: block.pose_id == 2)
        assert (block.reverberation_pose_id, block.is_exchange) == (2, False)
        assert turned.samples.any()


@pytest.mark.parametrize(("rate", "output"), [(48_000, "headphones"), (44_100, "ambisonics"), (96_000, "mono")])
def test_a_stream_at_another_rate_than_the_scenes_plays_clips_at_their_pitch(client_of_directions, rate, output):
    hello = HELLO.model_copy(update={"sample_rate": rate, "output": output, "block_size": 1024})
    with client_of_directions.websocket_connect("/v1/stream") as socket:
        ears = Ears(socket, hello)
        welcome = ears.welcome
        assert (welcome.sample_rate, welcome.scene.sample_rate) == (rate, 24_000)
        assert rate in welcome.scene.sample_rates
        assert welcome.ir_samples == math.ceil(welcome.scene.ir_samples * rate / 24_000)
        # The window lasts as long as at the scene's rate.
        assert welcome.window - welcome.buffer_blocks == math.ceil(Settings().window_blocks * rate / 24_000)
        ears.send(TALKER)
        ears.until_sound()
        blocks = [ears.until(AudioBlock) for _ in range(rate // 2 // 1024)]
        assert {b.sample_clock - a.sample_clock for a, b in itertools.pairwise(blocks)} == {1024}
        samples = np.concatenate([block.samples[0] for block in blocks])
        spectrum = np.abs(np.fft.rfft(samples * np.hanning(samples.size), 8 * rate))
        assert np.argmax(spectrum) / 8 == pytest.approx(0.1 * 24_000 / (2 * np.pi), abs=0.3)


def test_streams_of_every_rate_and_encoding_agree(client, clip_files):
    clip = AddEmitter(id="a", clip=clip_files[2].stem, position=(6.0, 3.0, 1.5), loop=False)
    every = dict.fromkeys(EffectName, True)

    def heard(rate, encoding):
        """(n,) half a second of the left ear from the moment when the clip begins, whatever the plan says."""
        hello = HELLO.model_copy(
            update={"sample_rate": rate, "encoding": encoding, "block_size": 512, "effects": every}
        )
        samples = np.zeros(rate // 2)
        with client.websocket_connect("/v1/stream") as socket:
            ears = Ears(socket, hello)
            ears.send(clip)
            begins = ears.until(EmitterAdded).sample_clock
            at = 0
            while at < samples.size:
                block = ears.until(AudioBlock, lambda block: block.sample_clock + block.samples.shape[1] > begins)
                at, skipped = max(0, block.sample_clock - begins), max(0, begins - block.sample_clock)
                part = block.samples[0, skipped : skipped + samples.size - at]
                samples[at : at + part.size] = part
                at += part.size
        return samples

    def signal_to_noise_db(actual, expected):
        return 10 * np.log10(np.sum(expected**2) / (np.sum((actual - expected) ** 2) + 1e-30))

    own = heard(24_000, "f32")
    for rate in (24_000, 44_100, 48_000, 96_000):
        exact, rounded = (heard(rate, encoding) for encoding in ("f32", "s16"))
        assert signal_to_noise_db(rounded, exact) > 50  # at some -40 dB of full scale
        # The air's minimum phase is that of the whole band, a microsecond later at 96 kHz.
        assert signal_to_noise_db(soxr.resample(exact, rate, 24_000, quality="VHQ"), own) > 35
        if libopus.is_available() and rate in libopus.RATES:
            assert signal_to_noise_db(heard(rate, "opus"), exact) > 10  # noise keeps its spectrum rather than its wave


def test_a_stream_of_two_ears_has_no_order(client):
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(HELLO.serialize())
        assert "order" not in json.loads(socket.receive_text())


def test_a_scene_of_ears_refuses_a_hello_for_ambisonics(client):
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(Hello(protocol=PROTOCOL, scene="flat", output="ambisonics").serialize())
        error = parse_server_message(socket.receive_text())
        assert (error.code, error.field) == ("no_directions", "output")
        with pytest.raises(WebSocketDisconnect):
            socket.receive_text()


def test_binary_poses_are_heard(ears):
    ears.send(TALKER)
    ears.until_sound()  # an IR that comes before the first block is not faded to
    ears.socket.send_bytes(ListenerPose(pose_id=5, position=(3.0, 2.0, 1.5)).serialize_binary())
    exchange = ears.until(AudioBlock, lambda block: block.reverberation_pose_id == 5)
    assert exchange.is_exchange
    assert exchange.pose_id == 5


def test_what_a_client_sends_live_comes_back_from_where_its_emitter_is(ears):
    ears.send(ListenerPose(pose_id=1, position=(2.0, 2.5, 1.5), yaw=0.0))
    ears.send(AddEmitter(id="voice", live=True, position=(2.0, 3.5, 1.5)))
    ears.until(EmitterAdded)
    assert not ears.until(AudioBlock).samples.any()
    tone = np.sin(np.arange(256) * 2 * np.pi * 8 / 256).astype(np.float32)
    energy = np.zeros(2)
    for sequence in range(60):
        ears.socket.send_bytes(DryBlock("voice", sequence, tone).serialize("s16"))
        energy += np.sum(ears.until(AudioBlock).samples ** 2, axis=1)
    assert energy[0] > 2 * energy[1] > 0  # it stands to the left
    (live,) = ears.until(Status, lambda status: status.live and status.live[0].underruns).live
    assert (live.id, live.samples_queued, live.samples_gated) == ("voice", 0, 0)


def test_pings_and_status(ears):
    ears.send(Ping(id=77))
    assert ears.until(Pong) == Pong(id=77)
    status = ears.until(Status)
    assert status.sample_clock >= 24_000
    assert status.blocks_dropped == 0


BAD_TEXT = [
    ("{", "malformed_message"),
    ('{"type": "levitate"}', "unknown_message"),
    ('{"type": "listener", "pose_id": 1, "position": [1, NaN, 1]}', "malformed_pose"),
    ('{"type": "listener", "pose_id": 1, "position": [1, 2]}', "malformed_pose"),
    ('{"type": "listener", "pose_id": 1, "position": [1, 2, 1], "orientation": [0, 0, 0, 0]}', "malformed_pose"),
    ('{"type": "listener", "pose_id": 1, "position": [100, 2, 1]}', "position_out_of_bounds"),
    ('{"type": "listener", "pose_id": 0, "position": [1, 2, 1]}', "stale_pose"),
    ('{"type": "add_emitter", "id": "x", "clip": "kazoo", "position": [1, 2, 1]}', "unknown_clip"),
    ('{"type": "add_emitter", "id": "x", "clip": "broken", "position": [1, 2, 1]}', "undecodable_clip"),
    ('{"type": "add_emitter", "id": "x", "clip": "tone", "position": [1, 2, 10]}', "position_out_of_bounds"),
    ('{"type": "add_emitter", "id": "talker", "clip": "tone", "position": [1, 2, 1]}', "duplicate_emitter"),
    ('{"type": "move_emitter", "id": "ghost", "position": [1, 2, 1], "pose_id": 1}', "unknown_emitter"),
    ('{"type": "remove_emitter", "id": "ghost"}', "unknown_emitter"),
    ('{"type": "acknowledge", "sequence": 4000000000}', "unknown_sequence"),
    ('{"type": "add_emitter", "id": "x", "position": [1, 2, 1]}', "malformed_message"),
    (
        '{"type": "add_emitter", "id": "x", "clip": "tone", "position": [1, 2, 1], "directivity": {"pattern": "odd"}}',
        "malformed_directivity",
    ),
    ('{"type": "set_gain", "id": "ghost", "gain_db": 0}', "unknown_emitter"),
    ('{"type": "hello", "protocol": 3, "scene": "flat"}', "unexpected_hello"),
    (json.dumps({"type": "ping", "id": 1, "padding": "x" * 70_000}), "message_too_large"),
    # Few enough characters, too many bytes.
    (json.dumps({"type": "ping", "id": 1, "padding": "é" * 40_000}, ensure_ascii=False), "message_too_large"),
]
BAD_BYTES = [
    (b"", "unknown_message"),
    (b"\xff" * 36, "unknown_message"),
    (b"\x02" * 35, "malformed_pose"),
    (struct.pack("<BBHI7f", 2, 0, 0, 1, math.inf, 0, 0, 0, 0, 0, 1), "malformed_pose"),
    (b"\x03" * 40, "malformed_block"),
    (DryBlock("ghost", 0, np.ones(4, np.float32)).serialize("f32"), "unknown_emitter"),
    (DryBlock("talker", 0, np.ones(4, np.float32)).serialize("f32"), "not_live"),
    (bytes(70_000), "message_too_large"),
]


def test_every_bad_message_gets_its_code_and_the_stream_goes_on(ears):
    ears.send(TALKER)
    ears.until_sound()
    for bad, code in BAD_TEXT + BAD_BYTES:
        ears.socket.send_bytes(bad) if isinstance(bad, bytes) else ears.socket.send_text(bad)
        error = ears.until(Error)
        assert error.code == code
        assert error.message
    before = ears.until(AudioBlock)
    after = ears.until(AudioBlock, lambda block: block.sequence == before.sequence + 20)
    assert after.sample_clock == before.sample_clock + 20 * 256
    ears.send(ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5)))
    ears.until(AudioBlock, lambda block: block.pose_id == 1)


def test_a_clip_that_cannot_be_decoded_says_why(ears):
    ears.send(AddEmitter(id="x", clip="broken", position=(1.0, 2.0, 1.0)))
    error = ears.until(Error)
    assert (error.field, error.emitter) == ("clip", "x")
    assert "broken.wav" in error.message
    assert len(error.message) > len("broken.wav: ")


@pytest.mark.parametrize(
    ("first", "code"),
    [
        (Ping(id=1).serialize(), "hello_expected"),
        ("?", "malformed_message"),
        (Hello(protocol=2, scene="flat").serialize(), "unsupported_protocol"),
        (Hello(protocol=PROTOCOL, scene="flat", hrtf="moomin").serialize(), "unknown_hrtf"),
        (Hello(protocol=PROTOCOL, scene="moon").serialize(), "unknown_scene"),
        (Hello(protocol=PROTOCOL, scene="flat", sample_rate=32_000).serialize(), "unsupported_sample_rate"),
        (
            '{"type": "hello", "protocol": 3, "scene": "flat", "listener": {"position": [99, 1, 1]}}',
            "position_out_of_bounds",
        ),
        ('{"type": "hello", "protocol": 4, "scene": "flat", "spatial": true}', "unsupported_protocol"),
        (b"", "hello_expected"),
        (ListenerPose(pose_id=1, position=(2.0, 2.0, 1.5)).serialize_binary(), "hello_expected"),
        (b"\xff" * 40, "hello_expected"),
        (None, "hello_expected"),
    ],
)
def test_a_bad_hello_is_answered_and_ends_the_connection(client, first, code):
    with client.websocket_connect("/v1/stream") as socket:
        if isinstance(first, bytes):
            socket.send_bytes(first)
        elif first is not None:
            socket.send_text(first)
        assert parse_server_message(socket.receive_text()).code == code
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_text()
        assert (closed.value.code, closed.value.reason) == (1008, code)


def test_a_full_server_says_so_and_has_room_again_when_someone_leaves(client_of_few):
    with (
        client_of_few.websocket_connect("/v1/stream") as first,
        client_of_few.websocket_connect("/v1/stream") as second,
    ):
        Ears(first), Ears(second)
        with (
            pytest.raises(WebSocketDenialResponse) as refused,
            client_of_few.websocket_connect("/v1/stream"),
        ):
            pass
        answers = refused.value, client_of_few.get("/v1/stream")
        assert [(answer.status_code, answer.json()["code"]) for answer in answers] == [(503, "server_busy")] * 2
        assert all(1 <= int(answer.headers["retry-after"]) <= 60 for answer in answers)
        second.close()
        for _ in range(100):
            with (
                suppress(WebSocketDenialResponse),
                client_of_few.websocket_connect("/v1/stream") as socket,
            ):
                socket.send_text(HELLO.serialize())
                if parse_server_message(socket.receive_text()).type == "welcome":
                    return
            time.sleep(0.02)
    raise AssertionError("no room for a new stream")


def test_a_hello_whose_turn_to_begin_does_not_come_is_told_when_to_come_back(client_of_few, monkeypatch):
    """While first responses of others wait for a worker, nobody else begins; its place is free again."""
    admission = client_of_few.app_state["host"].admission
    monkeypatch.setattr(admission, "_is_on", True)
    monkeypatch.setattr(Workers, "has_urgent", property(lambda _: True))
    with client_of_few.websocket_connect("/v1/stream") as socket:
        socket.send_text(HELLO.serialize())
        refused = parse_server_message(socket.receive_text())
        assert refused.code == "server_busy"
        assert "too many streams begin" in refused.message
        assert 1 <= refused.retry_after_s <= 60
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_text()
        assert closed.value.code == 1013
    assert admission.streams == 0
    assert admission.refusals["hello", "opening"] == 1
    monkeypatch.setattr(Workers, "has_urgent", property(lambda _: False))
    with client_of_few.websocket_connect("/v1/stream") as socket:
        Ears(socket)


def test_a_client_that_never_acknowledges_gets_a_window_and_then_nothing(client):
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(HELLO.serialize())
        window = parse_server_message(socket.receive_text()).window
        sequences = []
        while True:
            message = socket.receive()
            if message.get("text") is not None:
                status = parse_server_message(message["text"])
                if status.sample_clock >= 24_000:
                    break
            else:
                sequences.append(AudioBlock.parse(message["bytes"], "f32").sequence)
        assert sequences == list(range(window))
        assert status.unacknowledged == window
        assert status.blocks_dropped == pytest.approx(94 - window, abs=3)
