"""Wire types of the WebSocket stream at /v1/stream, protocol version 1.

Control travels as JSON text, one object with a `type` per message; listener poses may travel as 36-byte binary messages
instead, and audio always travels as binary blocks. Binary is little endian. Metres, radians, decibels, samples of the
scene's rate.

Every type here parses and serialises itself, so the tests, the documentation and both ends of the wire read one
definition. What a client sends is validated here, once; a `RequestError` carries the code that goes back to it.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from server.acoustics.geometry import Pose
from server.errors import RequestError
from server.scene.geometry import Opening
from server.scene.manifest import Bounds, QualityLevel

PROTOCOL: Final = 1

FloatArray = npt.NDArray[np.float32]
Encoding = Literal["f32", "s16"]
BlockSize = Literal[128, 256, 512, 1024]
EmitterId = Annotated[str, Field(min_length=1, max_length=64)]
PoseId = Annotated[int, Field(ge=0, lt=2**32)]
Position = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Quaternion = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]

_POSE_FIELDS = frozenset({"position", "orientation", "yaw", "listener"})


class _Message(BaseModel):
    # Unknown fields are refused: a misspelt "orientaton" would otherwise be heard as a head that never turns.
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    def serialize(self) -> str:
        return self.model_dump_json()


class _Directed(_Message):
    """A position and a heading: a quaternion, or a yaw for a level head; with neither, the head looks along +x."""

    position: Position
    orientation: Quaternion | None = None
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
    def pose(self) -> Pose:
        if self.orientation is not None:
            return Pose(self.position, self.orientation)
        return Pose.from_yaw(self.position, self.yaw or 0.0)


class ListenerStart(_Directed):
    """Where the listener stands when the stream begins: pose 0."""


class Hello(_Message):
    """First message. `sample_rate` may be left out; given, it has to be the scene's. `buffer_blocks` is how many blocks
    ahead of real time the server runs: more survives a worse network, less is heard sooner."""

    type: Literal["hello"] = "hello"
    protocol: int
    scene: Annotated[str, Field(max_length=256)]
    sample_rate: int | None = None
    block_size: BlockSize = 256
    encoding: Encoding = "f32"
    listener: ListenerStart | None = None
    buffer_blocks: Annotated[int, Field(ge=1, le=32)] = 8


class AddEmitter(_Message):
    type: Literal["add_emitter"] = "add_emitter"
    id: EmitterId
    clip: Annotated[str, Field(max_length=256)]
    position: Position
    gain_db: Annotated[FiniteFloat, Field(ge=-80, le=24)] = 0.0
    loop: bool = True


class MoveEmitter(_Message):
    type: Literal["move_emitter"] = "move_emitter"
    id: EmitterId
    position: Position
    pose_id: PoseId


class RemoveEmitter(_Message):
    type: Literal["remove_emitter"] = "remove_emitter"
    id: EmitterId


class ListenerPose(_Directed):
    """Newest pose of the listener; as text, or as the 36-byte binary form of `parse_binary`."""

    type: Literal["listener"] = "listener"
    pose_id: PoseId

    KIND: ClassVar[int] = 2
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBHI7f")

    @classmethod
    def parse_binary(cls, data: bytes) -> Self:
        """kind u8 = 2, three zero bytes, pose id u32, position 3 x f32, orientation 4 x f32 (x, y, z, w).

        Raises RequestError: unknown_message for another kind, malformed_pose for a wrong length or impossible numbers.
        """
        if not data or data[0] != cls.KIND:
            raise RequestError("unknown_message", f"binary message of unknown kind {data[0] if data else 'none'}")
        if len(data) != cls._LAYOUT.size:
            raise RequestError("malformed_pose", f"a binary pose has {cls._LAYOUT.size} bytes, not {len(data)}")
        _, _, _, pose_id, *numbers = cls._LAYOUT.unpack(data)
        try:
            return cls(pose_id=pose_id, position=tuple(numbers[:3]), orientation=tuple(numbers[3:]))
        except ValidationError as exc:
            raise _refusal(exc, is_tagged=False) from exc

    def serialize_binary(self) -> bytes:
        pose = self.pose
        return self._LAYOUT.pack(self.KIND, 0, 0, self.pose_id, *pose.position, *pose.orientation)


class Acknowledge(_Message):
    """Every block up to and including `sequence` has arrived."""

    type: Literal["acknowledge"] = "acknowledge"
    sequence: Annotated[int, Field(ge=0, lt=2**32)]


class Ping(_Message):
    type: Literal["ping"] = "ping"
    id: Annotated[int, Field(ge=0, lt=2**53)]  # what JavaScript counts exactly


ClientMessage = Hello | AddEmitter | MoveEmitter | RemoveEmitter | ListenerPose | Acknowledge | Ping
_CLIENT: TypeAdapter[ClientMessage] = TypeAdapter(Annotated[ClientMessage, Field(discriminator="type")])


def parse_client_message(data: str | bytes) -> ClientMessage:
    """One message as it came off the socket: text or binary.

    Raises RequestError with code malformed_message, unknown_message or malformed_pose, naming the field at fault.
    """
    if isinstance(data, bytes):
        return ListenerPose.parse_binary(data)
    try:
        return _CLIENT.validate_json(data)
    except ValidationError as exc:
        raise _refusal(exc, is_tagged=True) from exc


def _refusal(error: ValidationError, *, is_tagged: bool) -> RequestError:
    """`is_tagged`: the places pydantic names begin with the message's type."""
    first: Mapping[str, Any] = error.errors(include_url=False, include_input=False)[0]
    kind, place = first["type"], [part for part in first["loc"][is_tagged:] if isinstance(part, str)]
    field = ".".join(place) or None
    if kind in {"union_tag_invalid", "union_tag_not_found"}:
        code, field = "unknown_message", "type"
    elif kind == "malformed_pose" or (place and place[0] in _POSE_FIELDS):
        code = "malformed_pose"
    else:
        code = "malformed_message"
    return RequestError(code, f"{field}: {first['msg']}" if field else str(first["msg"]), field=field)


class Place(_Message):
    position: Position
    yaw: float = 0.0


class SceneDescription(_Message):
    """What a client needs to know of a scene; `corners` is the floor plan, counter-clockwise.

    `listener` and `emitter` are where to put a visitor and what he hears first.
    """

    id: str
    name: str
    description: str
    sample_rate: int
    ir_samples: int
    channels: tuple[str, ...]
    speed_of_sound: float
    bounds: Bounds
    corners: tuple[tuple[float, float], ...]
    height_m: float
    openings: tuple[Opening, ...]
    listener: Place
    emitter: Place
    level: str
    levels: tuple[QualityLevel, ...]


class Welcome(_Message):
    """Answer to a good hello. `window` is how many blocks may be unacknowledged before the server skips ahead."""

    type: Literal["welcome"] = "welcome"
    protocol: Literal[1] = PROTOCOL
    session: str
    scene: SceneDescription
    sample_rate: int
    block_size: int
    channels: int
    encoding: Encoding
    buffer_blocks: int
    window: int
    ir_samples: int
    level: str


class EmitterAdded(_Message):
    """The emitter's first IR is in effect: its clip begins at `sample_clock`, in the block that follows."""

    type: Literal["emitter_added"] = "emitter_added"
    id: str
    sample_clock: int


class EmitterRemoved(_Message):
    type: Literal["emitter_removed"] = "emitter_removed"
    id: str


class Durations(_Message):
    """Milliseconds over the last second; None where nothing happened in it."""

    p50: float | None
    p99: float | None


class Status(_Message):
    """Once a second. Counts run from the start of the stream; `buffer_ms` is how far ahead of real time it is."""

    type: Literal["status"] = "status"
    sample_clock: int
    blocks_sent: int
    blocks_late: int
    blocks_dropped: int
    unacknowledged: int
    buffer_ms: float
    render_ms: Durations
    ir_ms: Durations
    ir_exchanges: int


class Pong(_Message):
    type: Literal["pong"] = "pong"
    id: int


class Error(_Message):
    """What was wrong with a message; the stream goes on unless it was the hello."""

    type: Literal["error"] = "error"
    code: str
    message: str
    field: str | None = None

    @classmethod
    def from_refusal(cls, refusal: RequestError) -> Self:
        return cls(code=refusal.code, message=str(refusal), field=refusal.field)


ServerMessage = Welcome | EmitterAdded | EmitterRemoved | Status | Pong | Error
_SERVER: TypeAdapter[ServerMessage] = TypeAdapter(Annotated[ServerMessage, Field(discriminator="type")])


def parse_server_message(data: str) -> ServerMessage:
    """A text message as a client receives it; raises pydantic.ValidationError."""
    return _SERVER.validate_json(data)


@dataclass(frozen=True)
class AudioBlock:
    """One block of audio: `samples` (channel, frame) float32.

    `sequence` counts blocks sent and has no gaps; `sample_clock` is the clock of the first frame and jumps over blocks
    the server skipped. `pose_id` is the newest pose whose IRs are all in effect; with `is_exchange` this block fades to
    them.
    """

    sequence: int
    sample_clock: int
    pose_id: int
    samples: FloatArray
    is_exchange: bool = False
    is_late: bool = False

    KIND: ClassVar[int] = 1
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBHIQII")
    HEADER_BYTES: ClassVar[int] = _LAYOUT.size
    _EXCHANGE: ClassVar[int] = 1
    _LATE: ClassVar[int] = 2

    def serialize(self, encoding: Encoding) -> bytes:
        """24-byte header, then the frames with their channels interleaved."""
        channels, frames = self.samples.shape
        flags = self._EXCHANGE * self.is_exchange | self._LATE * self.is_late
        header = self._LAYOUT.pack(
            self.KIND, flags, channels, self.sequence % 2**32, self.sample_clock, self.pose_id, frames
        )
        interleaved = self.samples.T
        if encoding == "s16":
            return header + np.rint(np.clip(interleaved, -1, 1) * 32767).astype("<i2").tobytes()
        return header + interleaved.astype("<f4").tobytes()

    @classmethod
    def parse(cls, data: bytes, encoding: Encoding) -> Self:
        """Raises ValueError for anything but a whole audio block."""
        if len(data) < cls.HEADER_BYTES or data[0] != cls.KIND:
            raise ValueError("not an audio block")
        _, flags, channels, sequence, sample_clock, pose_id, frames = cls._LAYOUT.unpack_from(data)
        dtype, scale = ("<i2", 32767) if encoding == "s16" else ("<f4", 1)
        interleaved = np.frombuffer(data, dtype, offset=cls.HEADER_BYTES)
        if interleaved.size != frames * channels:
            raise ValueError(f"an audio block of {frames} frames holds {interleaved.size} samples")
        samples = np.ascontiguousarray(interleaved.reshape(frames, channels).T.astype(np.float32) / np.float32(scale))
        return cls(sequence, sample_clock, pose_id, samples, bool(flags & cls._EXCHANGE), bool(flags & cls._LATE))
