"""How much one WebSocket client may say, so that nobody else is late for it.

A client spends from a budget that fills at a steady rate. Where it is spent, nothing is read from that socket until
there is some again: the rest waits with the client, and nothing is lost. Pure: the clock is passed in, in seconds.

**What a client may need.** The budget is in messages that take about 20 us each to cut, parse, pass on and, where that
is due, answer. On the event loop of a busy EPYC core an acknowledgement took 10 us, a ping with its pong 14, a refused
gain 18, nonsense 24 and a refused pose 26. A pose that a newer one follows at once took 2, and counts as an eighth. A
live block took 17 and counts as half: players of sixteen instruments send thousands, and with the whole cost everybody
could say twice as much of all else. The most that a player or an instrument has to say is a live block of 128 samples
of every emitter, 1,000 poses a second, an acknowledgement of every block of 128 samples, and 120 moves a second of
every emitter.
"""

import re
from dataclasses import dataclass
from typing import Final, Self

from server.protocol.blocks import DryBlock
from server.protocol.client_messages import ListenerPose
from server.protocol.codecs.registry import CODECS

SUPERSEDED_COST: Final = 1 / 8
READ_COST: Final = 1 / 4
"""Of each time that bytes come, however few."""
OTHER_FRAME_COST: Final = 2.0
"""Of a frame that is no whole message (a ping, a fragment), which takes the longer way."""
_LIVE_COST: Final = 1 / 2
_SHORTEST_BLOCK: Final = 128
POSES_PER_S = 1_000
MOVES_PER_S = 120
_BYTES_PER_SAMPLE = max(codec.bytes_per_sample for codec in CODECS.values())
_BYTES_PER_MESSAGE = 200
"""Of headers, names and JSON."""
_BURST_S = 0.25
"""What a network that falters for so long delivers at once is not held up."""


@dataclass(frozen=True)
class Allowance:
    """What fills a budget, each second."""

    messages_per_s: float
    bytes_per_s: float

    @classmethod
    def of(cls, *, emitters: int, sample_rate: int) -> Self:
        """For a client of so many emitters, all of them live."""
        blocks_per_s = sample_rate / _SHORTEST_BLOCK
        others_per_s = POSES_PER_S + blocks_per_s + MOVES_PER_S * emitters
        live_per_s = emitters * blocks_per_s
        samples_bytes_per_s = emitters * sample_rate * _BYTES_PER_SAMPLE
        return cls(
            messages_per_s=_LIVE_COST * live_per_s + others_per_s,
            bytes_per_s=samples_bytes_per_s + _BYTES_PER_MESSAGE * (live_per_s + others_per_s),
        )


USUAL: Final = Allowance.of(emitters=16, sample_rate=48_000)


class Budget:
    """Starts full, holds what comes in `_BURST_S`, and may be overspent: what has come is heeded, and then awaited."""

    def __init__(self, allowance: Allowance, now_s: float) -> None:
        self._filled_s = now_s
        self.allow(allowance)

    def allow(self, allowance: Allowance) -> None:
        """Fill it at another rate from now on, and up."""
        self._allowance = allowance
        self._messages = _BURST_S * allowance.messages_per_s
        self._bytes = _BURST_S * allowance.bytes_per_s

    def spend(self, messages: float, nbytes: int, now_s: float) -> None:
        passed_s, self._filled_s = now_s - self._filled_s, now_s
        rate = self._allowance
        self._messages = min(self._messages + passed_s * rate.messages_per_s, _BURST_S * rate.messages_per_s) - messages
        self._bytes = min(self._bytes + passed_s * rate.bytes_per_s, _BURST_S * rate.bytes_per_s) - nbytes

    @property
    def wait_s(self) -> float:
        """From when it was spent from last until there is something in it; 0 where there is."""
        rate = self._allowance
        return max(0.0, -self._messages / rate.messages_per_s, -self._bytes / rate.bytes_per_s)


def message_cost(message: bytes, *, is_text: bool) -> float:
    """Of a whole message."""
    return _LIVE_COST if not is_text and message[:1] == bytes([DryBlock.KIND]) else 1.0


def supersedes(newer: bytes, older: bytes) -> bool:
    """Whether two messages, of which `newer` came directly after `older`, are poses of the listener with rising ids, so
    that the older would be replaced before anybody hears it. Nothing is parsed: where it is not plain to see, no."""
    newer_id, older_id = _pose_id(newer), _pose_id(older)
    return newer_id is not None and older_id is not None and newer_id > older_id


_BINARY_KIND: Final = bytes([ListenerPose.KIND])
_ID = slice(4, 8)  # of ListenerPose.LAYOUT
_TEXT_POSE: Final = re.compile(rb'"type"\s*:\s*"listener"\s*[,}]')
_TEXT_ID: Final = re.compile(rb'"pose_id"\s*:\s*([0-9]{1,10})\s*[,}]')


def _pose_id(message: bytes) -> int | None:
    if message[:1] == _BINARY_KIND:
        return int.from_bytes(message[_ID], "little") if len(message) == ListenerPose.LAYOUT.size else None
    # A key that came twice would count the second time, and behind a backslash it may be part of a name.
    is_plain = message.count(b'"type"') == message.count(b'"pose_id"') == 1 and b"\\" not in message
    if not is_plain or _TEXT_POSE.search(message) is None:
        return None
    found = _TEXT_ID.search(message)
    return None if found is None else int(found[1])
