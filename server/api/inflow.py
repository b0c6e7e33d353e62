"""Limit on the rate of messages from one WebSocket client, so that no client makes another's audio late.

A client spends from a budget that fills at a steady rate. When the budget is spent, the server stops reading from the
socket until there is some again. The rest waits at the client, and nothing is lost. The module does no I/O: the caller
passes the time in seconds.

**Size of the budget.** The unit is a message that takes about 20 us to read, parse, pass on and, if due, answer. On the
event loop of a busy EPYC core an acknowledgement took 10 us, a ping with its pong 14, a refused gain 18, invalid text
24 and a refused pose 26. A pose directly followed by a newer one took 2 us and counts as an eighth. A live block took
17 us but counts as half, since a client with sixteen instruments sends thousands of them; at full cost the budget would
have to allow twice as many of all other messages. The budget allows, for every emitter, live blocks of 128 samples and
120 moves a second, and for every listener 1,000 poses a second and an acknowledgement of every block of 128 samples.
"""

import re
from dataclasses import dataclass
from typing import Final, Self

from server.protocol.blocks import DryBlock
from server.protocol.client_messages import ListenerPose
from server.protocol.codecs.libopus import RATES
from server.protocol.codecs.registry import CODECS, NUMBERS
from server.protocol.packets import LONGEST_LIVE_S

SUPERSEDED_COST: Final = 1 / 8
READ_COST: Final = 1 / 4
"""Cost of each read from the socket, however few bytes it brings."""
OTHER_FRAME_COST: Final = 2.0
"""Cost of a frame that is not a whole message (a ping, a fragment), which uvicorn's slower path handles."""
LISTENER_COST: Final = 400.0
"""Cost of another listener's session, which takes about 8 ms to make."""
_LIVE_COST: Final = 1 / 2
_OPUS_FRAMES: Final = 240
"""Samples in Opus that are decoded, and as many filled in, in the time of a unit."""
_MOST_FRAMES: Final = round(LONGEST_LIVE_S * max(RATES))
_SHORTEST_BLOCK: Final = 128
POSES_PER_S = 1_000
MOVES_PER_S = 120
_BYTES_PER_SAMPLE = max(codec.bytes_per_sample for codec in CODECS.values())
_BYTES_PER_MESSAGE = 200
"""Allowance for headers, names and JSON."""
_BURST_S = 0.25
"""Messages of this much time may come at once without delay, as after a short interruption of the network."""


@dataclass(frozen=True)
class Allowance:
    """The rates at which a budget fills."""

    messages_per_s: float
    bytes_per_s: float

    @classmethod
    def of(cls, *, emitters: int, sample_rate: int, listeners: int = 1) -> Self:
        """The allowance of a client with this many emitters, all of them live, and listeners, all of whom walk."""
        blocks_per_s = sample_rate / _SHORTEST_BLOCK
        others_per_s = listeners * (POSES_PER_S + blocks_per_s) + MOVES_PER_S * emitters
        live_per_s = emitters * blocks_per_s
        samples_bytes_per_s = emitters * sample_rate * _BYTES_PER_SAMPLE
        return cls(
            messages_per_s=_LIVE_COST * live_per_s + others_per_s,
            bytes_per_s=samples_bytes_per_s + _BYTES_PER_MESSAGE * (live_per_s + others_per_s),
        )


USUAL: Final = Allowance.of(emitters=16, sample_rate=48_000)


class Budget:
    """A client's budget of messages and bytes. It starts full and holds the allowance of `_BURST_S`. It may go below
    zero: messages that have arrived are handled, and reading then pauses until it is positive again."""

    def __init__(self, allowance: Allowance, now_s: float) -> None:
        self._filled_s = now_s
        self.allow(allowance)

    def allow(self, allowance: Allowance) -> None:
        """Change the rate, and fill the budget up."""
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
        """Time from the last spending until the budget is positive again; 0 if it is positive."""
        rate = self._allowance
        return max(0.0, -self._messages / rate.messages_per_s, -self._bytes / rate.bytes_per_s)


def message_cost(message: bytes, *, is_text: bool) -> float:
    """Cost of a whole message."""
    if is_text or message[:1] != _LIVE_KIND:
        return 1.0
    if message[1:2] != _OPUS_NUMBER:
        return _LIVE_COST
    # A block that does not last as long as it says is refused before it is decoded.
    frames = min(int.from_bytes(message[_FRAMES], "little"), _MOST_FRAMES)
    return _LIVE_COST + frames / _OPUS_FRAMES


def supersedes(newer: bytes, older: bytes) -> bool:
    """Whether two successive messages are poses of one listener with rising ids, so that the older one never takes
    effect. The messages are not parsed, so the answer is False in unclear cases."""
    newer_pose, older_pose = _pose(newer), _pose(older)
    if newer_pose is None or older_pose is None:
        return False
    return newer_pose[0] == older_pose[0] and newer_pose[1] > older_pose[1]


_LIVE_KIND: Final = bytes([DryBlock.KIND])
_OPUS_NUMBER: Final = bytes([NUMBERS["opus"]])
_FRAMES: Final = slice(8, 12)  # of DryBlock.LAYOUT
_BINARY_KIND: Final = bytes([ListenerPose.KIND])
_NUMBER, _ID = 1, slice(4, 8)  # of ListenerPose.LAYOUT
_TEXT_POSE: Final = re.compile(rb'"type"\s*:\s*"listener"\s*[,}]')
_OTHER_LISTENER: Final = re.compile(rb'"(listener|index)"\s*:\s*(?!null)')
_TEXT_ID: Final = re.compile(rb'"pose_id"\s*:\s*([0-9]{1,10})\s*[,}]')


def _pose(message: bytes) -> tuple[int, int] | None:
    """The number of the listener and the id of a pose; None for another message, or a text with a listener's name."""
    if message[:1] == _BINARY_KIND:
        if len(message) != ListenerPose.LAYOUT.size:
            return None
        return message[_NUMBER], int.from_bytes(message[_ID], "little")
    # Of a duplicate key the second counts, and after a backslash it may be part of a string.
    is_plain = message.count(b'"type"') == message.count(b'"pose_id"') == 1 and b"\\" not in message
    if not is_plain or _TEXT_POSE.search(message) is None or _OTHER_LISTENER.search(message) is not None:
        return None
    found = _TEXT_ID.search(message)
    return None if found is None else (0, int(found[1]))
