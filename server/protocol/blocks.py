"""Audio on the wire of /v1/stream: rendered blocks from the server, dry mono blocks of live emitters from the client.

Both are binary messages, little endian, at the scene's sample rate, with full scale at 1. The first byte is the kind.
How samples are encoded, `server.protocol.codecs` says.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from server.core.errors import RequestError
from server.protocol.codecs.codec import FloatArray
from server.protocol.codecs.registry import CODECS, Encoding
from server.protocol.layout import Layout


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
        ("channels", "H", "2 for headphones, 1 for a mono output, 4, 9 or 16 for ambisonics"),
        ("sequence", "I", "number of the block among those sent, from 0, without gaps, modulo 2^32"),
        ("sample_clock", "Q", "samples from the start of the stream to the first frame"),
        ("pose_id", "I", "newest pose of the direct sound"),
        ("reverberation_pose_id", "I", "newest pose of the reflected field"),
        ("frames", "I", "samples of each channel"),
        then="the frames, channels interleaved (left, right, or in ACN order), in the encoding of the hello",
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
        return header + CODECS[encoding].encode(self.samples.T)

    @classmethod
    def parse(cls, data: bytes, encoding: Encoding) -> Self:
        """Read a block from bytes. Raises ValueError unless they are one whole audio block."""
        if len(data) < cls.HEADER_BYTES or data[0] != cls.KIND:
            raise ValueError("not an audio block")
        _, flags, channels, sequence, sample_clock, pose_id, reverberation_pose_id, frames = cls.LAYOUT.unpack_from(
            data
        )
        interleaved = CODECS[encoding].decode(data, cls.HEADER_BYTES)
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
    _ENCODINGS: ClassVar[tuple[Encoding, ...]] = tuple(CODECS)
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
            known = " nor ".join(f"{code} ({name})" for code, name in enumerate(cls._ENCODINGS))
            raise _malformed(f"encoding {encoding} is neither {known}", "encoding")
        if id_bytes > cls._LONGEST_ID:
            raise _malformed(f"an id has at most {cls._LONGEST_ID} bytes, not {id_bytes}", "id")
        start = cls.LAYOUT.size + id_bytes
        try:
            identifier = data[cls.LAYOUT.size : start].decode()
        except UnicodeDecodeError as exc:
            # guard: an id is text
            raise _malformed("the id is not UTF-8", "id") from exc
        start += -id_bytes % 4
        codec = CODECS[cls._ENCODINGS[encoding]]
        size = frames * codec.bytes_per_sample
        # guard: a block is as long as it says
        if frames == 0 or len(data) != start + size:
            raise _malformed(f"{frames} frames are {size} bytes, not {max(0, len(data) - start)}", "frames")
        return cls(identifier, sequence, codec.decode(data, start))

    def serialize(self, encoding: Encoding) -> bytes:
        identifier = self.id.encode()
        header = self.LAYOUT.pack(
            self.KIND, self._ENCODINGS.index(encoding), len(identifier), self.sequence, self.samples.size
        )
        return header + identifier + bytes(-len(identifier) % 4) + CODECS[encoding].encode(self.samples)


def _malformed(problem: str, field: str) -> RequestError:
    return RequestError("malformed_block", f"{field}: {problem}", field=field)
