"""A pool of daemon threads that run jobs in the order of submission. `server.runtime.thread_watch` watches them.

The pool of `concurrent.futures` breaks for good if one thread cannot start, and does not report a thread that died.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from itertools import count
from queue import SimpleQueue

from server.runtime.thread_watch import Watched

Job = Callable[[], None]
"""A job raises nothing. It reports the outcome of its work itself."""

_logger = logging.getLogger(__name__)


class PoolThread:
    """One thread of a pool. It takes a number from the queue `numbers` and runs the job of that number in `jobs`."""

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
        """Wait for the thread to end. Returns whether it did within the time."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        if self._initializer is not None:
            try:
                self._initializer()
            except Exception:  # without a priority, say, the thread still works
                _logger.exception("thread %s goes on though it could not be set up", self.name)
        while (number := self._numbers.get()) is not None:
            if (job := self._jobs.pop(number, None)) is not None:
                self._number = number
                job()
                self._number = None
        self._has_ended = True


class ThreadPool:
    """A pool of `threads` threads, named `name` and a number. Each calls `initializer` first. A job that takes longer
    than `patience_s` counts as stuck."""

    def __init__(
        self, threads: int, name: str, *, initializer: Callable[[], object] | None = None, patience_s: float
    ) -> None:
        self.patience_s = patience_s
        self._count = count()
        self._numbers: SimpleQueue[int | None] = SimpleQueue()
        self._jobs: dict[int, Job] = {}
        """By number, the jobs that no thread has taken yet."""
        self._initializer = initializer
        self._threads = [self._new(f"{name}-{number}") for number in range(threads)]

    @property
    def threads(self) -> Sequence[PoolThread]:
        return self._threads

    def submit(self, job: Job) -> None:
        """Queue a job. Never blocks; any thread may call this."""
        number = next(self._count)
        self._jobs[number] = job
        self._numbers.put(number)

    def replace(self, dead: Watched) -> None:
        # A thread that dies while it waits may have taken a number, so all numbers are queued again. A thread that
        # takes a number for the second time finds no job.
        for number in tuple(self._jobs):
            self._numbers.put(number)
        self._threads = [self._new(each.name) if each is dead else each for each in self._threads]

    def give_up(self, stuck: Watched) -> None:
        """Does nothing. The other threads go on, and callers keep waiting for the job of the stuck one."""

    def stop(self, timeout_s: float) -> bool:
        """Let the threads finish all jobs already submitted and end. Returns whether they did within the time."""
        for _ in self._threads:
            self._numbers.put(None)
        until_s = time.monotonic() + timeout_s
        return all(thread.join(max(0.0, until_s - time.monotonic())) for thread in self._threads)

    def _new(self, name: str) -> PoolThread:
        return PoolThread(name, self._numbers, self._jobs, self._initializer)
