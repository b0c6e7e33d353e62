"""Pacing of long work: it makes way for urgent work, and it stops when its result is no longer wanted.

A low priority is not enough. A thread that the system suspends while it holds the interpreter's lock blocks more
important threads. So long work runs in short stretches. Between two of them the thread sleeps while something urgent is
under way, but for at most `1 / least_share - 1` times the length of the stretch, so that it also finishes on a busy
server.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError

Checkpoint = Callable[[], None]
"""Long work calls its checkpoint often. It raises CancelledError if the result is no longer wanted."""

_LOOK_S = 0.004
_STRETCH_S = 0.002
_LONGEST_NAP_S = 0.05


def no_checkpoint() -> None:
    """The checkpoint of work at a command line, which runs without pauses to its end."""


class CpuBudget:
    """CPU time that several threads may spend together: on average the `share` of a core that is called for at the
    time. Any thread may use it."""

    def __init__(self, share: Callable[[], float], *, time_s: Callable[[], float] = time.monotonic) -> None:
        self._share = share
        self._time_s = time_s
        self._debt_s = 0.0
        self._since_s = time_s()
        self._lock = threading.Lock()

    def spend(self, cpu_s: float) -> None:
        """Note CPU time that was spent."""
        with self._lock:
            self._pay()
            self._debt_s += cpu_s

    @property
    def wait_s(self) -> float:
        """How long to wait until more may be spent."""
        with self._lock:
            self._pay()
            return self._debt_s / self._share() if self._debt_s else 0.0

    def _pay(self) -> None:
        now_s = self._time_s()
        passed_s, self._since_s = now_s - self._since_s, now_s
        self._debt_s = max(0.0, self._debt_s - passed_s * self._share()) if passed_s > 0 else self._debt_s


class Pace:
    """The checkpoint of one piece of work; only the thread that does the work calls it. With a `budget` the work waits
    until that allows it."""

    def __init__(
        self,
        *,
        is_urgent: Callable[[], bool],
        is_wanted: Callable[[], bool],
        least_share: float = 0.1,
        budget: CpuBudget | None = None,
        thread_time_s: Callable[[], float] = time.thread_time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._is_urgent = is_urgent
        self._is_wanted = is_wanted
        self._rest_per_work = 1 / least_share - 1
        self._budget = budget
        self._thread_time_s = thread_time_s
        self._sleep = sleep
        self._since_s = thread_time_s()

    def __call__(self) -> None:
        self.rest()
        if not self._is_wanted():
            raise CancelledError

    def wait(self) -> None:
        """Sleep until the budget allows more work, as long as its result is wanted."""
        while self._budget is not None and self._is_wanted() and (wait_s := self._budget.wait_s) > 0:
            self._sleep(min(_LONGEST_NAP_S, wait_s))

    def rest(self) -> None:
        """Sleep while urgent work is under way, if enough work was done since the last rest."""
        worked_s = self._thread_time_s() - self._since_s
        if worked_s < _STRETCH_S:
            return
        if self._budget is not None:
            self._budget.spend(worked_s)
            self.wait()
        left_s = worked_s * self._rest_per_work
        while left_s > 0 and self._is_urgent():
            self._sleep(min(_LOOK_S, left_s))
            left_s -= _LOOK_S
        self._since_s = self._thread_time_s()
