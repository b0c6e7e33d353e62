"""Bytes of the stream: poses and dry blocks to the server, audio blocks from it. Little endian, full scale at 1.

The server's reference page on the live stream has every byte.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, Protocol

import numpy as np
import numpy.typing as npt

from nafir_client.errors import ProtocolError
from nafir_client.pose import Pose

Samples = npt.NDArray[np.float32]
SampleEncoding = Literal["f32", "s16"]
Encoding = Literal[SampleEncoding, "opus"]

PROTOCOL: Final = 3
BLOCK_KIND, POSE_KIND, DRY_KIND = 1, 2, 3
BLOCK: Final = struct.Struct("<BBBBIQIII")
"""Kind, flags, channels, number of the listener, sequence, sample clock, pose ids of the direct sound and of the
reflected field, frames."""
POSE: Final = struct.Struct("<BBxxI7f")
"""Kind, number of the listener, pose id, position, orientation."""
DRY: Final = struct.Struct("<BBHII")
"""Kind, encoding, bytes of the id, sequence, frames; then the id, filled up to four bytes, and the samples."""
EXCHANGE, LATE, LIMITED, RESTART = 1, 2, 4, 8
"""Flags of an audio block."""
ENCODINGS: Final = ("f32", "s16")
"""Those of single samples, in the order of their numbers in dry blocks."""
OPUS_NUMBER: Final = 2
"""That of Opus there."""
EFFECTS: Final = (
    "direct_path",
    "distance_attenuation",
    "propagation_delay",
    "air_absorption",
    "occlusion",
    "directivity",
    "hrtf",
    "early_reflections",
    "late_reverberation",
    "diffraction",
    "per_source_tail",
    "head_rotation",
)
"""Every effect that can be switched on or off."""
_FULL_SCALE = 32767


@dataclass(frozen=True, slots=True)
class Block:
    """Rendered audio: `samples` (frame, channel).

    `sample_clock` is the clock of the first frame. It jumps over blocks that the server skipped. `pose_id` is the
    newest pose of the direct sound, `reverberation_pose_id` that of the reflected field; with `is_exchange` this block
    fades to it. The server sent the block too late where `is_late`, and turned it down where `is_limited`. A block in
    Opus may have no frames. `arrived_s` is when it arrived, by `time.monotonic`. `listener` is the number of the
    listener in the stream, 0 for its first.
    """

    sequence: int
    sample_clock: int
    pose_id: int
    reverberation_pose_id: int
    samples: Samples
    is_exchange: bool
    is_late: bool
    is_limited: bool
    arrived_s: float
    listener: int = 0

    @property
    def frames(self) -> int:
        return len(self.samples)


def _from_f32(data: bytes, offset: int) -> Samples:
    return np.frombuffer(data, "<f4", offset=offset).astype(np.float32)


def _from_s16(data: bytes, offset: int) -> Samples:
    return np.frombuffer(data, "<i2", offset=offset).astype(np.float32) / np.float32(_FULL_SCALE)


_DECODERS: Final[Mapping[str, Callable[[bytes, int], Samples]]] = {"f32": _from_f32, "s16": _from_s16}


def parse_block(data: bytes, encoding: str, arrived_s: float, clock_offset: int = 0) -> Block:
    """Read a block of an encoding of single samples, and add to its clock. Raises ProtocolError unless the bytes are
    one whole block."""
    block, channels, frames = _parse_header(data, arrived_s, clock_offset)
    try:
        samples = _DECODERS[encoding](data, BLOCK.size).reshape(frames, channels)
    except ValueError as exc:
        raise ProtocolError(f"an audio block of {frames} frames has {len(data)} bytes") from exc
    return replace(block, samples=samples)


class PacketReader(Protocol):
    """Decodes packets from a byte of a block on to samples (frame, channel). Raises ProtocolError."""

    def read(self, data: bytes, offset: int, *, is_restart: bool) -> Samples: ...


def parse_packets(data: bytes, reader: PacketReader, arrived_s: float, clock_offset: int = 0) -> Block:
    """Read a block that holds packets, the next of a stream. Raises ProtocolError."""
    block, channels, frames = _parse_header(data, arrived_s, clock_offset)
    samples = reader.read(data, BLOCK.size, is_restart=bool(data[1] & RESTART))
    if samples.shape != (frames, channels):
        raise ProtocolError(f"an audio block of {frames} frames decodes to {len(samples)}")
    return replace(block, samples=samples)


def listener_of(data: bytes) -> int:
    """The number of the listener whose block this is. Raises ProtocolError."""
    _require_header(data)
    return data[3]


def _require_header(data: bytes) -> None:
    if len(data) < BLOCK.size:
        raise ProtocolError(f"an audio block has at least {BLOCK.size} bytes, not {len(data)}")


def _parse_header(data: bytes, arrived_s: float, clock_offset: int) -> tuple[Block, int, int]:
    """A block without its samples, and how many channels and frames it has."""
    _require_header(data)
    _, flags, channels, listener, sequence, clock, pose, reverberation_pose, frames = BLOCK.unpack_from(data)
    is_exchange, is_late, is_limited = (bool(flags & bit) for bit in (EXCHANGE, LATE, LIMITED))
    clock += clock_offset
    silence = np.zeros((0, channels), np.float32)
    flags_set = is_exchange, is_late, is_limited
    block = Block(sequence, clock, pose, reverberation_pose, silence, *flags_set, arrived_s, listener)
    return block, channels, frames


def pose_bytes(pose: Pose, pose_id: int, listener: int = 0) -> bytes:
    """A pose of the listener with this number, 0 for the first."""
    return POSE.pack(POSE_KIND, listener, pose_id, *pose.position, *pose.orientation)


def dry_bytes(emitter: str, sequence: int, samples: Samples, encoding: SampleEncoding) -> bytes:
    """The next samples (n,) of a live emitter, n at least 1. Samples that are no numbers become silence."""
    samples = np.nan_to_num(samples, nan=0.0, posinf=0.0, neginf=0.0)
    if encoding == "s16":
        body = np.rint(np.clip(samples, -1, 1) * _FULL_SCALE).astype("<i2").tobytes()
    else:
        body = samples.astype("<f4").tobytes()
    return _dry_header(emitter, sequence, len(samples), ENCODINGS.index(encoding)) + body


def dry_packet_bytes(emitter: str, sequence: int, frames: int, packet: bytes) -> bytes:
    """The next samples of a live emitter as a packet of Opus that decodes to so many frames."""
    return _dry_header(emitter, sequence, frames, OPUS_NUMBER) + len(packet).to_bytes(2, "little") + packet


def _dry_header(emitter: str, sequence: int, frames: int, encoding: int) -> bytes:
    identifier = emitter.encode()
    header = DRY.pack(DRY_KIND, encoding, len(identifier), sequence, frames)
    return header + identifier + bytes(-len(identifier) % 4)
