"""Bytes of the stream: poses and dry blocks to the server, audio blocks from it. Little endian, full scale at 1.

The server's reference page on the live stream has every byte.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from nafir_client.errors import ProtocolError
from nafir_client.pose import Pose

Samples = npt.NDArray[np.float32]
Encoding = Literal["f32", "s16"]

PROTOCOL: Final = 3
BLOCK_KIND, POSE_KIND, DRY_KIND = 1, 2, 3
BLOCK: Final = struct.Struct("<BBHIQIII")
"""Kind, flags, channels, sequence, sample clock, pose ids of the direct sound and of the reflected field, frames."""
POSE: Final = struct.Struct("<B3xI7f")
"""Kind, pose id, position, orientation."""
DRY: Final = struct.Struct("<BBHII")
"""Kind, encoding, bytes of the id, sequence, frames; then the id, filled up to four bytes, and the samples."""
EXCHANGE, LATE, LIMITED = 1, 2, 4
"""Flags of an audio block."""
ENCODINGS: Final = ("f32", "s16")
"""In the order of their numbers in dry blocks."""
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
    fades to it. The server sent the block too late where `is_late`, and turned it down where `is_limited`.
    `arrived_s` is when it arrived, by `time.monotonic`.
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

    @property
    def frames(self) -> int:
        return len(self.samples)


def _from_f32(data: bytes, offset: int) -> Samples:
    return np.frombuffer(data, "<f4", offset=offset).astype(np.float32)


def _from_s16(data: bytes, offset: int) -> Samples:
    return np.frombuffer(data, "<i2", offset=offset).astype(np.float32) / np.float32(_FULL_SCALE)


_DECODERS: Final[Mapping[str, Callable[[bytes, int], Samples]]] = {"f32": _from_f32, "s16": _from_s16}


def parse_block(data: bytes, encoding: str, arrived_s: float, clock_offset: int = 0) -> Block:
    """Read a block, and add to its clock. Raises ProtocolError unless the bytes are one whole block."""
    if len(data) < BLOCK.size:
        raise ProtocolError(f"an audio block has at least {BLOCK.size} bytes, not {len(data)}")
    _, flags, channels, sequence, clock, pose, reverberation_pose, frames = BLOCK.unpack_from(data)
    try:
        samples = _DECODERS[encoding](data, BLOCK.size).reshape(frames, channels)
    except ValueError as exc:
        raise ProtocolError(f"an audio block of {frames} frames has {len(data)} bytes") from exc
    is_exchange, is_late, is_limited = (bool(flags & bit) for bit in (EXCHANGE, LATE, LIMITED))
    clock += clock_offset
    return Block(sequence, clock, pose, reverberation_pose, samples, is_exchange, is_late, is_limited, arrived_s)


def pose_bytes(pose: Pose, pose_id: int) -> bytes:
    return POSE.pack(POSE_KIND, pose_id, *pose.position, *pose.orientation)


def dry_bytes(emitter: str, sequence: int, samples: Samples, encoding: Encoding) -> bytes:
    """The next samples (n,) of a live emitter, n at least 1. Samples that are no numbers become silence."""
    identifier = emitter.encode()
    header = DRY.pack(DRY_KIND, ENCODINGS.index(encoding), len(identifier), sequence, len(samples))
    samples = np.nan_to_num(samples, nan=0.0, posinf=0.0, neginf=0.0)
    if encoding == "s16":
        body = np.rint(np.clip(samples, -1, 1) * _FULL_SCALE).astype("<i2").tobytes()
    else:
        body = samples.astype("<f4").tobytes()
    return header + identifier + bytes(-len(identifier) % 4) + body
