"""Audio on the wire of /v1/stream: rendered blocks from the server, dry mono blocks of live emitters from the client.

Both are binary messages, little endian, at the scene's sample rate, with full scale at 1. The first byte is the kind.
`f32` is IEEE 754 single precision, `s16` is two's complement with 32767 for full scale.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, Literal, Self

import numpy as np
import numpy.typing as npt

from server.core.errors import RequestError
from server.protocol.layout import Layout

FloatArray = npt.NDArray[np.float32]
Encoding = Literal["f32", "s16"]

_FULL_SCALE: Final = 32767


def _encode(samples: FloatArray, encoding: Encoding) -> bytes:
    """Bytes of the samples in C order."""
    if encoding == "s16":
        return np.rint(np.clip(samples, -1, 1) * _FULL_SCALE).astype("<i2").tobytes()
    return samples.astype("<f4", copy=False).tobytes()


def _decode(data: bytes, encoding: Encoding, offset: int) -> FloatArray:
    """(n,) samples from byte `offset` to the end. Raises ValueError if the last sample is incomplete."""
    if encoding == "s16":
        return np.frombuffer(data, "<i2", offset=offset).astype(np.float32) / np.float32(_FULL_SCALE)
    return np.frombuffer(data, "<f4", offset=offset).astype(np.float32)


@dataclass(slots=True)
class AudioBlock:
    """One block of rendered audio: `samples` (channel, frame).

    `sequence` counts the blocks sent and has no gaps. `sample_clock` is the clock of the first frame; it jumps over
    blocks that the server skipped. `pose_id` is the newest pose that the direct sound of this block moves to.
    `reverberation_pose_id` is the newest pose whose impulse responses are all in effect; with `is_exchange` this block
    fades to them. With `is_late` the block was sent after a player with `buffer_blocks` in reserve had run out of
    audio. With `is_limited` the block would have been too loud and was turned down.
    """

    sequence: int
    sample_clock: int
    pose_id: int
    reverberation_pose_id: int
    samples: FloatArray
    is_exchange: bool = False
    is_late: bool = False
    is_limited: bool = False

    type: ClassVar[str] = "audio_block"
    KIND: ClassVar[int] = 1
    FLAGS: ClassVar[Mapping[str, int]] = {"is_exchange": 1, "is_late": 2, "is_limited": 4}
    # guard: the sample clock has 64 bits
    LAYOUT: ClassVar[Layout] = Layout(
        ("kind", "B", f"always {KIND}"),
        ("flags", "B", "sum of " + ", ".join(f"{bit} {name}" for name, bit in FLAGS.items())),
        ("channels", "H", "2, or 1 for a mono output"),
        ("sequence", "I", "number of the block among those sent, from 0, without gaps, modulo 2^32"),
        ("sample_clock", "Q", "samples from the start of the stream to the first frame"),
        ("pose_id", "I", "newest pose of the direct sound"),
        ("reverberation_pose_id", "I", "newest pose of the reflected field"),
        ("frames", "I", "samples of each channel"),
        then="the frames, channels interleaved (left, right), in the encoding of the hello",
    )
    HEADER_BYTES: ClassVar[int] = LAYOUT.size

    def serialize(self, encoding: Encoding) -> bytes:
        """The block as bytes: the header of LAYOUT, then the frames."""
        channels, frames = self.samples.shape
        flags = 0
        for name, bit in self.FLAGS.items():
            if getattr(self, name):
                flags |= bit
        poses = self.pose_id, self.reverberation_pose_id
        # guard: sequences wrap round
        header = self.LAYOUT.pack(self.KIND, flags, channels, self.sequence % 2**32, self.sample_clock, *poses, frames)
        return header + _encode(self.samples.T, encoding)

    @classmethod
    def parse(cls, data: bytes, encoding: Encoding) -> Self:
        """Read a block from bytes. Raises ValueError unless they are one whole audio block."""
        if len(data) < cls.HEADER_BYTES or data[0] != cls.KIND:
            raise ValueError("not an audio block")
        _, flags, channels, sequence, sample_clock, pose_id, reverberation_pose_id, frames = cls.LAYOUT.unpack_from(
            data
        )
        interleaved = _decode(data, encoding, cls.HEADER_BYTES)
        if interleaved.size != frames * channels:
            raise ValueError(f"an audio block of {frames} frames holds {interleaved.size} samples")
        return cls(
            sequence,
            sample_clock,
            pose_id,
            reverberation_pose_id,
            np.ascontiguousarray(interleaved.reshape(frames, channels).T),
            **{name: bool(flags & bit) for name, bit in cls.FLAGS.items()},
        )


@dataclass(frozen=True)
class DryBlock:
    """The next dry samples (n,), n >= 1, of the live emitter `id`. `sequence` rises from block to block."""

    id: str
    sequence: int
    samples: FloatArray

    type: ClassVar[str] = "dry_block"
    KIND: ClassVar[int] = 3
    _ENCODINGS: ClassVar[tuple[Encoding, ...]] = ("f32", "s16")
    _LONGEST_ID: ClassVar[int] = 256
    LAYOUT: ClassVar[Layout] = Layout(
        ("kind", "B", f"always {KIND}"),
        (
            "encoding",
            "B",
            "encoding of the frames: " + ", ".join(f"{code} {name}" for code, name in enumerate(_ENCODINGS)),
        ),
        ("id_bytes", "H", f"length of the id, at most {_LONGEST_ID}"),
        ("sequence", "I", "greater than that of the emitter's previous block"),
        ("frames", "I", "samples, at least 1"),
        then="the id in UTF-8, padded with zeros to a multiple of four bytes, and the samples of one channel",
    )

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Read a block from bytes. Raises RequestError malformed_block."""
        # guard: a dry block has a header
        if len(data) < cls.LAYOUT.size:
            raise _malformed(f"a dry block begins with {cls.LAYOUT.size} bytes, not {len(data)}", "header")
        _, encoding, id_bytes, sequence, frames = cls.LAYOUT.unpack_from(data)
        # guard: a dry block is of a known encoding
        if encoding >= len(cls._ENCODINGS):
            raise _malformed(f"encoding {encoding} is neither 0 (f32) nor 1 (s16)", "encoding")
        if id_bytes > cls._LONGEST_ID:
            raise _malformed(f"an id has at most {cls._LONGEST_ID} bytes, not {id_bytes}", "id")
        start = cls.LAYOUT.size + id_bytes
        try:
            identifier = data[cls.LAYOUT.size : start].decode()
        except UnicodeDecodeError as exc:
            # guard: an id is text
            raise _malformed("the id is not UTF-8", "id") from exc
        start += -id_bytes % 4
        size = frames * (2 if cls._ENCODINGS[encoding] == "s16" else 4)
        # guard: a block is as long as it says
        if frames == 0 or len(data) != start + size:
            raise _malformed(f"{frames} frames are {size} bytes, not {max(0, len(data) - start)}", "frames")
        return cls(identifier, sequence, _decode(data, cls._ENCODINGS[encoding], start))

    def serialize(self, encoding: Encoding) -> bytes:
        identifier = self.id.encode()
        header = self.LAYOUT.pack(
            self.KIND, self._ENCODINGS.index(encoding), len(identifier), self.sequence, self.samples.size
        )
        return header + identifier + bytes(-len(identifier) % 4) + _encode(self.samples, encoding)


def _malformed(problem: str, field: str) -> RequestError:
    return RequestError("malformed_block", f"{field}: {problem}", field=field)
