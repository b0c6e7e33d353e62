"""Threads that do what they are given, in the order in which it came. They are watched (`server.runtime.thread_watch`),
and keep no process from ending.

`concurrent.futures` has a pool that breaks for good when one thread cannot start, and keeps silent of one that died.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from itertools import count
from queue import SimpleQueue

from server.runtime.thread_watch import Watched

Job = Callable[[], None]
"""Raises nothing: what becomes of the work is the job's own business."""

_logger = logging.getLogger(__name__)


class PoolThread:
    """One thread of a pool, which takes the jobs that `numbers` names out of `jobs`."""

    def __init__(
        self,
        name: str,
        numbers: "SimpleQueue[int | None]",
        jobs: dict[int, Job],
        initializer: Callable[[], object] | None,
    ) -> None:
        self.name = name
        self._numbers = numbers
        self._jobs = jobs
        self._initializer = initializer
        self._number: int | None = None
        self._has_ended = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_dead(self) -> bool:
        return not (self._thread.is_alive() or self._has_ended)

    @property
    def work_number(self) -> int | None:
        return self._number

    def join(self, timeout_s: float) -> bool:
        """Whether it has ended within that time."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        if self._initializer is not None:
            try:
                self._initializer()
            except Exception:  # it sets a priority, say: without it, work is still done
                _logger.exception("thread %s goes on though it could not be set up", self.name)
        while (number := self._numbers.get()) is not None:
            if (job := self._jobs.pop(number, None)) is not None:
                self._number = number
                job()
                self._number = None
        self._has_ended = True


class ThreadPool:
    """So many threads, named `name` and a number, each of which calls `initializer` first. A job that takes longer than
    `patience_s` is stuck."""

    def __init__(
        self, threads: int, name: str, *, initializer: Callable[[], object] | None = None, patience_s: float
    ) -> None:
        self.patience_s = patience_s
        self._count = count()
        self._numbers: SimpleQueue[int | None] = SimpleQueue()
        self._jobs: dict[int, Job] = {}
        """Those that no thread has taken yet."""
        self._initializer = initializer
        self._threads = [self._new(f"{name}-{number}") for number in range(threads)]

    @property
    def threads(self) -> Sequence[PoolThread]:
        return self._threads

    def submit(self, job: Job) -> None:
        """Waits for nothing; on any thread."""
        number = next(self._count)
        self._jobs[number] = job
        self._numbers.put(number)

    def replace(self, dead: Watched) -> None:
        # A thread that dies while it waits takes a number with it. Of two with the same number, one finds no job.
        for number in tuple(self._jobs):
            self._numbers.put(number)
        self._threads = [self._new(each.name) if each is dead else each for each in self._threads]

    def give_up(self, stuck: Watched) -> None:
        """Others go on; who waits for this one's work waits until it comes."""

    def stop(self, timeout_s: float) -> bool:
        """Have the threads end with what they were given before, and wait for that at most so long; whether they
        did."""
        for _ in self._threads:
            self._numbers.put(None)
        until_s = time.monotonic() + timeout_s
        return all(thread.join(max(0.0, until_s - time.monotonic())) for thread in self._threads)

    def _new(self, name: str) -> PoolThread:
        return PoolThread(name, self._numbers, self._jobs, self._initializer)
