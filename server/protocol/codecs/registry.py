"""Every encoding of a stream. The order is on the wire: a dry block says the number of its encoding. Append only."""

from collections.abc import Mapping
from typing import Final, Literal

from server.protocol.codecs.codec import Codec
from server.protocol.codecs.f32 import F32
from server.protocol.codecs.s16 import S16

Encoding = Literal["f32", "s16"]

CODECS: Final[Mapping[Encoding, Codec]] = {
    "f32": F32,
    "s16": S16,
}
