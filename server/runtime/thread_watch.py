"""Supervision of the server's threads. A dead thread is replaced, a stuck one is reported.

A thread is *stuck* while one piece of work takes longer than such work ever should. Python cannot end a thread, so the
server is not ready until the stuck thread goes on. Time is counted in looks at the threads, not in seconds, so that no
thread counts as stuck after the machine was suspended.

The event loop looks at the threads, so the watch also tells how late that comes to its work.
"""

import asyncio
import logging
import math
from collections import Counter, deque
from collections.abc import Sequence
from typing import Literal, Protocol

from server.core.durations import DurationHistogram

PERIOD_S = 0.1
_GIVE_UP_AFTER = 3
"""A stuck thread is given up after this many times its patience."""
_MOST_DEATHS = 3
_DEATHS_WITHIN_S = 60.0

State = Literal["working", "stuck", "dead"]

_logger = logging.getLogger(__name__)


class Watched(Protocol):
    """A thread as the watch sees it. Any thread may read these properties."""

    @property
    def name(self) -> str: ...

    @property
    def is_dead(self) -> bool:
        """Whether the thread has ended without being told to."""

    @property
    def work_number(self) -> int | None:
        """Number of the piece of work it is doing; None while it waits for work."""


class Group(Protocol):
    """Threads that do the same kind of work."""

    @property
    def threads(self) -> Sequence[Watched]: ...

    @property
    def patience_s(self) -> float:
        """How long one piece of work may take before the thread counts as stuck."""

    def replace(self, dead: Watched) -> None:
        """Replace a dead thread by a new one of the same name."""

    def give_up(self, stuck: Watched) -> None:
        """Tell the waiting callers that this thread has been stuck for too long."""


class ThreadWatch:
    """Checks the threads of `groups` every `PERIOD_S`. Belongs to the event loop."""

    def __init__(self, groups: Sequence[Group]) -> None:
        self._groups = groups
        self._at: dict[str, tuple[int, int]] = {}
        """By thread name, the number of its current piece of work and how many looks have seen that number."""
        self._looks = 0
        self._deaths: deque[int] = deque(maxlen=_MOST_DEATHS)
        """Numbers of the looks that found a dead thread, most recent last."""
        self.restarts: Counter[str] = Counter()
        """How often each thread, by name, was replaced."""
        self.stuck: tuple[str, ...] = ()
        """Names of the threads that are stuck now."""
        self.lag = DurationHistogram()
        """How much later than it was due the event loop came to each look."""
        self._has_failed = False

    @property
    def problem(self) -> str | None:
        """Why the server cannot do its work; None if it can."""
        if self._has_failed:
            return "the watch over the server's threads has failed; the log says why"
        if self.stuck:
            return f"thread {', '.join(self.stuck)} is stuck"
        if len(self._deaths) == _MOST_DEATHS and self._looks - self._deaths[0] < _DEATHS_WITHIN_S / PERIOD_S:
            return "threads of the server die again and again; the log says why"
        return None

    @property
    def states(self) -> dict[str, State]:
        """State of each thread, by name."""
        return {
            thread.name: "dead" if thread.is_dead else "stuck" if thread.name in self.stuck else "working"
            for group in self._groups
            for thread in group.threads
        }

    def look(self) -> None:
        """Check every thread once."""
        self._looks += 1
        stuck = []
        for group in self._groups:
            patience = math.ceil(group.patience_s / PERIOD_S)
            for thread in tuple(group.threads):
                if thread.is_dead:
                    self._replace(group, thread)
                    continue
                looks = self._looks_at_same_work(thread)
                if looks == patience:
                    _logger.error("thread %s is stuck: not ready until it goes on", thread.name)
                if looks == _GIVE_UP_AFTER * patience:
                    group.give_up(thread)
                if looks >= patience:
                    stuck.append(thread.name)
        self.stuck = tuple(stuck)

    async def run(self) -> None:
        """Check the threads again and again until cancelled."""
        time_s = asyncio.get_running_loop().time
        try:
            while True:
                due_s = time_s() + PERIOD_S
                await asyncio.sleep(PERIOD_S)
                self.lag.add(max(0.0, time_s() - due_s))
                self.look()
        except Exception:  # an unwatched server must not seem a healthy one
            self._has_failed = True
            _logger.exception("the watch over the server's threads has failed")

    def _looks_at_same_work(self, thread: Watched) -> int:
        number = thread.work_number
        if number is None:
            self._at.pop(thread.name, None)
            return 0
        before, looks = self._at.get(thread.name, (number, 0))
        self._at[thread.name] = number, looks + 1 if before == number else 1
        return self._at[thread.name][1]

    def _replace(self, group: Group, dead: Watched) -> None:
        _logger.error("thread %s has died and is replaced", dead.name)
        self._at.pop(dead.name, None)
        self._deaths.append(self._looks)
        self.restarts[dead.name] += 1
        group.replace(dead)
