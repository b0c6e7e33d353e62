"""Frames of WebSocket messages as they lie on the wire (RFC 6455, 5.2), as far as messages come whole, in one frame."""

import struct
import sys
from typing import Final, NamedTuple

try:
    from websockets.speedups import apply_mask
except ImportError:  # as where the library is built without a compiler
    from websockets.utils import apply_mask

_WHOLE_TEXT, _WHOLE_BINARY = 0x81, 0x82
_FINAL, _MASKED, _CONTROL = 0x80, 0x80, 0x08
_SHORT, _LONG = 126, 127
"""Lengths that say that the length follows, in two bytes or in eight."""
_SHORTEST_HEADER: Final = 2
_KEY_BYTES: Final = 4


def header(length: int) -> bytes:
    """Of a whole binary message that a server sends, of so many bytes."""
    if length < _SHORT:
        return struct.pack(">BB", _WHOLE_BINARY, length)
    if length < 1 << 16:
        return struct.pack(">BBH", _WHOLE_BINARY, _SHORT, length)
    return struct.pack(">BBQ", _WHOLE_BINARY, _LONG, length)


class ReceivedFrame(NamedTuple):
    """Bytes of a stream as they came, and the message that they are where they are a whole one."""

    raw: bytes
    message: bytes | None = None
    is_text: bool = False
    frames: int = 1
    """How many of them begin in it."""


class FrameSplitter:
    """Cuts what one client sends, from the first byte after the handshake, into whole messages and what else there is.

    All that comes in goes out in order, in `raw`. What there is so far of a header, and of a message of less than 126
    bytes, waits for the rest. Nothing is checked here: what is no whole message of at most `longest` bytes, masked and
    without the bits of an extension, is left to a parser that is given everything else, too.
    """

    def __init__(self, longest: int) -> None:
        self._longest = longest
        self._begun = b""
        self._to_come = 0
        """Bytes of a frame that is passed on in parts."""
        self._is_fragmented = False
        """Whether the rest of a message comes in frames of its own."""
        self.has_more = False
        """Whether whole frames may wait, since there were more than were to be cut."""

    def keep(self, data: bytes) -> None:
        """Have more wait for the next time."""
        self._begun += data
        self.has_more = True

    def cut(self, data: bytes = b"", *, most: int = sys.maxsize) -> list[ReceivedFrame]:
        """Of what came before and `data`, so many frames at the most; others wait for the next time."""
        data = self._begun + data
        end = len(data)
        cuts = []
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
                    cuts.append(ReceivedFrame(data[passed:at], frames=others))
                message = apply_mask(data[start:past], data[start - _KEY_BYTES : start])
                cuts.append(ReceivedFrame(data[at:past], message, first == _WHOLE_TEXT))
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
            cuts.append(ReceivedFrame(data[passed:at], frames=others))
        return cuts
