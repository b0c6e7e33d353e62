"""Messages of the WebSocket stream at /v1/stream, protocol version 2.

Control travels as JSON text, one object with a `type` per message; listener poses may travel as 36-byte binary messages
instead, and audio always travels as binary blocks (`server.protocol.blocks`). Binary is little endian. Metres, radians,
decibels, samples of the scene's rate.

Every type here parses and serialises itself, so the tests, the documentation and both ends of the wire read one
definition. What a client sends is validated here, once; a `RequestError` carries the code that goes back to it.
"""

import json
import math
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final, Literal, Self, get_args

from pydantic import Field, FiniteFloat, TypeAdapter, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from server.acoustics import directivity
from server.acoustics.directivity import Directivity
from server.acoustics.geometry import Pose, Quaternion
from server.core.errors import RequestError
from server.core.json_keys import DoubledKeyError, require_distinct_keys
from server.core.near_names import suggestion
from server.planning.scene_acoustics import Output
from server.protocol.blocks import DryBlock, Encoding
from server.protocol.layout import Layout
from server.protocol.message import WHOLE, Integer, Message, Position

PROTOCOL: Final = 2
AUTO = "auto"
"""The level that leaves the choice to the server."""

BlockSize = Literal[128, 256, 512, 1024]
EmitterId = Annotated[str, Field(min_length=1, max_length=64)]
PoseId = Annotated[int, Field(ge=0, lt=2**32), WHOLE]
Orientation = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
LevelName = Annotated[str, Field(max_length=256)]
GainDb = Annotated[FiniteFloat, Field(ge=-80, le=24)]

_POSE_FIELDS = frozenset({"position", "orientation", "yaw", "listener"})


class _Directed(Message):
    """A position and where front is: a quaternion, or a yaw where up is up; with neither, front is along +x."""

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
        """Whether the message says where front is."""
        return self.orientation is not None or self.yaw is not None

    @cached_property
    def pose(self) -> Pose:
        if self.orientation is not None:
            return Pose(self.position, Quaternion(*self.orientation))
        return Pose.from_yaw(self.position, self.yaw or 0.0)


class ListenerStart(_Directed):
    """Where the listener stands when the stream begins: pose 0."""


class Hello(Message):
    """The first message: asks for a scene, and how to hear it. `sample_rate` may be left out; given, it has to be the
    scene's. `buffer_blocks` is how many blocks ahead of real time the server runs: more survives a worse network, less
    is heard sooner. `hrtf` names the head to hear through, one of GET /v1/hrtfs. `level` names a quality level of the
    scene, or leaves it to the server (auto): the best that its host computes in time, and a cheaper one under load.
    `output` is what the sound is heard from: a mono loudspeaker gets blocks of one channel. `effects` switches some on
    or off whatever the plan would decide."""

    type: Literal["hello"] = "hello"
    protocol: Integer
    scene: Annotated[str, Field(max_length=256)]
    sample_rate: Integer | None = None
    block_size: Annotated[BlockSize, WHOLE] = 256
    encoding: Encoding = "f32"
    listener: ListenerStart | None = None
    hrtf: Annotated[str, Field(max_length=256)] | None = None
    level: LevelName = AUTO
    output: Output = "headphones"
    effects: dict[str, bool] = Field(default_factory=dict, max_length=32)
    buffer_blocks: Annotated[int, Field(ge=1, le=32), WHOLE] = 8


class DirectivityPattern(Message):
    """How loud an emitter is in each direction, as seen by itself: one of the cardioid family, narrowed by `order`, or
    measured: `gains_db`, seven octave bands from 125 Hz of one gain for each of `angles_deg`, which rise from 0 (its
    front) to 180."""

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
    """An emitter that plays a clip, or, with `live`, what the client sends for it in dry blocks.

    Its front matters to its directivity only; without one it is equally loud all round.
    """

    type: Literal["add_emitter"] = "add_emitter"
    id: EmitterId
    clip: Annotated[str, Field(max_length=256)] | None = None
    live: bool = False
    gain_db: GainDb = 0.0
    loop: bool = True
    directivity: DirectivityPattern | None = None

    @model_validator(mode="after")
    def _has_one_sound(self) -> Self:
        if self.live == (self.clip is not None):
            raise PydanticCustomError("malformed_emitter", "give a clip or live, one of them")
        return self


class MoveEmitter(_Directed):
    """Where an emitter is from now on; without orientation and yaw its front stays where it was."""

    type: Literal["move_emitter"] = "move_emitter"
    id: EmitterId
    pose_id: PoseId


class SetGain(Message):
    """How loud an emitter is from now on, direct sound and reverberation alike."""

    type: Literal["set_gain"] = "set_gain"
    id: EmitterId
    gain_db: GainDb


class SetLevel(Message):
    """The quality level to hear from now on, or auto; a level changed says when."""

    type: Literal["set_level"] = "set_level"
    level: LevelName


class SetEffects(Message):
    """Effects to switch on or off whatever the plan of effects would decide, or, with null, to leave to it; and what
    the sound is heard from, from now on. A plan changed says what came of it."""

    type: Literal["set_effects"] = "set_effects"
    effects: dict[str, bool | None] = Field(default_factory=dict, max_length=32)
    output: Output | None = None


class RemoveEmitter(Message):
    """An emitter falls silent and its id is free again."""

    type: Literal["remove_emitter"] = "remove_emitter"
    id: EmitterId


class ListenerPose(_Directed):
    """Newest pose of the listener, as text or in 36 bytes."""

    type: Literal["listener"] = "listener"
    pose_id: PoseId

    KIND: ClassVar[int] = 2
    LAYOUT: ClassVar[Layout] = Layout(
        ("kind", "B", f"always {KIND}"),
        ("zeros", "3x", "fill the header up"),
        ("pose_id", "I", "greater than any before, of the listener and of emitters"),
        ("position", "3f", "x, y, z in metres"),
        ("orientation", "4f", "quaternion x, y, z, w; the identity looks along +x"),
    )

    @classmethod
    def parse_binary(cls, data: bytes) -> Self:
        """By LAYOUT.

        Raises RequestError: unknown_message for another kind, malformed_pose for a wrong length or impossible numbers.
        """
        if not data or data[0] != cls.KIND:
            raise RequestError("unknown_message", f"binary message of unknown kind {data[0] if data else 'none'}")
        if len(data) != cls.LAYOUT.size:
            raise RequestError("malformed_pose", f"a binary pose has {cls.LAYOUT.size} bytes, not {len(data)}")
        _, pose_id, *numbers = cls.LAYOUT.unpack(data)
        try:
            return cls(pose_id=pose_id, position=tuple(numbers[:3]), orientation=tuple(numbers[3:]))
        except ValidationError as exc:
            raise _refusal(exc, is_tagged=False) from exc

    def serialize_binary(self) -> bytes:
        pose = self.pose
        return self.LAYOUT.pack(self.KIND, self.pose_id, *pose.position, *pose.orientation)


class Acknowledge(Message):
    """Every block up to and including `sequence` has arrived."""

    type: Literal["acknowledge"] = "acknowledge"
    sequence: Annotated[int, Field(ge=0, lt=2**32), WHOLE]


class Ping(Message):
    """Asks for a pong at once, to measure the way there and back."""

    type: Literal["ping"] = "ping"
    id: Annotated[int, Field(ge=0, lt=2**53), WHOLE]  # what JavaScript counts exactly


TextMessage = (
    Hello
    | AddEmitter
    | MoveEmitter
    | SetGain
    | SetLevel
    | SetEffects
    | RemoveEmitter
    | ListenerPose
    | Acknowledge
    | Ping
)
ClientMessage = TextMessage | DryBlock
_FIELDS: Final[Mapping[str, Iterable[str]]] = {
    str(each.model_fields["type"].default): each.model_fields for each in get_args(TextMessage)
}
_CLIENT: TypeAdapter[TextMessage] = TypeAdapter(Annotated[TextMessage, Field(discriminator="type")])


def parse_client_message(data: str | bytes) -> ClientMessage:
    """One message as it came off the socket: text or binary.

    Of a hello the version is read before all else, since other versions have other fields. A key that is there twice is
    refused, in whichever object. Raises RequestError with
    code unsupported_protocol, malformed_message, unknown_message, malformed_pose, malformed_directivity or
    malformed_block, naming the field at fault.
    """
    if isinstance(data, bytes):
        return DryBlock.parse(data) if data[:1] == bytes([DryBlock.KIND]) else ListenerPose.parse_binary(data)
    try:
        message = _CLIENT.validate_json(data)
    except ValidationError as exc:
        _require_version(data)
        raise _refusal(exc, is_tagged=True) from exc
    # Every key has a colon: where there are no more of those than fields, no key is there twice. Nearly all messages
    # are known by that, at a hundredth of what reading them once more would take.
    if data.count(":") > len(message.model_fields_set):
        _require_distinct_keys(data)
    return message


def _require_distinct_keys(data: str) -> None:
    try:
        require_distinct_keys(data)
    except DoubledKeyError as exc:
        raise RequestError("malformed_message", str(exc), field=exc.key) from exc


def _require_version(data: str) -> None:
    """Raises RequestError for a hello of another version, or of none."""
    try:
        # Digits without end are no number that Python makes.
        said = json.loads(data, parse_int=lambda digits: int(digits) if len(digits) < 20 else math.inf)
    except (ValueError, RecursionError):
        return
    if not isinstance(said, dict) or said.get("type") != "hello":
        return
    version = said.get("protocol")
    if isinstance(version, bool) or not isinstance(version, int | float) or version % 1 > 0:
        problem = f"protocol: is to be the version, a whole number; this server speaks {PROTOCOL}"
        raise RequestError("malformed_message", problem, field="protocol")
    if version != PROTOCOL:
        problem = f"this server speaks protocol {PROTOCOL}, not {version:g}"
        raise RequestError("unsupported_protocol", problem, field="protocol")


def _refusal(error: ValidationError, *, is_tagged: bool) -> RequestError:
    """`is_tagged`: the places pydantic names begin with the message's type."""
    first: Mapping[str, Any] = error.errors(include_url=False, include_input=False)[0]
    kind, place = first["type"], [part for part in first["loc"][is_tagged:] if isinstance(part, str)]
    field = ".".join(place) or None
    if kind in {"union_tag_invalid", "union_tag_not_found"}:
        code, field = "unknown_message", "type"
    elif kind == "malformed_pose" or (place and place[0] in _POSE_FIELDS):
        code = "malformed_pose"
    elif place and place[0] == "directivity":
        code = "malformed_directivity"
    else:
        code = "malformed_message"
    reason = str(first["msg"])
    if kind == "extra_forbidden":
        known = _FIELDS.get(str(first["loc"][0]), ()) if len(place) == 1 else ()
        reason = f"unknown field{suggestion(place[-1], known) if known else ''}"
    return RequestError(code, f"{field}: {reason}" if field else reason, field=field)
