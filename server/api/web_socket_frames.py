"""Reading and writing of WebSocket frames (RFC 6455, 5.2) that are whole messages."""

import struct
import sys
from typing import Final, NamedTuple

try:
    from websockets.speedups import apply_mask
except ImportError:  # the library was built without a compiler
    from websockets.utils import apply_mask

_WHOLE_TEXT, _WHOLE_BINARY = 0x81, 0x82
_FINAL, _MASKED, _CONTROL = 0x80, 0x80, 0x08
_SHORT, _LONG = 126, 127
"""Values of the length field that say that the length follows in two or in eight bytes."""
_SHORTEST_HEADER: Final = 2
_KEY_BYTES: Final = 4


def header(length: int) -> bytes:
    """Header of a server's binary message of `length` bytes."""
    if length < _SHORT:
        return struct.pack(">BB", _WHOLE_BINARY, length)
    if length < 1 << 16:
        return struct.pack(">BBH", _WHOLE_BINARY, _SHORT, length)
    return struct.pack(">BBQ", _WHOLE_BINARY, _LONG, length)


class ReceivedFrame(NamedTuple):
    """Received bytes, and the message in them if they are exactly one whole message."""

    raw: bytes
    message: bytes | None = None
    is_text: bool = False
    frames: int = 1
    """Number of frames that begin in these bytes."""


class FrameSplitter:
    """Splits the bytes of one client, after the handshake, into whole messages and other frames.

    All bytes come out again in order, in `raw`. An incomplete header, or an incomplete message of less than 126 bytes,
    waits for the rest. Nothing is checked here. A parser handles everything that is not a whole message of at most
    `longest` bytes, masked and without extension bits.
    """

    def __init__(self, longest: int) -> None:
        self._longest = longest
        self._begun = b""
        self._to_come = 0
        """Bytes still missing from a frame that is passed on in parts."""
        self._is_fragmented = False
        """Whether more frames of the same message follow."""
        self.has_more = False
        """Whether whole frames may wait here, because the last call reached its limit."""

    def keep(self, data: bytes) -> None:
        """Keep bytes for the next call of `split`."""
        self._begun += data
        self.has_more = True

    def split(self, data: bytes = b"", *, most: int = sys.maxsize) -> list[ReceivedFrame]:
        """Split kept bytes and `data` into at most `most` frames. Further frames are kept for the next call."""
        data = self._begun + data
        end = len(data)
        found = []
        passed, at = 0, min(self._to_come, end)
        self._to_come -= at
        others = 0  # frames from `passed` on, none of which is a whole message
        while most > 0 and end - at >= _SHORTEST_HEADER:
            first, second = data[at], data[at + 1]
            length, start = second & ~_MASKED, at + _SHORTEST_HEADER
            if is_long := length >= _SHORT:
                start += 2 if length == _SHORT else 8
                length = int.from_bytes(data[at + _SHORTEST_HEADER : start])
            start += _KEY_BYTES if second >= _MASKED else 0
            past = start + length
            is_message = first in (_WHOLE_TEXT, _WHOLE_BINARY) and second >= _MASKED and not self._is_fragmented
            is_message = is_message and length <= self._longest
            if start > end or (past > end and is_message and not is_long):
                break
            if is_message and past <= end:
                if at > passed:
                    found.append(ReceivedFrame(data[passed:at], frames=others))
                message = apply_mask(data[start:past], data[start - _KEY_BYTES : start])
                found.append(ReceivedFrame(data[at:past], message, first == _WHOLE_TEXT))
                passed, others = past, 0
            else:
                others += 1
                if not first & _CONTROL:
                    self._is_fragmented = not first & _FINAL
            most -= 1
            at = min(past, end)
            self._to_come = past - at
        self._begun = data[at:]
        self.has_more = most == 0 and at < end
        if at > passed:
            found.append(ReceivedFrame(data[passed:at], frames=others))
        return found
