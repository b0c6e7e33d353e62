"""Worker threads, which compute impulse responses and plans for the audio threads. Urgent work comes first. After that
the kinds of work take turns, so that no kind delays another; within a kind the oldest request comes first."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, Literal, Self, TypeVar, get_args

from server.runtime.thread_pool import ThreadPool

T = TypeVar("T")
Kind = Literal["response", "plan"]
"""Impulse responses, or plans of effects with their audits."""


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
        self._urgent: deque[Callable[[], None]] = deque()
        self._usual: dict[Kind, deque[Callable[[], None]]] = {kind: deque() for kind in get_args(Kind)}
        self._turns = deque(self._usual)
        self._choosing = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.pool.stop(_STOP_S)

    @property
    def are_busy(self) -> bool:
        """Whether any work is being done or waits. Any thread may ask."""
        return bool(self._unfinished)

    def submit(self, work: Callable[..., T], /, *args: Any, kind: Kind, is_urgent: bool = False) -> Future[T]:
        """Queue `work(*args)`; the future has its result. Takes no lock that a worker holds, since a worker of low
        priority may hold a lock for long."""
        future: Future[T] = Future()
        run = partial(_settle, future, work, args)
        self._unfinished.append(None)
        (self._urgent if is_urgent else self._usual[kind]).append(run)
        self.pool.submit(self._run_next)
        return future

    def _run_next(self) -> None:
        try:
            self._next()()  # not in a variable, which the traceback of a failure would keep alive
        finally:
            self._unfinished.pop()

    def _next(self) -> Callable[[], None]:
        with self._choosing:
            return self._urgent.popleft() if self._urgent else self._next_usual()

    def _next_usual(self) -> Callable[[], None]:
        kind = next(kind for kind in self._turns if self._usual[kind])
        self._turns.remove(kind)
        self._turns.append(kind)
        return self._usual[kind].popleft()


def _settle(future: Future[T], work: Callable[..., T], args: tuple[Any, ...]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        result = work(*args)
    except BaseException as exc:  # noqa: BLE001  raised where the result is read
        future.set_exception(exc)
        # The traceback refers to this frame. With the future in it there would be a cycle for the garbage collector.
        del future
    else:
        future.set_result(result)
