"""When a block is due, and how many blocks may be on their way.

Times are seconds of one monotonic clock. Block k of a stream plays from `origin_s + k * block_s`; the server renders it
`lead` blocks earlier. All times are counted from the origin, so the error of one sleep never adds to the next.
"""

import math

from server.core.errors import RequestError


class StreamClock:
    """Due times and deadlines of one stream's blocks."""

    def __init__(self, *, origin_s: float, block_s: float, lead: int) -> None:
        self.origin_s = origin_s
        self.early_s = 0.0
        """How much earlier than `lead` blocks before they play blocks are rendered. Deadlines do not depend on it."""
        self._block_s = block_s
        self._lead = lead

    def due_s(self, block: int) -> float:
        """When block `block` should be rendered."""
        return self.origin_s + (block - self._lead) * self._block_s - self.early_s

    def deadline_s(self, block: int) -> float:
        """Return when a player with `lead` blocks in hand needs block `block`; a block after that is late."""
        return self.origin_s + block * self._block_s

    def ahead_s(self, block: int, now_s: float) -> float:
        """Return how far ahead of real time a stream is if its next block is `block`; negative if it is behind."""
        return self.deadline_s(block) - now_s

    def slip(self, block: int, now_s: float) -> None:
        """Move the origin by whole blocks so that `block` is due next. After a stall, sound then resumes instead of
        arriving in a burst, and other streams' blocks still fall due between this one's."""
        # guard: a stall moves a clock by whole blocks
        self.origin_s += math.ceil((now_s - self.due_s(block)) / self._block_s) * self._block_s


class SendWindow:
    """A limit of `size` blocks that are sent and not yet acknowledged; the first one has the number `first`.

    Awaiting a socket does not show what the client has: seconds of audio fit in the buffers between. Acknowledgements
    do.
    """

    def __init__(self, size: int, first: int = 0) -> None:
        self.size = size
        self.first = first
        self.sent = 0
        self._acknowledged = 0

    @property
    def unacknowledged(self) -> int:
        return self.sent - self._acknowledged

    @property
    def is_full(self) -> bool:
        return self.unacknowledged >= self.size

    @property
    def next_sequence(self) -> int:
        return self.first + self.sent

    def take_sequences(self, blocks: int) -> range:
        """Return the sequence numbers of the next `blocks`, or of as many of them as the window has room for."""
        first = self.next_sequence
        self.sent += max(0, min(blocks, self.size - self.unacknowledged))
        return range(first, self.next_sequence)

    def acknowledge(self, sequence: int) -> None:
        """Note that blocks up to and including `sequence` arrived. Raises RequestError for one that was never sent."""
        # guard: what was not sent cannot have arrived
        if sequence >= self.next_sequence:
            raise RequestError("unknown_sequence", f"block {sequence} has not been sent yet", field="sequence")
        # guard: who acknowledges late takes nothing back
        self._acknowledged = max(self._acknowledged, sequence + 1 - self.first)
