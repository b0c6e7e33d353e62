"""Audio on the wire of /v1/stream: rendered blocks from the server, dry mono blocks of live emitters from the client.

Both are binary messages, little endian, at the stream's sample rate, with full scale at 1. The first byte is the kind.
How samples are encoded, `server.protocol.codecs` says. A block in Opus holds packets in place of samples:
`server.protocol.packets` makes and reads them.
"""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Final, Self

import numpy as np

from server.core.errors import RequestError
from server.protocol.codecs.codec import FloatArray
from server.protocol.codecs.registry import CODECS, NUMBERS, Encoding, SampleEncoding
from server.protocol.layout import Layout

_PACKET_LENGTH: Final = struct.Struct("<H")
_PACKETS: Final = "each after its length in bytes (u16)"


def join_packets(packets: Iterable[bytes]) -> bytes:
    """Packets one after the other, each after its length."""
    return b"".join(_PACKET_LENGTH.pack(len(packet)) + packet for packet in packets)


def split_packets(data: bytes, start: int) -> tuple[bytes, ...]:
    """The packets from byte `start` to the end. Raises ValueError for one that is empty or incomplete."""
    packets: list[bytes] = []
    while start < len(data):
        # guard: a packet is as long as it says
        if len(data) < start + _PACKET_LENGTH.size:
            raise ValueError("the length of the last packet is incomplete")
        (length,) = _PACKET_LENGTH.unpack_from(data, start)
        start += _PACKET_LENGTH.size
        # guard: a packet is all there
        if not 0 < length <= len(data) - start:
            raise ValueError(f"packet {len(packets)} has {length} bytes, of which {len(data) - start} are there")
        packets.append(data[start : start + length])
        start += length
    return tuple(packets)


@dataclass(frozen=True)
class Packets:
    """What a block in Opus holds in place of samples: packets, which decode to `frames` samples of each channel that
    are heard, from `sample_clock` on. With `is_restart` decoders begin anew with them."""

    sample_clock: int
    frames: int
    packets: tuple[bytes, ...]
    is_restart: bool = False


@dataclass(slots=True)
class AudioBlock:
    """One block of rendered audio: `samples` (channel, frame).

    `sequence` counts the blocks sent and has no gaps. `sample_clock` is the clock of the first frame; it jumps over
    blocks that the server skipped. `pose_id` is the newest pose that the direct sound of this block moves to.
    `reverberation_pose_id` is the newest pose whose impulse responses are all in effect; with `is_exchange` this block
    fades to them. With `is_late` the block was sent after a player with `buffer_blocks` in reserve had run out of
    audio. With `is_limited` the block would have been too loud and was turned down. `listener` is the number of the
    listener who hears it: 0 for the first. Each has a sequence of its own, and all have one clock.

    In Opus a block holds the packets that its samples have completed: none, one or several for each of the streams that
    `welcome.opus` lists. What they decode to is heard from `sample_clock` on, as samples are, and `frames` counts it.
    It was rendered up to a packet and the look-ahead earlier than what poses and flags tell of. With `is_restart` (the
    first block of a stream, and the first after skipped ones) decoders begin anew, and the first `look_ahead` samples
    that they give are not part of the sound: drop them.
    """

    sequence: int
    sample_clock: int
    pose_id: int
    reverberation_pose_id: int
    samples: FloatArray
    is_exchange: bool = False
    is_late: bool = False
    is_limited: bool = False
    is_restart: bool = False
    listener: int = 0

    type: ClassVar[str] = "audio_block"
    KIND: ClassVar[int] = 1
    FLAGS: ClassVar[Mapping[str, int]] = {"is_exchange": 1, "is_late": 2, "is_limited": 4, "is_restart": 8}
    # guard: the sample clock has 64 bits
    LAYOUT: ClassVar[Layout] = Layout(
        ("kind", "B", f"always {KIND}"),
        ("flags", "B", "sum of " + ", ".join(f"{bit} {name}" for name, bit in FLAGS.items())),
        ("channels", "B", "2 for headphones, 1 for a mono output, 4, 9 or 16 for ambisonics"),
        ("listener", "B", "number of the listener, 0 for the first"),
        ("sequence", "I", "number of the block among those sent to the listener, from 0, without gaps, modulo 2^32"),
        ("sample_clock", "Q", "samples from the start of the stream to the first frame that is heard"),
        ("pose_id", "I", "newest pose of the direct sound"),
        ("reverberation_pose_id", "I", "newest pose of the reflected field"),
        ("frames", "I", "samples of each channel that are heard"),
        then="the frames, channels interleaved (left, right, or in ACN order), in the encoding of the hello. In Opus: "
        f"packets, {_PACKETS}, in the order of time, and of one time in the order of `welcome.opus.streams`",
    )
    HEADER_BYTES: ClassVar[int] = LAYOUT.size

    def serialize(self, encoding: SampleEncoding) -> bytes:
        """The block as bytes: the header of LAYOUT, then the frames."""
        return self._header(self.samples.shape[1]) + CODECS[encoding].encode(self.samples.T)

    def serialize_packets(self, packets: Packets) -> bytes:
        """The block as bytes: the header of LAYOUT, then what an encoder made of this block and earlier ones."""
        heard = replace(self, sample_clock=packets.sample_clock, is_restart=packets.is_restart)
        return heard._header(packets.frames) + join_packets(packets.packets)

    def _header(self, frames: int) -> bytes:
        channels, flags = len(self.samples), 0
        for name, bit in self.FLAGS.items():
            if getattr(self, name):
                flags |= bit
        poses = self.pose_id, self.reverberation_pose_id
        whose = channels, self.listener
        # guard: sequences wrap round
        return self.LAYOUT.pack(self.KIND, flags, *whose, self.sequence % 2**32, self.sample_clock, *poses, frames)

    @classmethod
    def parse(cls, data: bytes, encoding: SampleEncoding) -> Self:
        """Read a block from bytes. Raises ValueError unless they are one whole audio block."""
        block = cls._parse_header(data)
        channels, frames = block.samples.shape
        interleaved = CODECS[encoding].decode(data, cls.HEADER_BYTES)
        if interleaved.size != frames * channels:
            raise ValueError(f"an audio block of {frames} frames holds {interleaved.size} samples")
        return replace(block, samples=np.ascontiguousarray(interleaved.reshape(frames, channels).T))

    @classmethod
    def parse_packets(cls, data: bytes) -> tuple[Self, tuple[bytes, ...]]:
        """Read a block in Opus from bytes: the block with silence for samples, and its packets. Raises ValueError
        unless they are one whole audio block."""
        return cls._parse_header(data), split_packets(data, cls.HEADER_BYTES)

    @classmethod
    def _parse_header(cls, data: bytes) -> Self:
        if len(data) < cls.HEADER_BYTES or data[0] != cls.KIND:
            raise ValueError("not an audio block")
        _, flags, channels, listener, sequence, sample_clock, *rest = cls.LAYOUT.unpack_from(data)
        pose_id, reverberation_pose_id, frames = rest
        return cls(
            sequence,
            sample_clock,
            pose_id,
            reverberation_pose_id,
            np.broadcast_to(np.float32(0), (channels, frames)),
            **{name: bool(flags & bit) for name, bit in cls.FLAGS.items()},
            listener=listener,
        )


@dataclass(frozen=True)
class DryBlock:
    """The next dry samples (n,), n >= 1, of the live emitter `id`. `sequence` rises from block to block.

    In Opus a dry block holds one or several packets, of 60 ms at most together, and `sequence` rises by one from block
    to block. A greater step says that blocks as long as this one were lost: the server fills in what it can, by what
    this block says of the one before it (in-band FEC) or by a guess.
    """

    id: str
    sequence: int
    samples: FloatArray
    concealed: int = 0
    """How many of the samples, at the beginning, were filled in for lost blocks; not on the wire."""

    type: ClassVar[str] = "dry_block"
    KIND: ClassVar[int] = 3
    _LONGEST_ID: ClassVar[int] = 256
    LAYOUT: ClassVar[Layout] = Layout(
        ("kind", "B", f"always {KIND}"),
        (
            "encoding",
            "B",
            "encoding of the frames: " + ", ".join(f"{number} {name}" for name, number in NUMBERS.items()),
        ),
        ("id_bytes", "H", f"length of the id, at most {_LONGEST_ID}"),
        ("sequence", "I", "greater than that of the emitter's previous block"),
        ("frames", "I", "samples, at least 1"),
        then="the id in UTF-8, padded with zeros to a multiple of four bytes, and the samples of one channel. In Opus: "
        f"packets of one channel, {_PACKETS}",
    )

    @classmethod
    def parse(cls, data: bytes) -> "Self | DryPackets":
        """Read a block from bytes. Raises RequestError malformed_block."""
        # guard: a dry block has a header
        if len(data) < cls.LAYOUT.size:
            raise malformed_block(f"a dry block begins with {cls.LAYOUT.size} bytes, not {len(data)}", "header")
        _, number, id_bytes, sequence, frames = cls.LAYOUT.unpack_from(data)
        encoding = next((name for name, each in NUMBERS.items() if each == number), None)
        # guard: a dry block is of a known encoding
        if encoding is None:
            known = " nor ".join(f"{each} ({name})" for name, each in NUMBERS.items())
            raise malformed_block(f"encoding {number} is neither {known}", "encoding")
        if id_bytes > cls._LONGEST_ID:
            raise malformed_block(f"an id has at most {cls._LONGEST_ID} bytes, not {id_bytes}", "id")
        start = cls.LAYOUT.size + id_bytes
        try:
            identifier = data[cls.LAYOUT.size : start].decode()
        except UnicodeDecodeError as exc:
            # guard: an id is text
            raise malformed_block("the id is not UTF-8", "id") from exc
        start += -id_bytes % 4
        if encoding == "opus":
            return DryPackets(identifier, sequence, frames, _dry_packets(data, start, frames))
        codec = CODECS[encoding]
        size = frames * codec.bytes_per_sample
        # guard: a block is as long as it says
        if frames == 0 or len(data) != start + size:
            raise malformed_block(f"{frames} frames are {size} bytes, not {max(0, len(data) - start)}", "frames")
        return cls(identifier, sequence, codec.decode(data, start))

    def serialize(self, encoding: SampleEncoding) -> bytes:
        return _dry_header(self.id, self.sequence, self.samples.size, encoding) + CODECS[encoding].encode(self.samples)


@dataclass(frozen=True)
class DryPackets:
    """A dry block in Opus: the next `packets` of the live emitter `id`, which decode to `frames` samples."""

    id: str
    sequence: int
    frames: int
    packets: tuple[bytes, ...]

    type: ClassVar[str] = DryBlock.type

    def serialize(self) -> bytes:
        return _dry_header(self.id, self.sequence, self.frames, "opus") + join_packets(self.packets)


def _dry_header(identifier: str, sequence: int, frames: int, encoding: Encoding) -> bytes:
    """The header of a dry block and its id."""
    name = identifier.encode()
    header = DryBlock.LAYOUT.pack(DryBlock.KIND, NUMBERS[encoding], len(name), sequence, frames)
    return header + name + bytes(-len(name) % 4)


def _dry_packets(data: bytes, start: int, frames: int) -> tuple[bytes, ...]:
    try:
        packets = split_packets(data, start)
    except ValueError as exc:
        raise malformed_block(str(exc), "packets") from exc
    # guard: a dry block in Opus has a packet
    if frames == 0 or not packets:
        raise malformed_block(f"{frames} frames are in {len(packets)} packets", "frames")
    return packets


def malformed_block(problem: str, field: str) -> RequestError:
    """The refusal of a dry block that is none."""
    return RequestError("malformed_block", f"{field}: {problem}", field=field)
