"""Messages from the client in the WebSocket stream at /v1/stream, protocol version 3.

Control messages are JSON text, one object with a `type` each. Listener poses may also be 36-byte binary messages, and
audio is always binary blocks (`server.protocol.blocks`). Binary is little endian. Units are metres, radians, decibels
and samples at the stream's rate.

Every type here parses and serialises itself, so that the tests, the documentation and both ends of the stream share one
definition. Client messages are validated here and nowhere else. A `RequestError` carries the code for the client.
"""

import json
import math
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final, Literal, Self, get_args

from pydantic import (
    Field,
    FiniteFloat,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from server.acoustics import directivity
from server.acoustics.directivity import Directivity
from server.acoustics.geometry import Pose, Quaternion
from server.acoustics.spherical_harmonics import HIGHEST_ORDER
from server.core.errors import RequestError
from server.core.json_keys import DoubledKeyError, require_distinct_keys
from server.core.near_names import suggestion
from server.planning.scene_acoustics import Output
from server.protocol.blocks import DryBlock, DryPackets
from server.protocol.codecs.registry import Encoding
from server.protocol.layout import Layout
from server.protocol.message import WHOLE, Integer, Message, Position
from server.protocol.opus import OpusOptions
from server.scene.door import MOST_DOORS, OpenShare

PROTOCOL: Final = 3
MOST_LISTENERS: Final = 64
"""Listeners that any stream may have; a server may allow fewer."""
AUTO = "auto"
"""Name of a level in messages; it lets the server choose the quality level."""

# guard: a block is as long as blocks may be
BlockSize = Literal[128, 256, 512, 1024]
EmitterId = Annotated[str, Field(min_length=1, max_length=64)]
ListenerId = Annotated[str, Field(min_length=1, max_length=64)]
# guard: a pose id ends where its number does
PoseId = Annotated[int, Field(ge=0, lt=2**32), WHOLE]
Orientation = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
LevelName = Annotated[str, Field(max_length=256)]
# guard: a gain in a message is one that can be heard
GainDb = Annotated[FiniteFloat, Field(ge=-80, le=24)]

Clock = Annotated[int, Field(ge=0, lt=2**53), WHOLE]  # JavaScript counts exactly up to here
"""A clock of the stream: samples since its beginning."""
ClipTime = Annotated[FiniteFloat, Field(ge=0, le=86_400)]
"""Seconds from the beginning of a clip."""
FadeTime = Annotated[FiniteFloat, Field(ge=0.001, le=60)]
RampTime = Annotated[FiniteFloat, Field(ge=0, le=600)]

_POSE_FIELDS = frozenset({"position", "orientation", "yaw", "listener"})
_OF_LOOPS: Final = ("loop_start_s", "loop_end_s")
_OF_CLIPS: Final = ("start_at", "stop_at", "offset_s", *_OF_LOOPS, "remove_when_ended")


class _Directed(Message):
    """A position with an orientation, given as a quaternion or as a yaw about the vertical axis. With neither, the
    front points along +x."""

    position: Position
    orientation: Orientation | None = None
    yaw: FiniteFloat | None = None

    @model_validator(mode="after")
    def _has_one_direction(self) -> Self:
        if self.orientation is not None and self.yaw is not None:
            raise PydanticCustomError("malformed_pose", "give orientation or yaw, not both")
        try:
            _ = self.pose
        except ValueError as exc:
            raise PydanticCustomError("malformed_pose", "{reason}", {"reason": str(exc)}) from exc
        return self

    @property
    def has_front(self) -> bool:
        """Whether the message has an orientation or a yaw."""
        return self.orientation is not None or self.yaw is not None

    @cached_property
    def pose(self) -> Pose:
        if self.orientation is not None:
            return Pose(self.position, Quaternion(*self.orientation))
        return Pose.from_yaw(self.position, self.yaw or 0.0)


class ListenerStart(_Directed):
    """Pose of the listener when the stream begins: pose 0."""


class Hello(Message):
    """The first message asks for a scene and says how it is to be rendered. `sample_rate` is one of the scene's
    `sample_rates`; without it the stream has the scene's own. With the encoding `opus`, `opus` says how to encode.
    `buffer_blocks` is how many blocks ahead of real time the server sends: a higher number copes with a worse network,
    a lower one has less latency. `hrtf` names a head, one of GET /v1/hrtfs. `level` names a quality level of the scene;
    with `auto` the server takes the best one that its host computes in time, and a cheaper one under load. `output`
    says what plays the sound: for a mono loudspeaker, blocks have one channel. With `ambisonics` blocks have the
    channels of `order` 1 (the default), 2 or 3 in the axes of the scene: ACN order, SN3D norm (AmbiX). The client turns
    them by its listener's orientation and decodes them; a turn then changes nothing in the blocks. `effects` switches
    effects on or off, whatever the plan would decide. `emitters` is how many emitters the client is about to add: the
    server lets the stream in only if they fit, and keeps room for them for some seconds. Without it the server expects
    as many as other streams have. `listeners` is how many listeners the stream is about to have, with the first one:
    room is kept for them in the same way, and `welcome` says with `max_listeners` how many there may be. `doors` says
    how far doors of the scene are open at first, by name; all others are as the scene has them. With `snapshots` the
    server sends a `snapshot` every few seconds, if it gives any."""

    type: Literal["hello"] = "hello"
    protocol: Integer
    scene: Annotated[str, Field(max_length=256)]
    sample_rate: Integer | None = None
    block_size: Annotated[BlockSize, WHOLE] = 256
    encoding: Encoding = "f32"
    opus: OpusOptions | None = None
    listener: ListenerStart | None = None
    hrtf: Annotated[str, Field(max_length=256)] | None = None
    level: LevelName = AUTO
    output: Output = "headphones"
    order: Annotated[int, Field(ge=1, le=HIGHEST_ORDER), WHOLE] | None = None
    effects: dict[str, bool] = Field(default_factory=dict, max_length=32)
    emitters: Annotated[int, Field(ge=0, le=64), WHOLE] | None = None
    listeners: Annotated[int, Field(ge=1, le=MOST_LISTENERS), WHOLE] | None = None
    doors: dict[str, OpenShare] = Field(default_factory=dict, max_length=MOST_DOORS)
    # guard: a buffer has blocks, and not too many
    buffer_blocks: Annotated[int, Field(ge=1, le=32), WHOLE] = 8
    snapshots: bool = False

    @field_validator("order")
    @classmethod
    def _is_of_ambisonics(cls, order: int | None, info: ValidationInfo) -> int | None:
        if order is not None and info.data.get("output", "ambisonics") != "ambisonics":
            raise PydanticCustomError("malformed_message", "belongs to the output ambisonics")
        return order

    @field_validator("opus")
    @classmethod
    def _is_of_opus(cls, options: OpusOptions | None, info: ValidationInfo) -> OpusOptions | None:
        if options is not None and info.data.get("encoding", "opus") != "opus":
            raise PydanticCustomError("malformed_message", "belongs to the encoding opus")
        return options

    @property
    def ambisonic_order(self) -> int | None:
        """The order of the channels to render; None for another output."""
        if self.output != "ambisonics":
            return None
        return 1 if self.order is None else self.order


class Resume(Message):
    """The first message of a client whose connection was lost, in place of a `hello`: the stream goes on, with its
    emitters, clips, gains, level, effects and clock. `token` is that of the last `welcome`, `snapshot` that of the last
    message `snapshot`; one of them is needed, and if the server knows the token it needs no snapshot. `sequence` and
    `sample_clock` are those of the last block that arrived, the greatest of all listeners: later blocks have greater
    ones. The answer is a `welcome`
    with `resumed`, or the error `unknown_resume_token`, after which a `hello` begins anew."""

    type: Literal["resume"] = "resume"
    protocol: Integer
    token: Annotated[str, Field(max_length=64)] | None = None
    snapshot: Annotated[str, Field(max_length=48 * 1024)] | None = None
    sequence: Annotated[int, Field(ge=0, lt=2**32), WHOLE] | None = None
    sample_clock: Annotated[int, Field(ge=0, lt=2**62), WHOLE] | None = None

    @model_validator(mode="after")
    def _has_something_to_go_on_from(self) -> Self:
        if self.token is None and self.snapshot is None:
            raise PydanticCustomError("malformed_resume", "give token, snapshot or both")
        return self


class DirectivityPattern(Message):
    """How loud an emitter is in each direction, relative to its front. A pattern of the cardioid family is narrowed by
    `order`. A measured pattern has `gains_db`: seven octave bands from 125 Hz, each with one gain for each of
    `angles_deg`, which rise from 0 (front) to 180 (rear)."""

    pattern: Literal[
        "omnidirectional", "subcardioid", "cardioid", "supercardioid", "hypercardioid", "figure_of_eight", "measured"
    ]
    order: FiniteFloat | None = None
    angles_deg: Annotated[tuple[FiniteFloat, ...], Field(max_length=361)] | None = None
    gains_db: Annotated[tuple[tuple[FiniteFloat, ...], ...], Field(max_length=7)] | None = None

    @model_validator(mode="after")
    def _is_one_pattern(self) -> Self:
        try:
            _ = self.directivity
        except ValueError as exc:
            raise PydanticCustomError("malformed_directivity", "{reason}", {"reason": str(exc)}) from exc
        return self

    @property
    def directivity(self) -> Directivity:
        measured = self.angles_deg, self.gains_db
        if self.pattern == "measured":
            if self.order is not None or None in measured:
                raise ValueError("a measured pattern has angles_deg and gains_db, and no order")
            return directivity.PolarPattern(self.angles_deg or (), self.gains_db or ())
        if measured != (None, None):
            raise ValueError(f"angles_deg and gains_db belong to a measured pattern, not to {self.pattern!r}")
        family: directivity.Cardioid = getattr(directivity, self.pattern.upper())
        return family if self.order is None else directivity.Cardioid(family.omni_share, self.order)


class AddEmitter(_Directed):
    """Adds an emitter, which plays a clip or, with `live`, the dry blocks that the client sends for it.

    Its orientation affects only its directivity. Without a directivity it is equally loud in all directions.

    A clip begins at the sample clock `start_at` of the stream, to the sample; without it, or if that has passed when
    its first impulse response is there, at once. `emitter_added` says when. It begins `offset_s` seconds into the clip,
    where it fades in over 64 samples. With `loop` it repeats what lies between `loop_start_s` and `loop_end_s`, which
    are the clip's ends by default, without a gap. From `stop_at` on it fades out over 10 ms; a `stop_emitter` may do
    that too. A clip that has not begun by then is not heard.

    Samples of a live emitter wait for `jitter_ms`, by default for two blocks, so that they may come unevenly. Where too
    few have come in time, the sound fades out, and goes on after twice that wait. In the place of lost blocks there is
    silence, faded out and in.

    Once a clip without `loop`, or a stopped one, has been heard to its end with its reverberation, an `emitter_ended`
    says so. With `remove_when_ended` the emitter is removed then, and its id is free.
    """

    type: Literal["add_emitter"] = "add_emitter"
    id: EmitterId
    clip: Annotated[str, Field(max_length=256)] | None = None
    live: bool = False
    gain_db: GainDb = 0.0
    loop: bool = True
    directivity: DirectivityPattern | None = None
    start_at: Clock | None = None
    stop_at: Clock | None = None
    offset_s: ClipTime = 0.0
    loop_start_s: ClipTime = 0.0
    loop_end_s: ClipTime | None = None
    remove_when_ended: bool = False
    jitter_ms: Annotated[FiniteFloat, Field(ge=2, le=250)] | None = None

    @model_validator(mode="after")
    def _has_one_sound(self) -> Self:
        if self.live == (self.clip is not None):
            raise PydanticCustomError("malformed_emitter", "give a clip or live, one of them")
        if self.live and (given := self._given(*_OF_CLIPS)):
            raise _misplaced(given, "belongs to a clip, and the emitter is live")
        if not self.loop and (given := self._given(*_OF_LOOPS)):
            raise _misplaced(given, "belongs to a loop, and loop is false")
        if not self.live and self.jitter_ms is not None:
            raise _misplaced("jitter_ms", "belongs to a live emitter, and this one plays a clip")
        return self

    def _given(self, *names: str) -> str | None:
        """The first of these fields that is not as it is by default."""
        fields = type(self).model_fields
        return next((name for name in names if getattr(self, name) != fields[name].default), None)


def _misplaced(field: str, problem: str) -> PydanticCustomError:
    return PydanticCustomError("misplaced_field", "{problem}", {"problem": problem, "field": field})


class StopEmitter(Message):
    """Lets an emitter's clip fade out over `fade_s` from the sample clock `stop_at` on; without it, or if that has
    passed, from the next block on. An `emitter_ended` follows, as at the end of the clip. The newest `stop_emitter`
    counts until the fade begins. A live emitter is removed instead."""

    type: Literal["stop_emitter"] = "stop_emitter"
    id: EmitterId
    stop_at: Clock | None = None
    fade_s: FadeTime = 0.01


class MoveEmitter(_Directed):
    """Moves an emitter. Without `orientation` and `yaw` its front keeps its direction."""

    type: Literal["move_emitter"] = "move_emitter"
    id: EmitterId
    pose_id: PoseId


class SetGain(Message):
    """Sets the gain of an emitter, for direct sound and reflected field alike. It is reached by the end of the next
    block or, with `ramp_s`, by a ramp that begins with the next block, is linear in decibels, and ends to the sample. A
    newer gain takes the place of a ramp. An emitter that is not heard yet has its gain at once."""

    type: Literal["set_gain"] = "set_gain"
    id: EmitterId
    gain_db: GainDb
    ramp_s: RampTime = 0.0


class SetDoor(Message):
    """Opens or shuts a door of the scene, for all listeners: `openness` is 0 shut and 1 open. A door that swings sends
    one for each step. Straight and bent sound follows within a block or two, mirrored sound and reverberation when
    responses have been computed. A door is open from the beginning as the `hello` says, or as the scene has it."""

    type: Literal["set_door"] = "set_door"
    door: Annotated[str, Field(min_length=1, max_length=64)]
    openness: OpenShare


class SetLevel(Message):
    """Chooses a quality level, or auto, for all listeners. A `level_changed` says from when it is heard."""

    type: Literal["set_level"] = "set_level"
    level: LevelName


class SetEffects(Message):
    """Switches effects on or off, whatever the plan would decide; null leaves an effect to the plan. Also sets what
    plays the sound, but neither to nor from ambisonics. Both count for all listeners. A `plan_changed` says which
    effects are on then."""

    type: Literal["set_effects"] = "set_effects"
    effects: dict[str, bool | None] = Field(default_factory=dict, max_length=32)
    output: Output | None = None


class RemoveEmitter(Message):
    """Removes an emitter. Its id may be used again."""

    type: Literal["remove_emitter"] = "remove_emitter"
    id: EmitterId


class AddListener(_Directed):
    """Adds a listener to the stream, who hears the same emitters at the same time: a player at a split screen, or a
    spectator. Its first block has the clock that `listener_added` says, and what sounds then fades in. Its blocks have
    its number (`index`) in their headers, and acknowledgements, levels under load and effects of its own. `hrtf` names
    its head; without it, it has that of the `hello`. Output, encoding, block size and sample rate are the stream's. The
    position and direction are those of its pose until its first `listener`, and count as the stream's newest pose."""

    type: Literal["add_listener"] = "add_listener"
    id: ListenerId
    hrtf: Annotated[str, Field(max_length=256)] | None = None


class RemoveListener(Message):
    """Removes a listener. Its id may be used again. The first listener, who has no id, goes with the stream."""

    type: Literal["remove_listener"] = "remove_listener"
    id: ListenerId


class ListenerPose(_Directed):
    """The newest pose of a listener, as text or as 36 bytes. `listener` is the id of its `add_listener`, or `index` its
    number; without either, and with the number 0, it is the stream's first listener."""

    type: Literal["listener"] = "listener"
    pose_id: PoseId
    listener: ListenerId | None = None
    index: Annotated[int, Field(ge=0, le=255), WHOLE] | None = None

    @model_validator(mode="after")
    def _is_of_one_listener(self) -> Self:
        if self.listener is not None and self.index is not None:
            raise PydanticCustomError("malformed_message", "give listener or index, not both")
        return self

    KIND: ClassVar[int] = 2
    LAYOUT: ClassVar[Layout] = Layout(
        ("kind", "B", f"always {KIND}"),
        ("listener", "B", "number of the listener, 0 for the first"),
        ("zeros", "2x", "padding"),
        ("pose_id", "I", "greater than all earlier ones, of this listener and of emitters"),
        ("position", "3f", "x, y, z in metres"),
        ("orientation", "4f", "quaternion x, y, z, w; the identity looks along +x"),
    )

    @classmethod
    def parse_binary(cls, data: bytes) -> Self:
        """Read a pose from bytes.

        Raises RequestError: unknown_message for another kind, malformed_pose for a wrong length or impossible numbers.
        """
        # guard: an empty message has no kind
        if not data or data[0] != cls.KIND:
            raise RequestError("unknown_message", f"binary message of unknown kind {data[0] if data else 'none'}")
        # guard: a binary pose is as long as it is
        if len(data) != cls.LAYOUT.size:
            raise RequestError("malformed_pose", f"a binary pose has {cls.LAYOUT.size} bytes, not {len(data)}")
        _, index, pose_id, *numbers = cls.LAYOUT.unpack(data)
        whose = {"index": index} if index else {}
        try:
            return cls(pose_id=pose_id, position=tuple(numbers[:3]), orientation=tuple(numbers[3:]), **whose)
        except ValidationError as exc:
            # guard: a binary pose that is none is refused by code
            raise _refusal(exc, is_tagged=False) from exc

    def serialize_binary(self) -> bytes:
        """The pose as bytes, which know a listener by its number alone."""
        pose = self.pose
        return self.LAYOUT.pack(self.KIND, self.index or 0, self.pose_id, *pose.position, *pose.orientation)


class Acknowledge(Message):
    """Says that every block of a listener up to and including `sequence` has arrived; without `listener` of the
    stream's first one."""

    type: Literal["acknowledge"] = "acknowledge"
    sequence: Annotated[int, Field(ge=0, lt=2**32), WHOLE]
    listener: ListenerId | None = None


class Ping(Message):
    """Asks for a pong at once, to measure the round-trip time."""

    type: Literal["ping"] = "ping"
    id: Annotated[int, Field(ge=0, lt=2**53), WHOLE]  # JavaScript counts exactly up to here


TextMessage = (
    Hello
    | Resume
    | AddEmitter
    | MoveEmitter
    | StopEmitter
    | SetGain
    | SetDoor
    | SetLevel
    | SetEffects
    | RemoveEmitter
    | AddListener
    | RemoveListener
    | ListenerPose
    | Acknowledge
    | Ping
)
ClientMessage = TextMessage | DryBlock | DryPackets
_FIELDS: Final[Mapping[str, Iterable[str]]] = {
    str(each.model_fields["type"].default): each.model_fields for each in get_args(TextMessage)
}
_CLIENT: TypeAdapter[TextMessage] = TypeAdapter(Annotated[TextMessage, Field(discriminator="type")])


_ID: TypeAdapter[str] = TypeAdapter(Annotated[str, Field(min_length=1, max_length=64)])
_ID_KEYS: Final[Mapping[str, tuple[str | None, str | None]]] = {
    **dict.fromkeys(("add_emitter", "move_emitter", "stop_emitter", "set_gain", "remove_emitter"), ("id", None)),
    **dict.fromkeys(("add_listener", "remove_listener"), (None, "id")),
    **dict.fromkeys(("listener", "acknowledge"), (None, "listener")),
}
"""Where messages of these types have the ids of the emitter and of the listener that they are about."""


def emitter_of(message: ClientMessage) -> str | None:
    """The id of the emitter that a message is about; None if it is about none."""
    about_one = AddEmitter | MoveEmitter | StopEmitter | SetGain | RemoveEmitter | DryBlock | DryPackets
    return message.id if isinstance(message, about_one) else None


def listener_of(message: ClientMessage) -> str | None:
    """The id of the listener that a message is about; None if it is about the first, or none."""
    match message:
        case AddListener() | RemoveListener():
            return message.id
        case ListenerPose() | Acknowledge():
            return message.listener
    return None


def ids_named_by(data: str | bytes) -> tuple[str | None, str | None]:
    """The ids of the emitter and of the listener that a message is about which `parse_client_message` refuses, as
    `emitter_of` and `listener_of` have them of others. None where the message has no such id that can be read."""
    raw = {} if isinstance(data, bytes) else _object_in(data)
    emitter_key, listener_key = _ID_KEYS.get(str(raw.get("type")), (None, None))
    return _id_in(raw, emitter_key), _id_in(raw, listener_key)


def _id_in(raw: Mapping[str, Any], key: str | None) -> str | None:
    try:
        return None if key is None else _ID.validate_python(raw.get(key), strict=True)
    except ValidationError:
        return None


def parse_client_message(data: str | bytes) -> ClientMessage:
    """Read one message as it came from the socket, text or binary.

    The version in a hello is read first, since other versions have other fields. A duplicate key in any object is
    refused. Raises RequestError, which names the field at fault, with code unsupported_protocol, malformed_message,
    unknown_message, malformed_pose, malformed_directivity or malformed_block.
    """
    if isinstance(data, bytes):
        return DryBlock.parse(data) if data[:1] == bytes([DryBlock.KIND]) else ListenerPose.parse_binary(data)
    try:
        message = _CLIENT.validate_json(data)
    except ValidationError as exc:
        _require_version(data)
        # guard: a message that is none is refused by code
        raise _refusal(exc, is_tagged=True) from exc
    # Every key has a colon, so a message with no more colons than fields has no duplicate key. This settles nearly all
    # messages at a hundredth of the cost of parsing them again.
    if data.count(":") > len(message.model_fields_set):
        _require_distinct_keys(data)
    return message


def require_protocol(first: Hello | Resume) -> None:
    """Raises RequestError for another version than this one."""
    if first.protocol != PROTOCOL:
        problem = f"this server speaks protocol {PROTOCOL}, not {first.protocol}"
        raise RequestError("unsupported_protocol", problem, field="protocol")


def _require_distinct_keys(data: str) -> None:
    try:
        require_distinct_keys(data)
    except DoubledKeyError as exc:
        raise RequestError("malformed_message", str(exc), field=exc.key) from exc


def _require_version(data: str) -> None:
    """Raises RequestError for a hello or resume of another version, or without one."""
    hello = _object_in(data)
    if hello.get("type") not in ("hello", "resume"):
        return
    version = hello.get("protocol")
    if isinstance(version, bool) or not isinstance(version, int | float) or version % 1 > 0:
        problem = f"protocol: has to be the version, a whole number; this server speaks {PROTOCOL}"
        raise RequestError("malformed_message", problem, field="protocol")
    if version != PROTOCOL:
        problem = f"this server speaks protocol {PROTOCOL}, not {version:g}"
        raise RequestError("unsupported_protocol", problem, field="protocol")


def _object_in(data: str) -> dict[str, Any]:
    """The JSON object of a message that may be none; empty where there is none."""
    try:
        # Python refuses to convert very long integers.
        found = json.loads(data, parse_int=lambda digits: int(digits) if len(digits) < 20 else math.inf)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _refusal(error: ValidationError, *, is_tagged: bool) -> RequestError:
    """The refusal for a validation error. With `is_tagged`, pydantic's locations begin with the message's type."""
    first: Mapping[str, Any] = error.errors(include_url=False, include_input=False)[0]
    kind, place = first["type"], [part for part in first["loc"][is_tagged:] if isinstance(part, str)]
    field = ".".join(place) or None
    if kind in {"union_tag_invalid", "union_tag_not_found"}:
        code, field = "unknown_message", "type"
    # guard: a pose that is impossible is refused by code
    elif kind == "malformed_pose" or (place and place[0] in _POSE_FIELDS and not kind.startswith("string_")):
        code = "malformed_pose"
    elif place and place[0] == "directivity":
        code = "malformed_directivity"
    else:
        code = "malformed_message"
    reason = str(first["msg"])
    if kind == "misplaced_field":
        field = str(first["ctx"]["field"])
    if kind == "extra_forbidden":
        known = _FIELDS.get(str(first["loc"][0]), ()) if len(place) == 1 else ()
        reason = f"unknown field{suggestion(place[-1], known) if known else ''}"
    return RequestError(code, f"{field}: {reason}" if field else reason, field=field)
