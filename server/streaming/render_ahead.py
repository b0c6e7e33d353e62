"""How many blocks of a stream an audio thread renders at once: the first in time, the others ahead of it. More take
less of a core each, and poses are heard up to so many blocks later.

Up to two, most poses are heard within 15 ms; four or eight are for a thread that has no time otherwise. A moment in
which something else has the core is not worth them: clients have blocks in hand for that.
"""

from typing import Final

NUMBERS: Final = (1, 2, 4, 8)
_MORE_ABOVE = {1: 0.7, 2: 0.84, 4: 0.84}
"""Share of the time that rendering so many at once takes in the mean, above which it is twice as many."""
_FULL, _BEHIND = 0.95, 0.25
"""Share of the time in one period, and lateness of a block as a share of what its client has in hand, beyond both of
which a thread falls behind: no time for a mean."""
_SAVED = 1 / 7
"""Of the time, by twice as many, at the most: a thread whose time would do for half as many renders half as many."""
_LOOKS = 3
"""Periods, after a change, until a mean says something."""
_NEWEST = 0.25
"""Weight of a period among all before."""


class RenderAhead:
    """`count` blocks, at first one, then as many as the load calls for."""

    def __init__(self) -> None:
        self.count = NUMBERS[0]
        self._busy = 0.0
        self._looks = 0

    def look(self, busy: float, lateness: float) -> None:
        """Every `server.streaming.load.PERIOD_S`, with the share of it in which the thread rendered, and how late a
        block was at
        worst, as a share of what its client has in hand."""
        self._looks += 1
        self._busy += max(1 / self._looks, _NEWEST) * (busy - self._busy)
        has_mean = self._looks >= _LOOKS
        falls_behind = busy > _FULL and lateness > _BEHIND
        if self.can_be_more and (falls_behind or (has_mean and self._busy > _MORE_ABOVE[self.count])):
            self._change(2 * self.count)
        elif has_mean and self.count > 1 and self._busy / (1 - _SAVED) < _MORE_ABOVE[self.count // 2]:
            self._change(self.count // 2)

    @property
    def can_be_more(self) -> bool:
        """Whether a thread that has no time left can still make some."""
        return self.count < NUMBERS[-1]

    def _change(self, count: int) -> None:
        self.count, self._looks = count, 0
