"""Streams begin one after the other, as fast as others can spare the time.

A stream that begins takes much at once: a session, a first plan, the first impulse responses of all its emitters. These
go before the responses of others, who would wait for them if many streams began together. So whoever is let in waits
for a turn, first come first served, and for no longer than a client should wait for an answer.

A turn comes when the work of those before is expected to be done, at the pace of the cores that others leave, and no
first response waits for a worker. A client that asks for nothing holds nobody up.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from server.streaming.headroom import LEAST_PACE

_LOOK_EVERY_S = 0.01


@dataclass(frozen=True)
class _Waiting:
    work_s: float
    until_s: float
    begin: Callable[[], None]
    give_up: Callable[[], None]
    is_wanted: Callable[[], bool]


class Beginnings:
    """The turns of streams to begin. It belongs to the event loop.

    At a turn the work of those before takes the `spare_cores` at most `most_ahead_s` more. Who has had no turn after
    `patience_s` gets none. `is_behind` says whether first work waits for a worker; `call_later` runs a call on the
    event loop after some seconds.
    """

    def __init__(
        self,
        *,
        spare_cores: float,
        most_ahead_s: float,
        patience_s: float,
        is_behind: Callable[[], bool],
        call_later: Callable[[float, Callable[[], None]], object],
        time_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.spare_cores = spare_cores
        """Cores that are free for beginnings; it may be set."""
        self._most_ahead_s, self._patience_s = most_ahead_s, patience_s
        self._is_behind, self._call_later, self._time_s = is_behind, call_later, time_s
        self._waiting: deque[_Waiting] = deque()
        self._work_s = 0.0
        """CPU seconds of work that is still to be done for those that have begun."""
        self._looked_s = time_s()
        self._is_looking = False

    @property
    def done_in_s(self) -> float:
        """Seconds until those that have begun are likely to have all that their beginning takes."""
        now_s = self._time_s()
        passed_s, self._looked_s = now_s - self._looked_s, now_s
        self._work_s = max(0.0, self._work_s - passed_s * self._pace)
        return self._work_s / self._pace

    @property
    def turn_in_s(self) -> float:
        """Seconds until the turn of whoever comes now is to be expected."""
        return self.done_in_s + sum(each.work_s for each in self._waiting) / self._pace

    def enter(
        self,
        work_s: float,
        begin: Callable[[], None],
        give_up: Callable[[], None],
        *,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """Call `begin` when it is the turn of a stream whose beginning takes `work_s` CPU seconds: at once if nobody is
        before it. Call `give_up` if the turn does not come in time, or if it is not wanted any more by then."""
        self._waiting.append(_Waiting(work_s, self._time_s() + self._patience_s, begin, give_up, is_wanted))
        if not self._is_looking:
            self._look()

    def _look(self) -> None:
        while self._waiting and (self._is_turn or self._time_s() >= self._waiting[0].until_s):
            is_turn, each = self._is_turn, self._waiting.popleft()
            if is_turn and each.is_wanted():
                self._work_s += each.work_s
                each.begin()
            else:
                each.give_up()
        self._is_looking = bool(self._waiting)
        if self._is_looking:
            self._call_later(_LOOK_EVERY_S, self._look)

    @property
    def _pace(self) -> float:
        return max(LEAST_PACE, self.spare_cores)

    @property
    def _is_turn(self) -> bool:
        return self.done_in_s <= self._most_ahead_s and not self._is_behind()
