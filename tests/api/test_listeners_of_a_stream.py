"""Several listeners of one stream, over a WebSocket of the whole application."""

import json
import time

import numpy as np
import pytest

from server.core.errors import RequestError
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    Hello,
    ListenerPose,
    RemoveListener,
    Resume,
)
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockReader
from server.protocol.server_messages import (
    EmitterAdded,
    Error,
    ListenerAdded,
    ListenerRemoved,
    Status,
    Welcome,
    parse_server_message,
)
from server.streaming.admission import Refusal
from tests.api.test_stream import client, clip_files  # noqa: F401  fixtures

HELLO = Hello(protocol=PROTOCOL, scene="flat", listeners=3)
NEAR, FAR = (2.0, 3.2, 1.5), (7.0, 1.0, 1.5)
TALKER = AddEmitter(id="talker", clip="tone", position=(2.0, 3.0, 1.5))


def lose(socket, client):  # noqa: F811
    """End a connection as a network does, and wait until its stream is kept: leaving the context cancels the server."""
    kept = client.app_state["host"].kept
    before = kept.outcomes["kept"]
    socket.close(1012)
    for _ in range(500):
        if kept.outcomes["kept"] > before:
            return
        time.sleep(0.01)
    raise AssertionError("the stream was not kept within 5 s")


class Party:
    """A client with several listeners, each of whose blocks is read and acknowledged by itself."""

    def __init__(self, socket, hello=HELLO):
        self.socket = socket
        self.names = {0: None}
        self.blocks = []
        self.send(hello)
        self.welcome = self.until(Welcome)
        self.readers = {}

    def send(self, message):
        self.socket.send_text(message.serialize())

    def receive(self):
        message = self.socket.receive()
        if message.get("text") is not None:
            read = parse_server_message(message["text"])
            if isinstance(read, ListenerAdded):
                self.names[read.index] = read.id
                self.readers.pop(read.index, None)
            return read
        data = message["bytes"]
        block = self.readers.setdefault(data[3], BlockReader(self.welcome)).read(data)
        self.send(Acknowledge(sequence=block.sequence, listener=self.names[block.listener]))
        self.blocks.append(block)
        return block

    def until(self, kind, condition=lambda _: True):
        for _ in range(3_000):
            message = self.receive()
            if isinstance(message, kind) and condition(message):
                return message
        raise AssertionError(f"no {kind.__name__} came")

    def refused(self, message):
        self.send(message)
        return self.until(Error)

    def add(self, identifier, **changes):
        self.send(AddListener(**{"id": identifier, "position": FAR, **changes}))
        return self.until(ListenerAdded)

    def loudness(self, blocks=30):
        """By listener, once each has had so many more blocks."""
        self.blocks.clear()
        last = self.until(AudioBlock).sample_clock
        self.until(AudioBlock, lambda block: block.sample_clock >= last + blocks * self.welcome.block_size)
        whose = {block.listener for block in self.blocks}
        pieces = {each: [block.samples for block in self.blocks if block.listener == each] for each in whose}
        return {each: float(np.sqrt(np.mean(np.concatenate(some, axis=1) ** 2))) for each, some in pieces.items()}


@pytest.mark.parametrize("encoding", ["f32", "s16", "opus"])
def test_listeners_come_hear_and_go(client, encoding):  # noqa: F811
    options = {"opus": OpusOptions()} if encoding == "opus" else {}
    with client.websocket_connect("/v1/stream") as socket:
        party = Party(socket, HELLO.model_copy(update={"encoding": encoding, **options}))
        assert party.welcome.max_listeners == 8
        party.send(ListenerPose(pose_id=1, position=NEAR))
        party.send(TALKER)
        party.until(EmitterAdded)
        added = party.add("guest")
        assert (added.index, added.hrtf) == (1, "kemar")
        first = party.until(AudioBlock, lambda block: block.listener == 1)
        assert (first.sequence, first.sample_clock) == (0, added.sample_clock)
        party.loudness()
        heard = party.loudness()
        assert heard[0] > 3 * heard[1] > 0
        party.send(ListenerPose(pose_id=2, position=NEAR, listener="guest"))
        party.loudness()
        heard = party.loudness()
        assert heard[0] == pytest.approx(heard[1], rel=0.2)
        step = 240 if encoding == "opus" else 256  # packets count from where an encoder began
        clocks = {each: [block.sample_clock for block in party.blocks if block.listener == each] for each in (0, 1)}
        if step == 256:
            assert clocks[0][1:-1] == [clock for clock in clocks[1] if clocks[0][1] <= clock <= clocks[0][-2]]
        assert abs(clocks[0][-1] - clocks[1][-1]) <= 2 * step
        told = party.until(Status, lambda status: status.listener == "guest")
        assert told.blocks_sent > 0
        assert told.blocks_dropped == 0
        counts = client.get("/metrics").text
        assert 'nafir_listeners{scene="flat"} 2.0' in counts
        party.send(RemoveListener(id="guest"))
        assert party.until(ListenerRemoved) == ListenerRemoved(id="guest", index=1)
        assert set(party.loudness()) == {0}
        assert party.add("guest").index == 2
        party.loudness()
        assert party.loudness()[2] > 0


def test_a_listener_that_cannot_be_is_refused_by_code(client, monkeypatch):  # noqa: F811
    with client.websocket_connect("/v1/stream") as socket:
        party = Party(socket, Hello(protocol=PROTOCOL, scene="flat"))
        assert party.welcome.max_listeners is None
        (place,) = client.app_state["host"].admission._places
        party.add("guest")
        for message, code in (
            (AddListener(id="guest", position=FAR), "duplicate_listener"),
            (AddListener(id="b", position=(99.0, 0.0, 1.0)), "position_out_of_bounds"),
            (AddListener(id="b", position=FAR, hrtf="nobody"), "unknown_hrtf"),
            (RemoveListener(id="b"), "unknown_listener"),
            (ListenerPose(pose_id=1, position=FAR, listener="b"), "unknown_listener"),
            (Acknowledge(sequence=0, listener="b"), "unknown_listener"),
        ):
            refusal = party.refused(message)
            named = message.listener if hasattr(message, "listener") else message.id
            assert (refusal.code, refusal.listener) == (code, named)
            assert place.listeners == 2
        place.seats = 2  # or room is kept for those who were refused for another reason
        monkeypatch.setattr(client.app_state["host"].admission, "_found", lambda *_: "rendering")
        refusal = party.refused(AddListener(id="b", position=FAR))
        assert (refusal.code, refusal.retry_after_s > 0, place.listeners) == ("server_busy", True, 2)
        assert Refusal("rendering", 5).error.code == refusal.code
        monkeypatch.undo()
        for number in range(6):
            party.add(str(number))
        assert party.refused(AddListener(id="b", position=FAR)).code == "too_many_listeners"
        assert len(party.loudness(10)) == 8


def test_a_hello_for_more_listeners_than_there_may_be_is_refused(client):  # noqa: F811
    with client.websocket_connect("/v1/stream") as socket:
        socket.send_text(HELLO.model_copy(update={"listeners": 9}).serialize())
        assert parse_server_message(socket.receive_text()).code == "too_many_listeners"


def test_a_resumed_stream_has_its_three_listeners_again(client):  # noqa: F811
    with client.websocket_connect("/v1/stream") as socket:
        party = Party(socket)
        party.send(TALKER)
        party.add("guest")
        party.add("third", position=NEAR, yaw=1.0)
        party.send(ListenerPose(pose_id=5, position=NEAR, listener="guest"))
        party.until(AudioBlock, lambda block: block.listener == 1 and block.pose_id == 5)
        last = party.blocks[-1]
        lose(socket, client)
    newest = max(block.sequence for block in party.blocks)
    again = Resume(protocol=PROTOCOL, token=party.welcome.resume_token, sequence=newest, sample_clock=last.sample_clock)
    with client.websocket_connect("/v1/stream") as socket:
        resumed = Party(socket, again)
        went_on = resumed.welcome.resumed
        assert [(each.id, each.index) for each in went_on.listeners] == [("guest", 1), ("third", 2)]
        assert (went_on.pose_id, went_on.sequence) == (5, newest + 1)
        resumed.names |= {1: "guest", 2: "third"}
        resumed.until(AudioBlock, lambda block: block.listener == 2)
        for index in range(3):
            first = next(block for block in resumed.blocks if block.listener == index)
            assert (first.sequence, first.sample_clock, first.pose_id) == (newest + 1, went_on.sample_clock, 5)
        resumed.loudness()
        heard = resumed.loudness()
        assert min(heard.values()) > 0
        (place,) = client.app_state["host"].admission._places
        assert place.listeners == 3
        assert resumed.refused(AddListener(id="guest", position=FAR)).code == "duplicate_listener"
        assert resumed.add("fourth").index == 3


def test_a_listener_whose_head_is_gone_when_the_stream_is_resumed_takes_no_seat(client, monkeypatch):  # noqa: F811
    host = client.app_state["host"]
    with client.websocket_connect("/v1/stream") as socket:
        party = Party(socket)
        party.add("guest", hrtf="kemar")
        party.add("third")
        last = party.until(AudioBlock, lambda block: block.listener == 2)
        lose(socket, client)
    load, asked = host.hrtfs.filters, []

    def filters(name, rate):
        asked.append(name)
        if len(asked) == 3:  # for the second of the sessions, each of which asks for two rates
            raise RequestError("unknown_hrtf", f"there is no head {name!r}", field="hrtf", status=404)
        return load(name, rate)

    again = Resume(
        protocol=PROTOCOL, token=party.welcome.resume_token, sequence=last.sequence, sample_clock=last.sample_clock
    )
    with client.websocket_connect("/v1/stream") as socket, monkeypatch.context() as patched:
        patched.setattr(host.hrtfs, "filters", filters)
        resumed = Party(socket, again)
        patched.undo()
        assert [each.id for each in resumed.welcome.resumed.listeners] == ["third"]
        resumed.names[2] = "third"
        told = resumed.until(Error)
        assert (told.code, told.listener) == ("unknown_hrtf", "guest")
        (place,) = host.admission._places
        assert place.listeners == 2
        assert resumed.refused(RemoveListener(id="guest")).code == "unknown_listener"
        assert place.listeners == 2
        assert resumed.add("guest").index == 3
        assert place.listeners == 3


def test_who_joins_hears_the_scene_in_which_the_stream_is(client, monkeypatch):  # noqa: F811
    """Though another has its name by now, or none."""
    host = client.app_state["host"]
    with client.websocket_connect("/v1/stream") as socket:
        party = Party(socket)
        for offered in (host.clips, host.places, host.effect_costs, host.offers, host.scenes):
            monkeypatch.delitem(offered, "flat", raising=False)
        party.add("guest")
        party.send(TALKER)
        party.until(EmitterAdded)
        party.loudness()
        assert min(party.loudness().values()) > 0
        (stream,) = host.audio.streams
        first, guest = (member.session._effects.planned for member in stream.audience.members)
        assert guest.place.reverberations is first.place.reverberations
        assert guest._costs(None) == first._costs(None)


def test_a_refusal_of_what_cannot_be_read_names_whom_it_is_about(client):  # noqa: F811
    malformed = [
        ({"type": "add_listener", "id": "guest", "position": [None, 1, 1]}, "malformed_pose", None, "guest"),
        ({"type": "add_listener", "id": "guest", "hrtf": 2, "position": NEAR}, "malformed_message", None, "guest"),
        (
            {"type": "add_emitter", "id": "talker", "position": NEAR, "gain_db": 900},
            "malformed_message",
            "talker",
            None,
        ),
        ({"type": "set_effects", "effects": {"echo": "loud"}}, "malformed_message", None, None),
        ({"type": "add_listener", "id": 65 * "x", "position": NEAR}, "malformed_message", None, None),
    ]
    with client.websocket_connect("/v1/stream") as socket:
        party = Party(socket)
        for message, *told in malformed:
            socket.send_text(json.dumps(message))
            error = party.until(Error)
            assert [error.code, error.emitter, error.listener] == told
        assert party.add("guest").index == 1
