"""Messages about Opus: what a client asks for in its hello, and what the welcome says of it."""

from typing import Annotated, Literal, Self

from pydantic import Field

from server.protocol.message import WHOLE, Message


def channels_of_streams(channels: int) -> tuple[int, ...]:
    """The channels of each Opus stream that carries so many: pairs, and one alone where the number is odd. Opus's own
    mapping of many channels is unreliable in browsers."""
    return (2,) * (channels // 2) + (1,) * (channels % 2)


class OpusOptions(Message):
    """How the server encodes in Opus. A packet lasts `frame_ms`. `bitrate` is that of two channels, in bits per second;
    a single channel has half. A higher `complexity` costs more time and sounds slightly better. `low_delay` has a
    look-ahead of 2.5 ms, `audio` and `voip` of 6.5 ms; these have a mode for speech, which only helps below some
    40 kbit/s, and `voip` takes the lowest frequencies away. `signal` says what is to be heard, where that is known."""

    frame_ms: Annotated[Literal[5, 10, 20], WHOLE] = 10
    bitrate: Annotated[int, Field(ge=12_000, le=510_000), WHOLE] = 128_000
    complexity: Annotated[int, Field(ge=0, le=10), WHOLE] = 5
    application: Literal["low_delay", "audio", "voip"] = "low_delay"
    signal: Literal["auto", "voice", "music"] = "auto"


class OpusStreams(Message):
    """How blocks are encoded in Opus. `streams` has the number of channels of each Opus stream: pairs of the block's
    channels in their order, and the last one alone where their number is odd. Each packet decodes to `frame_samples`.
    The first `look_ahead` samples that decoders give from a block with `is_restart` on are to be dropped."""

    frame_samples: int
    look_ahead: int
    streams: tuple[int, ...]

    @classmethod
    def of(cls, options: OpusOptions, *, channels: int, sample_rate: int, look_ahead: int) -> Self:
        return cls(
            frame_samples=options.frame_ms * sample_rate // 1000,
            look_ahead=look_ahead,
            streams=channels_of_streams(channels),
        )
