"""Every encoding of a stream.

Encodings of single samples are in `CODECS`. Opus has frames and state of its own: `server.protocol.packets`.
"""

from collections.abc import Mapping
from typing import Final, Literal, TypeGuard

from server.core.errors import RequestError
from server.protocol.codecs import libopus
from server.protocol.codecs.codec import Codec
from server.protocol.codecs.f32 import F32
from server.protocol.codecs.s16 import S16

SampleEncoding = Literal["f32", "s16"]
Encoding = Literal[SampleEncoding, "opus"]

CODECS: Final[Mapping[SampleEncoding, Codec]] = {
    "f32": F32,
    "s16": S16,
}
NUMBERS: Final[Mapping[Encoding, int]] = {
    "f32": 0,
    "s16": 1,
    "opus": 2,
}
"""The number of each encoding in a dry block. They are on the wire: none is ever given to another."""

OPUS_MEANING: Final = "packets of Opus (RFC 6716)"


def is_of_samples(encoding: Encoding) -> TypeGuard[SampleEncoding]:
    """Whether an encoding has the same number of bytes for each sample."""
    return encoding in CODECS


def require_encoding(encoding: Encoding, sample_rate: int) -> None:
    """Raise RequestError unsupported_encoding unless this server has the encoding at a sample rate."""
    if is_of_samples(encoding):
        return
    others = " or ".join(CODECS)
    if not libopus.is_available():
        problem = f"encoding: this server has no Opus (libopus is not installed); use {others}"
        raise RequestError("unsupported_encoding", problem, field="encoding", status=501)
    if sample_rate not in libopus.RATES:
        rates = ", ".join(f"{rate:,}" for rate in libopus.RATES)
        problem = f"encoding: Opus is for {rates} Hz, not for {sample_rate:,} Hz; use {others}, or another rate"
        raise RequestError("unsupported_encoding", problem, field="encoding")
