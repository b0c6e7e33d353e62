"""Blocks in Opus: an encoder for the blocks of a stream, its counterpart for clients, and a decoder of live input.

Frames of Opus last 5, 10 or 20 ms, and blocks have 128 to 1,024 samples, so a frame is not a block. The encoder keeps
the samples that do not fill a frame yet, and a block holds the packets that its samples have completed.

What is decoded lies `look_ahead` samples behind what was encoded. Blocks count that in: their `sample_clock` and
`frames` say what is heard. Where the clock jumps, since the server skipped blocks, the encoder begins anew; what it had
not given out by then (less than a frame and the look-ahead) is lost with the skipped blocks.
"""

from collections import OrderedDict
from typing import Final

import numpy as np

from server.core.errors import RequestError
from server.protocol.blocks import AudioBlock, DryBlock, DryPackets, Packets, malformed_block
from server.protocol.codecs.codec import FloatArray
from server.protocol.codecs.libopus import OpusDecoder, OpusEncoder, OpusError
from server.protocol.codecs.registry import is_of_samples, require_encoding
from server.protocol.opus import OpusOptions, OpusStreams, channels_of_streams
from server.protocol.server_messages import Welcome

LONGEST_LIVE_S: Final = 0.06
"""The most that one dry block may hold."""
_CONCEALED_S: Final = 0.12
"""The most that is guessed at once in place of lost blocks. After that a guess is silence or noise."""
_SHORTEST_S: Final = 0.0025
"""What is guessed is a multiple of this."""


class BlockEncoder:
    """Encodes the blocks of one stream. One thread uses it at a time. Raises OpusMissingError."""

    def __init__(self, options: OpusOptions, *, channels: int, sample_rate: int) -> None:
        self._encoders = [
            OpusEncoder(
                sample_rate=sample_rate,
                channels=count,
                application=options.application,
                signal=options.signal,
                bitrate=options.bitrate * count // 2,
                complexity=options.complexity,
            )
            for count in channels_of_streams(channels)
        ]
        self.streams = OpusStreams.of(
            options, channels=channels, sample_rate=sample_rate, look_ahead=self._encoders[0].look_ahead
        )
        self._frames = [np.zeros((self.streams.frame_samples, count), np.float32) for count in self.streams.streams]
        self._filled = 0
        """Samples in `_frames`."""
        self._next_clock: int | None = None
        """Clock of the next sample to come in; None before the first."""
        self._heard_clock = 0
        """Clock of the next sample to be heard."""
        self._unheard = 0
        """Samples still to be dropped by the client."""

    def encode(self, sample_clock: int, samples: FloatArray) -> Packets:
        """The packets that the next samples (channel, frame) complete."""
        is_restart = sample_clock != self._next_clock
        if is_restart:
            self._restart(sample_clock)
        self._next_clock = sample_clock + samples.shape[1]
        packets = self._fill(samples)
        decoded = len(packets) // len(self._encoders) * self.streams.frame_samples
        dropped = min(decoded, self._unheard)
        heard_from, frames = self._heard_clock, decoded - dropped
        self._unheard -= dropped
        self._heard_clock += frames
        return Packets(heard_from, frames, tuple(packets), is_restart)

    def _restart(self, sample_clock: int) -> None:
        for encoder in self._encoders:
            encoder.reset()
        self._filled = 0
        self._heard_clock, self._unheard = sample_clock, self.streams.look_ahead

    def _fill(self, samples: FloatArray) -> list[bytes]:
        packets = []
        size, start = self.streams.frame_samples, 0
        while start < samples.shape[1]:
            count = min(size - self._filled, samples.shape[1] - start)
            channel = 0
            for frame in self._frames:
                piece = samples[channel : channel + frame.shape[1], start : start + count]
                frame[self._filled : self._filled + count] = piece.T
                channel += frame.shape[1]
            self._filled += count
            start += count
            if self._filled == size:
                self._filled = 0
                packets += [encoder.encode(frame) for encoder, frame in zip(self._encoders, self._frames, strict=True)]
        return packets


class BlockReader:
    """Reads the audio blocks of a stream as a client does, in order, whatever their encoding. Raises OpusMissingError
    for a stream in Opus without libopus."""

    def __init__(self, welcome: Welcome) -> None:
        self._encoding = welcome.encoding
        self._opus = welcome.opus
        self._unheard = 0
        streams = () if self._opus is None else self._opus.streams
        self._decoders = [OpusDecoder(sample_rate=welcome.sample_rate, channels=count) for count in streams]

    def read(self, data: bytes) -> AudioBlock:
        """Raises ValueError, or OpusError for a packet that is none."""
        if is_of_samples(self._encoding):
            return AudioBlock.parse(data, self._encoding)
        block, packets = AudioBlock.parse_packets(data)
        frames = block.samples.shape[1]
        if block.is_restart and self._opus is not None:
            self._unheard = self._opus.look_ahead
            for decoder in self._decoders:
                decoder.reset()
        decoded = [self._decoders[number % len(self._decoders)].decode(each) for number, each in enumerate(packets)]
        channels = [
            np.concatenate([np.zeros((0, count), np.float32), *decoded[number :: len(self._decoders)]])
            for number, count in enumerate(() if self._opus is None else self._opus.streams)
        ]
        samples = np.concatenate(channels, axis=1).T
        dropped = min(samples.shape[1], self._unheard)
        self._unheard -= dropped
        block.samples = np.ascontiguousarray(samples[:, dropped:])
        if block.samples.shape[1] != frames:
            raise ValueError(f"an audio block of {frames} frames decodes to {block.samples.shape[1]}")
        return block


class LiveDecoder:
    """Decodes the packets of one live emitter, in order, and fills in what was lost.

    What it guesses comes to at most as much as what it has decoded, so that a client that leaves out numbers makes no
    more work than one that sends the blocks.
    """

    def __init__(self, sample_rate: int) -> None:
        self._decoder = OpusDecoder(sample_rate=sample_rate, channels=1)
        self._longest = round(LONGEST_LIVE_S * sample_rate)
        self._most_concealed = round(_CONCEALED_S * sample_rate)
        self._step = round(_SHORTEST_S * sample_rate)
        self._newest: int | None = None
        self._credit = 0
        """Samples that may be guessed."""

    def decode(self, block: DryPackets) -> DryBlock:
        """The samples of a block, and before them those of blocks that were lost. Raises RequestError malformed_block,
        and stale_block for one that is not newer than those before."""
        newest = block.sequence - 1 if self._newest is None else self._newest
        if block.sequence <= newest:
            problem = f"block {block.sequence} of emitter {block.id!r} is not newer than {newest}"
            raise RequestError("stale_block", problem, field="sequence")
        lengths = self._lengths(block)
        lost = min((block.sequence - newest - 1) * block.frames, self._credit)
        try:
            pieces = self._fill_in(lost - lost % self._step, lengths[0], block.packets[0])
            concealed = sum(len(piece) for piece in pieces)
            pieces += [self._decoder.decode(packet) for packet in block.packets]
        except OpusError as exc:
            # guard: packets that are none are refused by code
            raise malformed_block(str(exc), "packets") from exc
        self._newest = block.sequence
        self._credit = min(self._credit - concealed + block.frames, self._most_concealed)
        return DryBlock(block.id, block.sequence, np.concatenate(pieces)[:, 0], concealed)

    def _lengths(self, block: DryPackets) -> list[int]:
        """The number of samples in each packet, by its own header. Raises RequestError malformed_block if a packet is
        damaged, or if their sum is not that of the block or too large."""
        try:
            lengths = [self._decoder.frames(packet) for packet in block.packets]
        except OpusError as exc:
            raise malformed_block(str(exc), "packets") from exc
        # guard: packets are as long as their block says
        if sum(lengths) != block.frames:
            raise malformed_block(f"the packets last {sum(lengths)} samples, not {block.frames}", "frames")
        # guard: a block does not take long to decode
        if block.frames > self._longest:
            problem = f"the packets of a block last at most {self._longest} samples, not {block.frames}"
            raise malformed_block(problem, "frames")
        return lengths

    def _fill_in(self, lost: int, first: int, packet: bytes) -> list[FloatArray]:
        """Samples in place of `lost` ones before `packet`, which has `first` samples. It may hold a copy of the packet
        before it (forward error correction), from which at most `first` of them are recovered. Earlier ones are
        guessed."""
        recovered = min(lost, first)
        guessed = [self._decoder.conceal(lost - recovered)] if lost > recovered else []
        return [*guessed, self._decoder.recover(packet, recovered)] if recovered else guessed


class LiveDecoders:
    """A decoder for each live emitter of one stream that is sent Opus, `most` at most: the one that has been idle for
    longest gives way."""

    def __init__(self, sample_rate: int, most: int) -> None:
        self._sample_rate = sample_rate
        self._most = most
        self._decoders: OrderedDict[str, LiveDecoder] = OrderedDict()

    def decode(self, block: DryPackets) -> DryBlock:
        """Raises RequestError unsupported_encoding, malformed_block or stale_block."""
        decoder = self._decoders.get(block.id)
        if decoder is None:
            require_encoding("opus", self._sample_rate)
            decoder = self._decoders[block.id] = LiveDecoder(self._sample_rate)
            if len(self._decoders) > self._most:
                self._decoders.popitem(last=False)
        self._decoders.move_to_end(block.id)
        return decoder.decode(block)

    def forget(self, identifier: str) -> None:
        """Forget the decoder of an emitter that is removed."""
        self._decoders.pop(identifier, None)
