"""Pacing of long work: it makes way for urgent work, and it stops when its result is no longer wanted.

A low priority is not enough. A thread that the system suspends while it holds the interpreter's lock blocks more
important threads. So long work runs in short stretches. Between two of them the thread sleeps while something urgent is
under way, but for at most `1 / least_share - 1` times the length of the stretch, so that it also finishes on a busy
server.
"""

import time
from collections.abc import Callable
from concurrent.futures import CancelledError

Checkpoint = Callable[[], None]
"""Long work calls its checkpoint often. It raises CancelledError if the result is no longer wanted."""

_LOOK_S = 0.004
_STRETCH_S = 0.002


def no_checkpoint() -> None:
    """The checkpoint of work at a command line, which runs without pauses to its end."""


class Pace:
    """The checkpoint of one piece of work; only the thread that does the work calls it."""

    def __init__(
        self,
        *,
        is_urgent: Callable[[], bool],
        is_wanted: Callable[[], bool],
        least_share: float = 0.1,
        thread_time_s: Callable[[], float] = time.thread_time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._is_urgent = is_urgent
        self._is_wanted = is_wanted
        self._rest_per_work = 1 / least_share - 1
        self._thread_time_s = thread_time_s
        self._sleep = sleep
        self._since_s = thread_time_s()

    def __call__(self) -> None:
        self.rest()
        if not self._is_wanted():
            raise CancelledError

    def rest(self) -> None:
        """Sleep while urgent work is under way, if enough work was done since the last rest."""
        worked_s = self._thread_time_s() - self._since_s
        if worked_s < _STRETCH_S:
            return
        left_s = worked_s * self._rest_per_work
        while left_s > 0 and self._is_urgent():
            self._sleep(min(_LOOK_S, left_s))
            left_s -= _LOOK_S
        self._since_s = self._thread_time_s()
