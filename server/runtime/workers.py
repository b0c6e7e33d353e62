"""Worker threads, which compute impulse responses and plans for the audio threads. Urgent work comes first. After that
each kind of work has its share of the workers' time, so that no kind delays another for long; within a kind the oldest
request comes first."""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from typing import Any, Final, Literal, Self, TypeVar

from server.runtime.thread_pool import ThreadPool

T = TypeVar("T")
Kind = Literal["response", "plan", "ways"]
"""Impulse responses, plans of effects with their audits, or the ways of sound where doors have moved. These take long,
so a thread of their own finds them."""
_SHARES: Final[Mapping[Kind, float]] = {"response": 0.75, "plan": 0.25}
"""The share of the workers' CPU time that each kind has while both wait. A reverberation that lags is heard; a plan
looks seconds ahead."""

_PATIENCE_S = 10.0
"""Impulse responses and plans take milliseconds, audits of plans up to a second."""
_STOP_S = 1.0


class Workers:
    """A pool of `threads` workers. Leaving the context waits at most a second for work to finish."""

    def __init__(self, threads: int, name: str = "worker", *, initializer: Callable[[], None] | None = None) -> None:
        self.threads = threads
        self.pool = ThreadPool(threads, name, initializer=initializer, patience_s=_PATIENCE_S)
        self._unfinished: deque[None] = deque()
        """One entry for each unfinished piece of work."""
        self.ways = ThreadPool(1, f"{name}-ways", initializer=initializer, patience_s=_PATIENCE_S)
        self._urgent: deque[Callable[[], None]] = deque()
        self._usual: dict[Kind, deque[Callable[[], None]]] = {kind: deque() for kind in _SHARES}
        self._used_s = dict.fromkeys(self._usual, 0.0)
        """CPU time that each kind has taken, divided by its share."""
        self._choosing = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.pool.stop(_STOP_S)
        self.ways.stop(_STOP_S)

    @property
    def are_busy(self) -> bool:
        """Whether any work is being done or waits. Any thread may ask."""
        return bool(self._unfinished)

    @property
    def has_urgent(self) -> bool:
        """Whether urgent work waits. Any thread may ask."""
        return bool(self._urgent)

    def submit(self, work: Callable[..., T], /, *args: Any, kind: Kind, is_urgent: bool = False) -> Future[T]:
        """Queue `work(*args)`; the future has its result. If that is cancelled, the work is dropped at once. Takes no
        lock that a worker holds, since a worker of low priority may hold a lock for long."""
        future: Future[T] = Future()
        asked = [(work, args)]
        future.add_done_callback(lambda _: asked.clear())  # what was called off keeps nothing alive while it waits
        run = partial(_settle, future, asked)
        if kind == "ways":
            self.ways.submit(run)
            return future
        self._unfinished.append(None)
        (self._urgent if is_urgent else self._usual[kind]).append(run)
        self.pool.submit(self._run_next)
        return future

    def _run_next(self) -> None:
        try:
            began_s = time.thread_time()
            with self._choosing:
                kind = None if self._urgent else self._choose()
                taken = [(self._urgent if kind is None else self._usual[kind]).popleft()]
            taken.pop()()  # in no variable, which the traceback of a failure would keep alive
            if kind is not None:
                self._used_s[kind] += (time.thread_time() - began_s) / _SHARES[kind]
        finally:
            self._unfinished.pop()

    def _choose(self) -> Kind:
        """The kind that has used least of its share, of those that wait. A kind that did not wait saves nothing up."""
        waiting = [kind for kind, queue in self._usual.items() if queue]
        chosen = min(waiting, key=self._used_s.__getitem__)
        for kind in self._usual:
            self._used_s[kind] = max(self._used_s[kind], self._used_s[chosen])
        return chosen


def _settle(future: Future[T], asked: list[tuple[Callable[..., T], tuple[Any, ...]]]) -> None:
    """`asked` is the work with its arguments, and empty once the future is done."""
    if not future.set_running_or_notify_cancel():
        return
    ((work, args),) = asked
    try:
        result = work(*args)
    except BaseException as exc:  # noqa: BLE001  raised where the result is read
        future.set_exception(exc)
        # The traceback refers to this frame. With the future in it there would be a cycle for the garbage collector.
        del future
    else:
        future.set_result(result)
