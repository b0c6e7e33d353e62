"""A watch over the threads that do a server's work: one that is dead is replaced, one that is stuck is told of.

A thread is *stuck* while it is at one piece of work for longer than such work ever takes. Python has no way to end it,
so a stuck thread keeps the server from being ready until it goes on. Time is counted in looks at the threads, not in
seconds, so that a machine that was suspended has no stuck threads when it wakes.
"""

import asyncio
import logging
import math
from collections import Counter, deque
from collections.abc import Sequence
from typing import Literal, Protocol

PERIOD_S = 0.1
_GIVE_UP_AFTER = 3
"""A stuck thread is given up for good after so many times its patience."""
_MOST_DEATHS = 3
_DEATHS_WITHIN_S = 60.0

State = Literal["working", "stuck", "dead"]

_logger = logging.getLogger(__name__)


class Watched(Protocol):
    """A thread, as far as it is watched. Both may be asked from any thread."""

    @property
    def name(self) -> str: ...

    @property
    def is_dead(self) -> bool:
        """Whether it was started and has ended, though nobody told it to."""

    @property
    def work_number(self) -> int | None:
        """Which piece of work it is at; None while it waits for one."""


class Group(Protocol):
    """Threads that do the same kind of work."""

    @property
    def threads(self) -> Sequence[Watched]: ...

    @property
    def patience_s(self) -> float:
        """How long one piece of work may take."""

    def replace(self, dead: Watched) -> None:
        """Put a new thread of the same name in its place."""

    def give_up(self, stuck: Watched) -> None:
        """Tell those who wait for a thread that has been stuck for long."""


class ThreadWatch:
    """Looks at the threads of `groups` every `PERIOD_S`; belongs to the event loop."""

    def __init__(self, groups: Sequence[Group]) -> None:
        self._groups = groups
        self._at: dict[str, tuple[int, int]] = {}
        """By thread: the piece of work it is at, and how many looks have found it there."""
        self._looks = 0
        self._deaths: deque[int] = deque(maxlen=_MOST_DEATHS)
        """With which look each was found."""
        self.restarts: Counter[str] = Counter()
        """Threads that died and were replaced, by name."""
        self.stuck: tuple[str, ...] = ()
        """Names of threads that are stuck now."""
        self._has_failed = False

    @property
    def problem(self) -> str | None:
        """What keeps the server from doing its work, if anything does."""
        if self._has_failed:
            return "the watch over the server's threads has failed; the log says why"
        if self.stuck:
            return f"thread {', '.join(self.stuck)} is stuck"
        if len(self._deaths) == _MOST_DEATHS and self._looks - self._deaths[0] < _DEATHS_WITHIN_S / PERIOD_S:
            return "threads of the server die again and again; the log says why"
        return None

    @property
    def states(self) -> dict[str, State]:
        """By name of thread."""
        return {
            thread.name: "dead" if thread.is_dead else "stuck" if thread.name in self.stuck else "working"
            for group in self._groups
            for thread in group.threads
        }

    def look(self) -> None:
        """Look once at every thread."""
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
        """Look until cancelled."""
        try:
            while True:
                await asyncio.sleep(PERIOD_S)
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
