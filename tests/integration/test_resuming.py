"""Streams whose connections break. What is heard before and after the gap is compared, sample by sample, with a render
of the whole clip: where a clip is shows where the clock is."""

import asyncio
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise

import numpy as np
import pytest
import uvicorn
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from server.acoustics.decibels import amplitude_to_db
from server.acoustics.geometry import Pose
from server.api.app import create_app
from server.api.process_peers import OWN_STREAMS, PEER_KEY, ProcessPeers
from server.api.processes import listening_privately
from server.api.serving import Server, uvicorn_options
from server.api.settings import Settings
from server.assets.clips import ClipLibrary
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    Hello,
    ListenerPose,
    Ping,
    RemoveEmitter,
    Resume,
    SetGain,
)
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockReader
from server.protocol.server_messages import EmitterAdded, Error, SnapshotTaken, Welcome, parse_server_message
from server.protocol.snapshot import Seal
from server.responses.direct_sound import DirectSound
from server.runtime.drain import Drain
from server.scene.effects import EffectName
from tests.integration.lossy_proxy import LossyProxy

RATE, BLOCK = 24_000, 512
CLIP = "woman-reading"
PLACE = (6.0, 3.0, 1.5)
# Every effect, as the render has it, so that no plan comes between.
HELLO = Hello(
    protocol=PROTOCOL, scene="flat", block_size=BLOCK, effects={name.value: True for name in EffectName}, emitters=1
)
IN_OPUS = HELLO.model_copy(update={"encoding": "opus", "opus": OpusOptions(bitrate=256_000)})
TALKER = AddEmitter(id="talker", clip=CLIP, position=PLACE)
KEY = "a key of the processes"
SETTLED = 8_000
"""Samples after which the response is filled with sound, and all fades are over."""


class Listener:
    """A client that acknowledges what it hears, and keeps all of it."""

    def __init__(self, address, first, *, patience_s=5.0):
        self._open = ExitStack()
        url = f"ws://{address}/v1/stream"
        self.socket = self._open.enter_context(connect(url, compression=None, max_size=None, close_timeout=0.1))
        self.blocks, self.messages = [], []
        self.send(first)
        self.first = parse_server_message(self.socket.recv(timeout=patience_s))
        self.reader = BlockReader(self.first) if isinstance(self.first, Welcome) else None

    def send(self, message):
        self.socket.send(message if isinstance(message, str) else message.serialize())

    def receive(self, patience_s=5.0):
        message = self.socket.recv(timeout=patience_s)
        if isinstance(message, str):
            self.messages.append(parse_server_message(message))
            return self.messages[-1]
        block = self.reader.read(message)
        self.blocks.append(block)
        with suppress(ConnectionClosed):  # what has arrived before is still to be read
            self.send(Acknowledge(sequence=block.sequence))
        return block

    def until(self, kind, condition=lambda _: True, patience_s=5.0):
        end_s = time.monotonic() + patience_s
        while time.monotonic() < end_s:
            message = self.receive()
            if isinstance(message, kind) and condition(message):
                return message
        raise AssertionError(f"no {kind.__name__} came")

    def hear(self, samples):
        """Until so many more samples of the clock have come."""
        last = self.until(AudioBlock)
        return self.until(AudioBlock, lambda block: block.sample_clock >= last.sample_clock + samples, 10.0)

    def resumption(self, **changes):
        last = self.blocks[-1] if self.blocks else None
        known = {} if last is None else {"sequence": last.sequence, "sample_clock": last.sample_clock}
        return Resume(**{"protocol": PROTOCOL, "token": self.first.resume_token, **known, **changes})

    def to_the_end(self):
        """Hear until the connection ends, and return why."""
        try:
            while True:
                self.receive()
        except ConnectionClosed as closed:
            return closed.rcvd

    def drop(self):
        """Lose the connection without a goodbye."""
        self.socket.socket.shutdown(socket.SHUT_RDWR)
        assert self.to_the_end() is None

    def close(self):
        self._open.close()


@contextmanager
def listening(address, first=HELLO, **options):
    listener = Listener(address, first, **options)
    try:
        yield listener
    finally:
        listener.close()


@pytest.fixture(scope="module")
def expected(bundle, filters):
    """(2, n): the clip, twice, as the room has it."""
    clip = np.tile(ClipLibrary(RATE).load(CLIP).samples, 2)
    start = bundle.manifest.start
    path = [PathPoint.at(0, Pose.from_yaw(start.listener, np.radians(start.listener_yaw_deg)))]
    emitter = RenderedEmitter(clip, Pose(PLACE))
    return render(AcousticField.load(bundle), DirectSound.of(bundle, filters), [emitter], path)


def error_db(blocks, expected, since):
    """How far blocks are from what the clip sounds like at their place on the clock."""
    heard = np.concatenate([block.samples for block in blocks], axis=1)
    places = np.concatenate([block.sample_clock - since + np.arange(block.samples.shape[1]) for block in blocks])
    wanted = expected[:, places]
    return amplitude_to_db(np.sqrt(np.mean((heard - wanted) ** 2) / np.mean(wanted**2)))


def begin(listener):
    listener.send(TALKER)
    added = listener.until(EmitterAdded)
    listener.hear(SETTLED)
    return added.sample_clock


def after(blocks, samples):
    return [block for block in blocks if block.sample_clock >= blocks[0].sample_clock + samples]


@pytest.mark.parametrize(
    ("gap_s", "hello", "most_db"),
    [(0.5, HELLO, -80.0), pytest.param(10.0, HELLO, -80.0, marks=pytest.mark.long), (0.5, IN_OPUS, -20.0)],
)
def test_a_gap_costs_a_fade_and_nothing_else(served, expected, gap_s, hello, most_db):
    with LossyProxy(served).running() as network, listening(network.address, hello) as before:
        assert before.first.resumed is None
        since = begin(before)
        lost = before.hear(RATE // 4)
        cut_s = time.monotonic()
        network.cut()
        time.sleep(gap_s)
        with listening(network.address, before.resumption()) as again:
            resumed = again.first.resumed
            passed_s = time.monotonic() - cut_s
            # Sent up to eight blocks ahead of real time, both before and after.
            gap = resumed.sample_clock - lost.sample_clock
            assert gap == pytest.approx(passed_s * RATE, abs=20 * BLOCK)
            again.hear(SETTLED + RATE // 2)
            first = again.blocks[0]
            assert (first.sequence, first.sample_clock) == (resumed.sequence, resumed.sample_clock)
            assert resumed.sequence == before.blocks[-1].sequence + 1
            assert resumed.sample_clock % BLOCK == 0
    assert again.first.session == before.first.session
    assert again.first.resume_token != before.first.resume_token
    assert not any(isinstance(message, EmitterAdded) for message in again.messages)
    assert error_db(after(before.blocks, since - before.blocks[0].sample_clock + SETTLED), expected, since) < most_db
    assert error_db(after(again.blocks, SETTLED), expected, since) < most_db
    # And what it costs is a fade: nothing jumps in.
    sound = np.concatenate([block.samples for block in again.blocks], axis=1)
    onset = int(np.flatnonzero(np.abs(sound).max(axis=0) > 0)[0])
    assert np.abs(np.diff(sound[:, max(0, onset - 1) : onset + 64])).max() < 0.1 * np.abs(sound).max()


@pytest.mark.parametrize("count", [1, pytest.param(4, marks=pytest.mark.long)])
def test_a_slow_and_lossy_network_breaks_again_and_again(served, expected, count):
    """200 ms of delay and 15 % of loss. The clock only rises, and blocks are numbered without a gap."""
    blocks = []
    with LossyProxy(served, delay_s=0.2, loss=0.15).running() as network:
        listener = Listener(network.address, HELLO.model_copy(update={"buffer_blocks": 32}))
        since = begin(listener)
        for _ in range(count):
            listener.hear(RATE // 4)
            blocks += listener.blocks
            network.cut()
            listener.close()
            listener = Listener(network.address, listener.resumption())
            assert listener.first.resumed is not None
        # The first 32 blocks are rendered before the first response is there.
        settled = SETTLED + 32 * BLOCK
        listener.hear(settled + RATE // 4)
        listener.close()
    assert error_db(after(listener.blocks, settled), expected, since) < -80
    blocks += listener.blocks
    assert [block.sequence for block in blocks] == list(range(len(blocks)))
    assert all(a.sample_clock < b.sample_clock for a, b in pairwise(blocks))


def test_a_half_open_connection_is_taken_over(served, expected):
    """The server still believes in it, and would until it is stalled."""
    with LossyProxy(served).running() as network, listening(network.address) as old:
        since = begin(old)
        network.go_dark()
        with listening(network.address, old.resumption()) as new:
            assert new.first.resumed.sample_clock > old.blocks[-1].sample_clock
            new.hear(SETTLED + RATE // 4)
    assert error_db(after(new.blocks, SETTLED), expected, since) < -80


def test_who_is_taken_over_is_told(served):
    with listening(served) as old:
        old.hear(BLOCK)
        with listening(served, old.resumption()) as new:
            ending = old.to_the_end()
            assert (ending.code, ending.reason) == (4409, "taken_over")
            assert old.messages[-1].code == "taken_over"
            assert new.first.resumed is not None


def test_nothing_that_was_handled_is_lost_and_the_rest_is_told(served):
    """The client learns how many of its messages came, and up to which pose."""
    changes = [
        TALKER,
        SetGain(id="talker", gain_db=-6.0),
        '{"type": "set_gain", "id": "nobody", "gain_db": 1}',
        "no message at all",
        AddEmitter(id="second", clip=CLIP, position=(2.0, 3.0, 1.5)),
        RemoveEmitter(id="second"),
    ]
    with listening(served) as listener:
        for number, change in enumerate(changes, 1):
            listener.send(change)
            listener.send(ListenerPose(pose_id=number, position=(2.0 + 0.1 * number, 2.5, 1.5)))
            listener.send(Ping(id=number))
            listener.send('{"type": "ping", "id": -1}')
        listener.until(AudioBlock, lambda block: block.pose_id == len(changes))
        listener.drop()
    with listening(served, listener.resumption()) as again:
        resumed = again.first.resumed
        assert (resumed.handled, resumed.pose_id) == (len(changes), len(changes))
        again.send(AddEmitter(id="talker", clip=CLIP, position=PLACE))
        assert again.until(Error).code == "duplicate_emitter"
        again.send(AddEmitter(id="second", clip=CLIP, position=PLACE))
        again.until(EmitterAdded)
        again.drop()
        with listening(served, again.resumption()) as third:
            assert third.first.resumed.handled == len(changes) + 2


@pytest.mark.untimed
def test_a_token_is_good_for_one_stream_that_did_not_say_goodbye(served):
    with listening(served, Resume(protocol=PROTOCOL, token="never-given")) as stranger:
        assert (stranger.first.code, stranger.first.field) == ("unknown_resume_token", "token")
    with listening(served) as listener:
        assert isinstance(listener.first, Welcome)
        listener.until(AudioBlock)
    # It has said goodbye.
    with listening(served, listener.resumption()) as again:
        assert again.first.code == "unknown_resume_token"
    with listening(served, listener.resumption(protocol=2)) as old:
        assert old.first.code == "unsupported_protocol"
    with listening(served) as listener:
        listener.until(AudioBlock)
        listener.send(listener.resumption())
        assert listener.until(Error).code == "unexpected_resume"
        listener.until(AudioBlock)


@pytest.mark.untimed
def test_on_a_full_server_a_place_is_held_for_who_comes_back(monkeypatch, request):
    """One place for eight streams; of others the state is kept all the same."""
    monkeypatch.setenv("NAFIR_MAX_STREAMS", "8")
    monkeypatch.setenv("NAFIR_ADMISSION", "false")
    address = request.getfixturevalue("served_anew")
    with ExitStack() as stack:
        listeners = [stack.enter_context(listening(address)) for _ in range(8)]
        for listener in listeners[:2]:
            listener.until(AudioBlock)
            listener.drop()
            time.sleep(0.2)
        newcomer = stack.enter_context(listening(address))
        assert isinstance(newcomer.first, Welcome)
        refused = stack.enter_context(listening(address))
        assert refused.first.code == "server_busy"
        back = stack.enter_context(listening(address, listeners[0].resumption()))
        assert back.first.resumed is not None

        def the_other():
            """Its welcome, once there is room for it."""
            with suppress(InvalidStatus), ExitStack() as attempt:
                late = attempt.enter_context(listening(address, listeners[1].resumption()))
                return late.first if isinstance(late.first, Welcome) else None

        assert the_other() is None
        newcomer.close()
        for _ in range(50):  # until the server has noticed
            if (welcome := the_other()) is not None:
                assert welcome.resumed is not None
                return
            time.sleep(0.05)
        raise AssertionError("there was no place for the other one")


@pytest.mark.untimed
def test_a_server_told_to_keep_nothing_gives_no_token(monkeypatch, request):
    monkeypatch.setenv("NAFIR_RESUME_S", "0")
    address = request.getfixturevalue("served_anew")
    with connect(f"ws://{address}/v1/stream") as socket:
        socket.send(HELLO.serialize())
        welcome = json.loads(socket.recv(timeout=5))
    assert not {"resume_token", "resume_s", "resumed"} & welcome.keys()


@contextmanager
def serving_until_drained(bundle, hrtfs, secret="a secret of both servers"):
    """HOST:PORT of a server with a secret, and what begins its shutdown. It ends by itself then."""
    drain = Drain(3.0)
    settings = Settings(port=0, resume_secret=secret)
    app = create_app(settings, scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs, drain=drain)
    server = Server(uvicorn.Config(app, log_level="warning", **uvicorn_options(settings)), drain)
    server.install_signal_handlers = lambda: None
    loops = []

    async def serve():
        loops.append(asyncio.get_running_loop())
        await server.serve()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    try:
        while not server.started:
            time.sleep(0.02)
        address = "{}:{}".format(*server.servers[0].sockets[0].getsockname())
        wait_until_ready(address)
        yield address, lambda: loops[0].call_soon_threadsafe(drain.begin)
    finally:
        server.should_exit = True
        thread.join()


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def wait_until_ready(address, patience_s=60.0):
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        with suppress(OSError), urllib.request.urlopen(f"http://{address}/readyz", timeout=5):
            return
        time.sleep(0.05)
    raise AssertionError("the server never became ready")


@contextmanager
def two_processes(bundle, hrtfs, max_listeners=(8, 8)):
    """HOST:PORT of each of two servers that are processes of one, with so many listeners in a stream at each."""
    own = [listening_privately() for _ in range(2)]
    ports = tuple(each.getsockname()[1] for each in own)
    servers, threads = [], []
    for number, listener in enumerate(own):
        settings = Settings(port=0, max_listeners=max_listeners[number])
        peers = ProcessPeers(number, ports, KEY)
        app = create_app(settings, scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs, peers=peers)
        servers.append(uvicorn.Server(uvicorn.Config(app, log_level="warning", **uvicorn_options(settings))))
        threads.append(threading.Thread(target=servers[-1].run, args=([listener],)))
        threads[-1].start()
    addresses = [f"127.0.0.1:{port}" for port in ports]
    try:
        for address in addresses:
            wait_until_ready(address)
        yield addresses
    finally:
        for server, thread in zip(servers, threads, strict=True):
            server.should_exit = True
            thread.join()


def asked_for(address, token, key=None):
    """The status and the answer of a process to whoever asks it for a stream."""
    return peer_request(address, "POST", {"token": token, "owner": None, "by": 1}, key)


def peer_request(address, method, told, key):
    headers = {"Content-Type": "application/json", **({} if key is None else {PEER_KEY: key})}
    url = f"http://{address}{OWN_STREAMS}"
    request = urllib.request.Request(url, json.dumps(told).encode(), headers, method=method)
    try:
        with urllib.request.urlopen(request, timeout=5) as answer:
            return answer.status, json.loads(answer.read() or "null")
    except urllib.error.HTTPError as answer:
        return answer.code, None


@pytest.mark.parametrize("is_broken", [True, False], ids=["lost", "half open"])
def test_a_token_of_one_process_resumes_at_another(bundle, hrtfs, expected, is_broken):
    with two_processes(bundle, hrtfs) as (one, other), listening(one) as before:
        since = begin(before)
        before.hear(RATE // 4)
        if is_broken:
            before.drop()
        # Nobody else gets it, whatever they know.
        for key in (None, "", "another key"):
            assert asked_for(one, before.first.resume_token, key) == (404, None)
        with listening(other, before.resumption()) as again:
            resumed = again.first.resumed
            assert again.first.session == before.first.session
            assert resumed.sequence > before.blocks[-1].sequence
            again.hear(SETTLED + RATE // 4)
            if not is_broken:
                assert before.to_the_end().reason == "taken_over"
            # It is at the other process now, and at that alone; and goes back as it came.
            assert streams_of(one) == 0
            assert streams_of(other) == 1
            again.drop()
        with listening(one, again.resumption()) as back:
            back.hear(SETTLED + RATE // 4)
        for blocks in (again.blocks, back.blocks):
            assert error_db(after(blocks, SETTLED), expected, since) < -80


def test_a_token_that_no_process_knows_is_told_at_once(bundle, hrtfs):
    with two_processes(bundle, hrtfs) as (one, other):
        began_s = time.monotonic()
        for token in ("of-nobody", "1.of.nobody", ProcessPeers(1, (0, 0), KEY).new_token(), "é.é"):
            with listening(one, Resume(protocol=PROTOCOL, token=token)) as stranger:
                assert stranger.first.code == "unknown_resume_token"
                assert stranger.to_the_end().code == 1008
        assert time.monotonic() - began_s < 2
        assert asked_for(other, "of-nobody", KEY) == (200, {"stream": None, "moved_to": None})


def test_a_stream_that_cannot_go_on_at_another_process_is_still_where_it_was(bundle, hrtfs, expected):
    with two_processes(bundle, hrtfs) as (one, other), listening(one) as before:
        since = begin(before)
        before.hear(RATE // 4)
        before.drop()
        token = before.first.resume_token
        assert asked_for(one, token, KEY)[1]["stream"] is not None
        assert asked_for(one, token, KEY)[1]["stream"] is None  # nobody else has it meanwhile
        told = {"token": token, "by": 1, "is_resumed": False}
        assert peer_request(one, "PUT", told, "another key") == (404, None)
        assert peer_request(one, "PUT", told, KEY) == (204, None)
        with listening(other, before.resumption()) as again:
            again.hear(SETTLED + RATE // 4)
        assert error_db(after(again.blocks, SETTLED), expected, since) < -80


def test_a_process_that_cannot_go_on_with_a_stream_says_so_at_once(bundle, hrtfs):
    """It admits fewer listeners, which stands for any reason."""
    hello = HELLO.model_copy(update={"listeners": 2})
    with two_processes(bundle, hrtfs, (2, 1)) as (one, other), listening(one, hello) as before:
        begin(before)
        before.hear(RATE // 4)
        before.drop()
        with listening(other, before.resumption()) as refused:
            assert refused.first.code == "too_many_listeners"
        # Sooner than it would come back by itself.
        end_s = time.monotonic() + 3
        while time.monotonic() < end_s:
            with listening(one, before.resumption()) as again:
                if isinstance(again.first, Welcome):
                    assert again.first.session == before.first.session
                    return
        raise AssertionError("the stream has not come back")


def test_a_former_token_leads_to_the_process_to_which_its_stream_has_gone(bundle, hrtfs):
    """A client whose connection breaks before the `welcome` knows no other token."""
    with two_processes(bundle, hrtfs) as (one, other), listening(one) as before:
        begin(before)
        before.hear(RATE // 4)
        before.drop()
        with listening(other, before.resumption()) as unheard:
            unheard.drop()
        with listening(one, before.resumption()) as again:
            assert again.first.session == before.first.session
            again.hear(SETTLED)


def streams_of(address):
    with urllib.request.urlopen(f"http://{address}/metrics/process", timeout=5) as answer:
        lines = answer.read().decode().splitlines()
    return sum(float(line.split()[-1]) for line in lines if line.startswith("nafir_streams{"))


def test_a_server_that_shuts_down_hands_its_streams_to_another(bundle, hrtfs, expected):
    """It says when to come back, and the stream goes on at a server that has the same secret."""
    other = serving_until_drained(bundle, hrtfs)
    with serving_until_drained(bundle, hrtfs) as (old, shut_down), other as (new, _), listening(old) as before:
        since = begin(before)
        shut_down()
        ending = before.to_the_end()
        assert (ending.code, ending.reason) == (1012, "server_draining")
        snapshot, error = before.messages[-2:]
        assert (snapshot.type, error.code) == ("snapshot", "server_draining")
        assert error.retry_after_s == 1
        assert snapshot.handled == 1
        with listening(new, before.resumption(snapshot=snapshot.snapshot)) as again:
            resumed = again.first.resumed
            assert again.first.session == before.first.session
            assert resumed.sequence == before.blocks[-1].sequence + 1
            assert before.blocks[-1].sample_clock < resumed.sample_clock < before.blocks[-1].sample_clock + 3 * RATE
            again.hear(SETTLED + RATE // 4)
        assert error_db(after(again.blocks, SETTLED), expected, since) < -80
        forged = before.resumption(token=None, snapshot=snapshot.snapshot[:-8] + "AAAAAAA=")
        with listening(new, forged) as stranger:
            assert (stranger.first.code, stranger.first.field) == ("unknown_resume_token", "snapshot")


@pytest.mark.untimed
def test_without_a_secret_there_are_no_snapshots(served):
    with listening(served, HELLO.model_copy(update={"snapshots": True})) as listener:
        listener.until(AudioBlock)
        snapshot = Seal(b"of nobody", 60.0).close(b"{}", plays_at=time.time(), now=time.time())
    with listening(served, listener.resumption(token=None, snapshot=snapshot)) as again:
        assert again.first.code == "unknown_resume_token"


def resumptions_of(address, outcome):
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=5) as answer:
        lines = answer.read().decode().splitlines()
    start = f'nafir_stream_resumptions_total{{outcome="{outcome}"}} '
    return next(float(line.removeprefix(start)) for line in lines if line.startswith(start))


@pytest.mark.untimed
def test_a_stream_that_was_found_but_cannot_go_on_is_not_counted_as_resumed(serving, bundle, hrtfs):
    """A client that is refused, or tires of waiting, asks again: its stream goes on once."""
    levels, secret, outcome = FieldsByLevel.load(bundle), "a secret of both servers", "resumed_from_snapshot"
    two = serving(levels, hrtfs, resume_secret=secret)
    one = serving(levels, hrtfs, resume_secret=secret, max_listeners=1)
    with two as roomy, one as narrow:
        with listening(roomy, HELLO.model_copy(update={"snapshots": True, "listeners": 2})) as before:
            snapshot = before.until(SnapshotTaken, patience_s=10.0).snapshot
        asked = before.resumption(token=None, snapshot=snapshot)
        with listening(narrow, asked) as refused:
            assert refused.first.code == "too_many_listeners"
            assert resumptions_of(narrow, outcome) == 0
        with listening(roomy, asked) as again:
            assert again.first.resumed is not None
            assert resumptions_of(roomy, outcome) == 1


@pytest.mark.long
def test_a_server_that_is_killed_costs_a_fade(bundle, expected):
    """Its client has kept the newest snapshot, goes on with it at another server, and learns what is not in it."""
    environment = {**os.environ, "NAFIR_RESUME_SECRET": "a secret of both servers", "NAFIR_BUNDLES": str(bundle.folder)}
    ports = [free_port() for _ in range(2)]
    servers = [
        subprocess.Popen([sys.executable, "-m", "server", "serve", "--port", str(port)], env=environment)
        for port in ports
    ]
    try:
        killed, other = (f"127.0.0.1:{port}" for port in ports)
        for address in (killed, other):
            wait_until_ready(address, 300.0)
        with listening(killed, HELLO.model_copy(update={"snapshots": True})) as before:
            since = begin(before)
            snapshot = before.until(SnapshotTaken, patience_s=10.0)
            before.send(SetGain(id="talker", gain_db=0.0))
            before.hear(RATE // 2)
            servers[0].kill()
            servers[0].wait()
            assert before.to_the_end() is None
        with listening(other, before.resumption(snapshot=snapshot.snapshot)) as again:
            resumed = again.first.resumed
            assert resumed.handled == 1  # the gain is to be set again
            assert resumed.sample_clock > before.blocks[-1].sample_clock
            assert resumed.sequence == before.blocks[-1].sequence + 1
            again.hear(SETTLED + RATE // 2)
        assert error_db(after(again.blocks, SETTLED), expected, since) < -80
    finally:
        for each in servers:
            each.kill()
            each.wait()
