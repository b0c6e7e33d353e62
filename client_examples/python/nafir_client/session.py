"""The client's side of a stream, without input and output: messages in, messages and blocks out.

A session outlives its connections. It knows what the stream should be (listeners, emitters, level, effects), so that a
new connection can be made to be what the last one was. The clock goes on over connections: sample clocks are those of
the session, not of the server.

A new connection resumes the stream by the token of the last one, at the server that kept it, or by the newest
*snapshot* that a server has sent, at any server of the same scenes and secret. A snapshot is older than the last block,
so what it does not cover is said again.
"""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypedDict

from nafir_client.errors import ProtocolError, RefusedError
from nafir_client.live_input import LiveInput
from nafir_client.opus import OpusReader, OpusWriter, require_opus
from nafir_client.outbox import Outbox, Outgoing, Thing
from nafir_client.pose import Orientation, Pose, Position
from nafir_client.scene import Welcome
from nafir_client.stream_statistics import ListenerStatistics, StreamStatistics
from nafir_client.wire import (
    BLOCK_KIND,
    PROTOCOL,
    Block,
    Encoding,
    SampleEncoding,
    Samples,
    dry_bytes,
    dry_packet_bytes,
    listener_of,
    parse_block,
    parse_packets,
    pose_bytes,
)

Message = Mapping[str, Any]
"""A text message of the server. Its `type` says which fields it has."""
_ACKNOWLEDGE_EVERY = 4
_UNCOUNTED = frozenset({"listener", "move_emitter", "acknowledge", "ping"})
_TOKEN_UNKNOWN = "unknown_resume_token"
_TOO_LARGE = "message_too_large"
"""The error about a message that the server does not read, so that it cannot say which emitter it was about."""
_NOT_KNOWN = "unknown_message"
"""The error of a server that is too old to have several listeners in a stream."""
_NOT_THERE = "unknown_emitter", "unknown_listener"
"""Errors about what is removed or changed, and never about what is added."""
_LONGEST_ID = 64


def require_id(identifier: str) -> str:
    """The id of an emitter or listener. Raises ValueError for what no server takes."""
    if not isinstance(identifier, str) or not 1 <= len(identifier) <= _LONGEST_ID:
        raise ValueError(f"id: has to be 1 to {_LONGEST_ID} characters, not {identifier!r}")
    identifier.encode()  # of a half of a pair of surrogates this says what is wrong
    return identifier


class StreamOptions(TypedDict, total=False):
    """What may be said of a stream when it is opened; the server's reference has the meaning of each.

    `listener` is the pose with which it begins. `emitters` is how many emitters are to come, and `listeners` how many
    listeners there will be, the first one included: the server keeps room for them. `level` is a quality level or
    `auto`. `opus` says how the encoding `opus` encodes. `order` is that of the output `ambisonics`. `effects` switches
    effects on or off.
    """

    sample_rate: int
    block_size: Literal[128, 256, 512, 1024]
    encoding: Encoding
    opus: Mapping[str, Any]
    buffer_blocks: int
    output: Literal["headphones", "mono", "ambisonics"]
    order: Literal[1, 2, 3]
    hrtf: str
    level: str
    effects: Mapping[str, bool]
    emitters: int
    listeners: int
    listener: Pose


class EmitterOptions(TypedDict, total=False):
    """What may be said of an emitter when it is added.

    With a `clip` it plays one of the server's, with `loop` (the default) again and again. Without one it is live: it
    plays what is written to it, of which `ahead_blocks` (4) are kept waiting at the server, which lets samples wait for
    `jitter_ms` (2 to 250; two blocks unless given), so that they may come unevenly. Without a `position` it is
    where the scene suggests. `yaw` or `orientation` turn it, which matters with a `directivity` only. `id` is its name
    in messages of the server; without one it gets one.

    A clip begins at the clock `start_at` of the stream, to the sample, or at once, `offset_s` seconds into it; a loop
    goes from `loop_start_s` to `loop_end_s`. It fades out at the clock `stop_at`. With `remove_when_ended` its emitter
    is removed once all of its sound has been heard.
    """

    clip: str
    loop: bool
    position: Iterable[float]
    yaw: float
    orientation: Iterable[float]
    gain_db: float
    directivity: Mapping[str, Any]
    id: str
    ahead_blocks: int
    jitter_ms: float
    start_at: int
    stop_at: int
    offset_s: float
    loop_start_s: float
    loop_end_s: float
    remove_when_ended: bool


class SessionEmitter:
    """An emitter as it should be: the fields of its `add_emitter`, kept up to date."""

    def __init__(self, fields: dict[str, Any], live: LiveInput | None) -> None:
        self.id: str = fields["id"]
        self.fields = fields
        self.live = live
        self.is_heard = False
        """Whether the server of the present connection has said that it is heard."""
        self.start_clock = 0
        """The clock from which on it is heard, or was in the last stream of the server's."""
        self.was_heard = False
        """Whether some of it had been heard when a connection was lost."""
        self.has_ended = False
        """Whether all sound of its clip has been heard, or no more will be."""
        self.pose_id = 0
        """That of its newest move."""

    @property
    def plays_once(self) -> bool:
        return "clip" in self.fields and not self.fields.get("loop", True)

    @property
    def is_over(self) -> bool:
        """Whether a server that does not have it is not to begin it again."""
        return self.has_ended or (self.plays_once and self.was_heard)


class SessionListener:
    """A listener beside the first, as it should be. `hrtf` names its head; None for that of the stream."""

    def __init__(self, identifier: str, pose: Pose, hrtf: str | None) -> None:
        self.id = identifier
        self.pose = pose
        self.hrtf = hrtf
        self.pose_id = 0
        """That of its newest move."""
        self.index: int | None = None
        """Its number in the blocks of the present connection; None until the server has said it."""
        self.start_clock = 0
        """The clock of its first block in the present stream of the server's, or in the last one."""
        self.level = ""
        """The present quality level."""
        self.statistics = ListenerStatistics()
        self.next_clock = 0
        """The clock of the frame after its newest block."""
        self.packets: OpusReader | None = None

    @property
    def is_there(self) -> bool:
        """Whether the server of the present connection has said that it is there."""
        return self.index is not None


class Session:
    """The state of one stream. Every method that has something to send puts it into `outbox`. Raises
    MissingLibraryError for a stream in Opus where there is no libopus."""

    def __init__(self, scene: str, options: StreamOptions) -> None:
        given: dict[str, Any] = {"block_size": 256, "encoding": "f32", "level": "auto", **options}
        self.listener: Pose | None = given.pop("listener", None)
        if given["encoding"] == "opus":
            require_opus()
        self._hello = {"type": "hello", "protocol": PROTOCOL, "scene": scene, "snapshots": True, **given}
        self.outbox = Outbox()
        self.emitters: dict[str, SessionEmitter] = {}
        self.listeners: dict[str, SessionListener] = {}
        """Those beside the first."""
        self.statistics = StreamStatistics()
        self.welcome: Welcome | None = None
        self.level = ""
        self.next_clock = 0
        """The clock of the frame after the newest block."""
        self.last_error: RefusedError | None = None
        """The newest error of this connection."""
        self._arrived_s = 0.0
        self._clock_offset = 0
        """What is added to the server's clock."""
        self._next_pose_id = 1
        self._listener_pose_id = 0
        self._resume_token: str | None = None
        self._snapshot: str | None = None
        """The newest one of this stream."""
        self._last_block: tuple[int, int] | None = None
        """The greatest number and the greatest of the server's clocks of all blocks, whoever's they are."""
        self._packets: OpusReader | None = None
        self._restored: list[SessionEmitter] = []
        """What a new stream is to have of the last one."""
        self._pings: dict[int, float] = {}
        self._ping_id = 0

    def first_message(self) -> str:
        """That of a connection: it resumes the stream, if the server has given a token or a snapshot for that, or opens
        one."""
        given = {"token": self._resume_token, "snapshot": self._snapshot}
        means = {name: value for name, value in given.items() if value is not None}
        if not means:
            return self._open()
        resume: dict[str, Any] = {"type": "resume", "protocol": PROTOCOL, **means}
        if self._last_block is not None:
            resume["sequence"], resume["sample_clock"] = self._last_block
        return json.dumps(resume)

    def _open(self) -> str:
        """A hello. What the stream had before is asked for once it is answered."""
        self.outbox.begin()
        self._note_heard()
        for emitter in tuple(self.emitters.values()):
            if emitter.is_over:
                self._end(emitter)  # what plays once is not played again
            emitter.is_heard = emitter.was_heard = False
        for listener in self.listeners.values():
            listener.index = None
        self._restored = list(self.emitters.values())
        self._last_block = None
        hello = dict(self._hello)
        if self.listener is not None:
            hello["listener"] = _pose_fields(self.listener)
        if self.emitters:
            hello["emitters"] = max(hello.get("emitters", 0), len(self.emitters))
        if self.listeners:
            hello["listeners"] = max(hello.get("listeners", 0), 1 + len(self.listeners))
        return json.dumps(hello)

    def _note_heard(self) -> None:
        """The connection was lost: note which emitters were heard in the last block or before it."""
        for emitter in self.emitters.values():
            if emitter.is_heard and emitter.start_clock < self.next_clock:
                emitter.was_heard = True

    def _end(self, emitter: SessionEmitter) -> None:
        """Its clip is over, and the server does not have it any more."""
        emitter.has_ended = True
        del self.emitters[emitter.id]

    def greet(self, data: str | bytes, now_s: float) -> Welcome:
        """Take the answer to the first message. Raises RefusedError or ProtocolError."""
        answer: dict[str, Any] = _read(data) if isinstance(data, str) else {"type": "a block"}
        if answer["type"] == "error":
            error = refusal(answer)
            if error.code == _TOKEN_UNKNOWN:
                self._begin_anew()
            raise error
        if answer["type"] != "welcome":
            raise ProtocolError(f"the server answers a first message with {answer['type']}")
        resumed = answer.get("resumed")
        if resumed is not None and not self.outbox.can_resume(resumed["handled"]):
            self._begin_anew()
            raise RefusedError(_TOKEN_UNKNOWN, "too much was said since to go on with the stream: it begins anew")
        is_first, self.welcome = self.welcome is None, Welcome.read(answer)
        self.level = self.welcome.level
        self.last_error = None
        self._pings.clear()
        self._resume_token = answer.get("resume_token")
        if resumed is not None:
            self.statistics.resumptions += 1
            self._resume(resumed["pose_id"], resumed["handled"], resumed["sample_clock"], now_s)
            self._resume_listeners(resumed, now_s)
        else:
            if not is_first:
                self._clock_offset = self._continued(self.welcome, now_s)
            self._packets = _packet_reader(self.welcome)
            listeners = [self._added_listener(listener) for listener in self.listeners.values()]
            self.outbox.put_first(listeners + [self._added(emitter) for emitter in self._restored])
        return self.welcome

    def _begin_anew(self) -> None:
        """With the next connection, since nobody can go on with the stream."""
        self._resume_token = self._snapshot = None

    def _resume(self, pose_id: int, handled: int, sample_clock: int, now_s: float) -> None:
        """The stream goes on where it would be: what the server has not got is sent again, but for what plays once and
        was heard since a snapshot."""
        self._note_heard()
        over: set[Thing] = {("emitter", emitter.id) for emitter in self.emitters.values() if emitter.is_over}
        for _, identifier in self.outbox.resume(handled, over):
            self._end(self.emitters[identifier])
        added = self.outbox.adds
        if self.listener is not None and self._listener_pose_id > pose_id:
            self.move_listener(self.listener, now_s)
        for emitter in self.emitters.values():
            if emitter.pose_id > pose_id:
                orientation = emitter.fields.get("orientation")
                self.move_emitter(emitter, emitter.fields["position"], orientation, now_s)
            if ("emitter", emitter.id) in added:
                emitter.is_heard = False  # a server that goes by a snapshot may lack what the last one had
            elif not emitter.is_heard:
                # It is there, and that it is heard may have been said just before the connection was lost.
                start = max(sample_clock + self._clock_offset, emitter.fields.get("start_at", 0))
                emitter.is_heard, emitter.start_clock = True, start
            if emitter.live and emitter.is_heard:
                emitter.live.open()

    def _resume_listeners(self, resumed: Mapping[str, Any], now_s: float) -> None:
        """Listeners that the server has go on. Those that it should have and has not are asked for again."""
        there = {each["id"]: each["index"] for each in resumed.get("listeners", ())}
        added = self.outbox.adds
        for listener in self.listeners.values():
            if ("listener", listener.id) in added:
                listener.index = None  # if the server has one of this id, it is to remove that first
                continue
            index = there.get(listener.id)
            if index is None and listener.is_there:
                listener.index = None  # it cannot be there any more, and an error will say why
            elif index is None:
                self.outbox.put(self._added_listener(listener))
            else:
                if not listener.is_there:  # that it was added may have been said just before the connection was lost
                    self._begin_listener(listener, index, resumed["sample_clock"] + self._clock_offset)
                listener.level = self.level
                if listener.pose_id > resumed["pose_id"]:
                    self.move_added_listener(listener, listener.pose, now_s)

    def disconnect(self) -> None:
        """The connection is lost, and what was on its way."""
        for counts in (self.statistics, *(listener.statistics for listener in self.listeners.values())):
            counts.pose_to_sound.forget()
            counts.pose_to_reverberation.forget()
        for emitter in self.emitters.values():
            if emitter.live:
                emitter.live.close()

    def receive(self, data: str | bytes, now_s: float) -> Block | Message | None:
        """Take a message of the server. Returns None for kinds of binary messages that are not known. Raises
        ProtocolError."""
        if isinstance(data, str):
            message = _read(data)
            try:
                return self._receive_message(message, now_s)
            except (KeyError, TypeError, ValueError, AttributeError) as exc:
                raise ProtocolError(f"a {message['type']} of the server cannot be read: {exc!r}") from exc
        return self._receive_block(data, now_s) if data[:1] == bytes([BLOCK_KIND]) else None

    def live_input(self, ahead_blocks: int, longest_s: float) -> LiveInput:
        """That of a live emitter to be added, which keeps some blocks ahead and holds back so many seconds at most."""
        welcome = self.welcome
        assert welcome is not None
        writer = None
        if welcome.encoding == "opus":
            frame_samples = welcome.given["opus"]["frame_samples"]
            writer = OpusWriter(welcome.sample_rate, frame_samples, self._hello.get("opus") or {})
        ahead = ahead_blocks * welcome.block_size
        longest = ahead + round(longest_s * welcome.sample_rate)
        return LiveInput(welcome.block_size, ahead=ahead, longest=longest, writer=writer)

    def move_listener(self, pose: Pose, now_s: float) -> int:
        """Returns the pose id, which blocks name once they are heard from there."""
        self.listener = pose
        self._listener_pose_id = pose_id = self._new_pose(self.statistics, now_s)
        self.outbox.put(Outgoing(pose_bytes(pose, pose_id)), "listener")
        return pose_id

    def add_listener(self, identifier: str, pose: Pose, hrtf: str | None) -> SessionListener:
        """Raises RefusedError duplicate_listener."""
        if identifier in self.listeners:
            problem = f"listener {identifier!r} is already there"
            raise RefusedError("duplicate_listener", problem, field="id", listener=identifier)
        listener = self.listeners[identifier] = SessionListener(identifier, pose, hrtf)
        self.outbox.put(self._added_listener(listener))
        return listener

    def move_added_listener(self, listener: SessionListener, pose: Pose, now_s: float) -> int:
        """Returns the pose id, which blocks of this listener name once they are heard from there. Raises RefusedError
        unknown_listener for one that was removed or refused."""
        if self.listeners.get(listener.id) is not listener:
            problem = f"listener {listener.id!r} is not there any more"
            raise RefusedError("unknown_listener", problem, field="listener", listener=listener.id)
        listener.pose = pose
        listener.pose_id = pose_id = self._new_pose(listener.statistics, now_s)
        key = "listener", listener.id
        if listener.index is None:  # a new connection has asked for it, but does not know its number yet
            moved = {"pose_id": pose_id, "listener": listener.id, **_pose_fields(pose)}
            self._put({"type": "listener", **moved}, key)
        else:
            self.outbox.put(Outgoing(pose_bytes(pose, pose_id, listener.index)), key)
        return pose_id

    def remove_listener(self, listener: SessionListener) -> None:
        if self.listeners.get(listener.id) is listener:
            del self.listeners[listener.id]
            self._put({"type": "remove_listener", "id": listener.id})

    def take_refused_listener(self, error: RefusedError) -> SessionListener | None:
        """Forget the listener that was not added because of an error, and return it; None if the error was about
        something else. One whom the error does not name is removed, since the server may be about to have it."""
        listener = self._refused_listener(error)
        if listener is not None and error.listener is None:
            self.remove_listener(listener)
        elif listener is not None:
            del self.listeners[listener.id]
        return listener

    def _refused_listener(self, error: RefusedError) -> SessionListener | None:
        if error.listener is not None:
            listener = self.listeners.get(error.listener)
            return None if listener is None or listener.is_there or error.code in _NOT_THERE else listener
        if error.code != _NOT_KNOWN:
            return None
        return next((each for each in self.listeners.values() if not each.is_there), None)

    def add_emitter(self, fields: dict[str, Any], live: LiveInput | None) -> SessionEmitter:
        """Raises RefusedError duplicate_emitter."""
        if fields["id"] in self.emitters:
            raise RefusedError("duplicate_emitter", f"emitter {fields['id']!r} is already there", field="id")
        emitter = self.emitters[fields["id"]] = SessionEmitter(fields, live)
        self.outbox.put(self._added(emitter))
        return emitter

    def move_emitter(
        self, emitter: SessionEmitter, position: Position, orientation: Orientation | None, now_s: float
    ) -> int:
        """Without an orientation its front keeps its direction. Returns the pose id."""
        moved: dict[str, Any] = {"position": position}
        if orientation is not None:
            emitter.fields.pop("yaw", None)
            moved["orientation"] = orientation
        emitter.fields.update(moved)
        emitter.pose_id = pose_id = self._new_pose(self.statistics, now_s)
        move = {"type": "move_emitter", "id": emitter.id, "pose_id": pose_id, **moved}
        self._put(move, ("move", emitter.id), emitter)
        return pose_id

    def set_gain(self, emitter: SessionEmitter, gain_db: float, ramp_s: float) -> None:
        emitter.fields["gain_db"] = gain_db
        ramp = {"ramp_s": ramp_s} if ramp_s else {}
        self._put({"type": "set_gain", "id": emitter.id, "gain_db": gain_db, **ramp}, ("gain", emitter.id), emitter)

    def stop_emitter(self, emitter: SessionEmitter, stop_at: int | None, fade_s: float) -> None:
        """Let its clip fade out from a clock on, or at once."""
        at = {} if stop_at is None else {"stop_at": max(0, stop_at - self._clock_offset)}
        emitter.fields["loop"] = False  # what was stopped is not begun again by a new connection
        self._put({"type": "stop_emitter", "id": emitter.id, "fade_s": fade_s, **at}, emitter=emitter)

    def remove_emitter(self, emitter: SessionEmitter) -> None:
        if self.emitters.get(emitter.id) is emitter:
            del self.emitters[emitter.id]
            self._put({"type": "remove_emitter", "id": emitter.id}, emitter=emitter)

    def forget_emitter(self, emitter: SessionEmitter, error: RefusedError) -> None:
        """The server has refused it. One whom the error does not name is removed, since the server may be about to have
        it."""
        if error.emitter is None:
            self.remove_emitter(emitter)
        elif self.emitters.get(emitter.id) is emitter:
            del self.emitters[emitter.id]

    def set_level(self, level: str) -> None:
        self._hello["level"] = level
        self._put({"type": "set_level", "level": level})

    def set_door(self, door: str, openness: float) -> None:
        """A door that the scene does not have is an error of the server, and is not asked for by a new connection."""
        if self.welcome is None or door in self.welcome.doors:
            self._hello["doors"] = {**self._hello.get("doors", {}), door: openness}
        self._put({"type": "set_door", "door": door, "openness": openness}, ("door", door))

    def set_effects(self, effects: Mapping[str, bool | None], output: str | None) -> None:
        wished = {**self._hello.get("effects", {}), **effects}
        self._hello["effects"] = {name: is_on for name, is_on in wished.items() if is_on is not None}
        message: dict[str, Any] = {"type": "set_effects", "effects": dict(effects)}
        if output is not None:
            self._hello["output"] = message["output"] = output
        self._put(message)

    def ping(self, now_s: float) -> None:
        """Ask for a pong, which measures the round trip."""
        self._ping_id += 1
        self._pings = {self._ping_id: now_s}
        self._put({"type": "ping", "id": self._ping_id}, "ping")

    def pump(self) -> None:
        """Send what live emitters have and the server should."""
        for emitter in self.emitters.values():
            if emitter.live:
                for samples in emitter.live.due():
                    self._put_dry(emitter, emitter.live, samples)

    def _put_dry(self, emitter: SessionEmitter, live: LiveInput, samples: Samples) -> None:
        encoding: SampleEncoding = "f32" if self._hello["encoding"] == "f32" else "s16"
        if live.writer is None:
            data = dry_bytes(emitter.id, live.sequence, samples, encoding)
        else:
            data = dry_packet_bytes(emitter.id, live.sequence, live.writer.frame_samples, live.writer.write(samples))
        self.outbox.put(Outgoing(data))
        live.sequence += 1

    def _added(self, emitter: SessionEmitter) -> Outgoing:
        """What adds an emitter, with the server's clock in place of the session's."""
        fields = dict(emitter.fields)
        for name in ("start_at", "stop_at"):
            if name in fields:
                fields[name] = max(0, fields[name] - self._clock_offset)
        added = json.dumps({"type": "add_emitter", **fields})
        return Outgoing(added, is_counted=True, about=("emitter", emitter.id), adds=True)

    def _added_listener(self, listener: SessionListener) -> Outgoing:
        """What adds a listener where it is by now."""
        fields = {"id": listener.id, **_pose_fields(listener.pose)}
        if listener.hrtf is not None:
            fields["hrtf"] = listener.hrtf
        added = json.dumps({"type": "add_listener", **fields})
        return Outgoing(added, is_counted=True, about=("listener", listener.id), adds=True)

    def _begin_listener(self, listener: SessionListener, index: int, clock: int) -> None:
        """The server has said that a listener is there, from this clock of the session's on."""
        assert self.welcome is not None
        listener.index, listener.start_clock = index, clock
        if not listener.statistics.blocks:
            listener.next_clock = clock
        listener.level = self.level
        listener.packets = _packet_reader(self.welcome)

    def _put(self, message: Mapping[str, Any], key: object = None, emitter: SessionEmitter | None = None) -> None:
        """Say something, about an emitter if one is given."""
        about: Thing | None = None if emitter is None else ("emitter", emitter.id)
        self.outbox.put(Outgoing(json.dumps(message), message["type"] not in _UNCOUNTED, about), key)

    def _new_pose(self, counts: ListenerStatistics, now_s: float) -> int:
        pose_id, self._next_pose_id = self._next_pose_id, self._next_pose_id + 1
        counts.pose_to_sound.send(pose_id, now_s)
        counts.pose_to_reverberation.send(pose_id, now_s)
        return pose_id

    def _receive_block(self, data: bytes, now_s: float) -> Block | None:
        """Take a block of any listener. Returns None for that of a listener which was removed meanwhile."""
        index = listener_of(data)
        if index:
            listener = self.listener_at(index)
            if listener is None:
                return None
            block = self._counted(data, listener.packets, listener.statistics, listener.next_clock, now_s)
            listener.next_clock = block.sample_clock + block.frames
            self._acknowledge(block, listener.id)
            return block
        block = self._counted(data, self._packets, self.statistics, self.next_clock, now_s)
        frames = block.sample_clock + block.frames - self.next_clock
        self.next_clock = block.sample_clock + block.frames
        self._arrived_s = now_s
        self._acknowledge(block, None)
        for emitter in self.emitters.values():
            if emitter.live:
                emitter.live.advance(frames)
        self.pump()
        return block

    def listener_at(self, index: int) -> SessionListener | None:
        """The listener beside the first that has this number in the present connection."""
        return next((listener for listener in self.listeners.values() if listener.index == index), None)

    def _counted(
        self, data: bytes, packets: OpusReader | None, counts: ListenerStatistics, next_clock: int, now_s: float
    ) -> Block:
        """Read a block of a listener for whom one of `next_clock` was due, and count it."""
        welcome = self.welcome
        assert welcome is not None
        if packets is None:
            block = parse_block(data, welcome.encoding, now_s, self._clock_offset)
        else:
            block = parse_packets(data, packets, now_s, self._clock_offset)
        counts.blocks += 1
        counts.blocks_late += block.is_late
        counts.blocks_limited += block.is_limited
        counts.blocks_skipped += max(0, block.sample_clock - next_clock) // welcome.block_size
        counts.pose_to_sound.receive(block.pose_id, now_s)
        counts.pose_to_reverberation.receive(block.reverberation_pose_id, now_s)
        sequence, clock = self._last_block or (0, 0)
        self._last_block = max(sequence, block.sequence), max(clock, block.sample_clock - self._clock_offset)
        return block

    def _acknowledge(self, block: Block, listener: str | None) -> None:
        if block.sequence % _ACKNOWLEDGE_EVERY == _ACKNOWLEDGE_EVERY - 1:
            whose = {} if listener is None else {"listener": listener}
            self._put({"type": "acknowledge", "sequence": block.sequence, **whose}, ("acknowledge", listener))

    def _continued(self, welcome: Welcome, now_s: float) -> int:
        """The clock at which a new stream of the server's begins: as much later as the connection was away. The last
        block was to be played `buffer_blocks` after it arrived."""
        block_size = welcome.block_size
        away = (now_s - self._arrived_s) * welcome.sample_rate - welcome.buffer_blocks * block_size
        return self.next_clock + block_size * max(0, math.ceil(away / block_size))

    def _receive_message(self, message: dict[str, Any], now_s: float) -> Message:
        if "sample_clock" in message:
            message["sample_clock"] += self._clock_offset
        match message:
            case {"type": "emitter_added", "id": identifier, "sample_clock": clock} if identifier in self.emitters:
                emitter = self.emitters[identifier]
                if emitter.is_over:  # the server goes by a snapshot from before it was heard, and begins it again
                    emitter.has_ended = True
                    self.remove_emitter(emitter)
                    return message
                emitter.is_heard, emitter.start_clock = True, clock
                if emitter.live:
                    emitter.live.open()
                    self.pump()
            case {"type": "emitter_ended", "id": identifier} if identifier in self.emitters:
                emitter = self.emitters[identifier]
                emitter.has_ended = True
                if message.get("removed"):
                    self._end(emitter)
                    self.outbox.end(("emitter", identifier))
            case {"type": "listener_added", "id": identifier, "index": index, "sample_clock": clock} if (
                identifier in self.listeners
            ):
                self._begin_listener(self.listeners[identifier], index, clock)
            case {"type": "level_changed", "level": level, "listener": identifier}:
                if identifier in self.listeners:
                    self.listeners[identifier].level = level
            case {"type": "level_changed", "level": level}:
                self.level = level
            case {"type": "status", "live": live}:
                self._correct(live)
            case {"type": "snapshot", "snapshot": str(snapshot), "handled": int(handled)}:
                self._snapshot = snapshot
                self.outbox.forget(handled)
            case {"type": "pong", "id": identifier} if identifier in self._pings:
                self.statistics.round_trip.add(now_s - self._pings.pop(identifier))
            case {"type": "error"}:
                self.last_error = refusal(message)
        return message

    def _correct(self, live: Iterable[Mapping[str, Any]]) -> None:
        for each in live:
            emitter = self.emitters.get(each["id"])
            if emitter is not None and emitter.live:
                emitter.live.correct(each["samples_queued"])

    def refused_emitter(self, error: RefusedError) -> SessionEmitter | None:
        """The emitter that was not added because of an error; None if the error was about something else."""
        if error.emitter is not None:
            emitter = self.emitters.get(error.emitter)
            return None if emitter is None or emitter.is_heard or error.code in _NOT_THERE else emitter
        if error.code != _TOO_LARGE:
            return None
        return next((each for each in self.emitters.values() if not each.is_heard), None)


def _pose_fields(pose: Pose) -> dict[str, Any]:
    return {"position": pose.position, "orientation": pose.orientation}


def _packet_reader(welcome: Welcome) -> OpusReader | None:
    """What decodes a stream in Opus; None for one of single samples."""
    if welcome.encoding != "opus":
        return None
    opus = welcome.given["opus"]
    return OpusReader(welcome.sample_rate, list(opus["streams"]), opus["look_ahead"])


def refusal(message: Message) -> RefusedError:
    """The error that a message tells of."""
    names = "field", "emitter", "listener", "retry_after_s", "level"
    return RefusedError(
        str(message.get("code", "")), str(message.get("message", "")), **{name: message.get(name) for name in names}
    )


def _read(data: str) -> dict[str, Any]:
    try:
        message = json.loads(data)
    except ValueError as exc:
        raise ProtocolError("a message of the server is no JSON") from exc
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ProtocolError("a message of the server has no type")
    return message
