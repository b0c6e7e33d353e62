"""Threads that compute what audio threads wait for: what is urgent first, then one of each kind in turns, each kind in
the order in which it was asked for. A kind that many ask for keeps no other waiting."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, Literal, Self, TypeVar, get_args

from server.runtime.thread_pool import ThreadPool

T = TypeVar("T")
Kind = Literal["response", "plan"]
"""Impulse responses, and plans of effects with their checks."""


_PATIENCE_S = 10.0
"""Impulse responses and plans take milliseconds, checks of plans up to a second."""
_STOP_S = 1.0


class Workers:
    """So many threads; leaving the context waits until everything is done, for a second at the most."""

    def __init__(self, threads: int, name: str = "worker", *, initializer: Callable[[], None] | None = None) -> None:
        self.threads = threads
        self.pool = ThreadPool(threads, name, initializer=initializer, patience_s=_PATIENCE_S)
        self._unfinished: deque[None] = deque()
        """As many as there are pieces of work that are not done."""
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
        """Whether anything is being done or waits; may be asked from any thread."""
        return bool(self._unfinished)

    def submit(self, work: Callable[..., T], /, *args: Any, kind: Kind, is_urgent: bool = False) -> Future[T]:
        """What `work` returns or raises. Waits for no thread that chooses what comes next: one of low priority may take
        long for that."""
        future: Future[T] = Future()
        run = partial(_settle, future, work, args)
        self._unfinished.append(None)
        (self._urgent if is_urgent else self._usual[kind]).append(run)
        self.pool.submit(self._run_next)
        return future

    def _run_next(self) -> None:
        try:
            self._next()()  # in no variable: a traceback of what fails would hold it
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
    except BaseException as exc:  # noqa: BLE001  whoever asks for the result has it raised
        future.set_exception(exc)
        # The traceback holds this frame: with the future in it, all three would wait for the collector.
        del future
    else:
        future.set_result(result)
