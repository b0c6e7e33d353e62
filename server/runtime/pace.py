"""Long work that goes on behind what is more urgent, and ends when nobody wants its result any more.

A low priority is not enough: a thread that is put aside while it holds the interpreter's lock keeps those waiting that
come before it. So work is done in short stretches, and between two of them the thread sleeps for as long as something
urgent is under way; but for no more than `1 / least_share - 1` times what the stretch took, so that it comes to its
end on a busy server, too.
"""

import time
from collections.abc import Callable
from concurrent.futures import CancelledError

Checkpoint = Callable[[], None]
"""To be called often by long work. Raises CancelledError where nobody wants the result."""

_LOOK_S = 0.004
_STRETCH_S = 0.002


def no_checkpoint() -> None:
    """For work that somebody waits for at a command line."""


class Pace:
    """The checkpoint of one piece of work, of the thread that does it."""

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
        """Let urgent work go first, if the stretch since the last rest was long enough."""
        worked_s = self._thread_time_s() - self._since_s
        if worked_s < _STRETCH_S:
            return
        left_s = worked_s * self._rest_per_work
        while left_s > 0 and self._is_urgent():
            self._sleep(min(_LOOK_S, left_s))
            left_s -= _LOOK_S
        self._since_s = self._thread_time_s()
