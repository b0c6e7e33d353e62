"""Threads that compute what audio threads wait for: in the order in which it was asked for, what is urgent first."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Self, TypeVar

T = TypeVar("T")


class Workers:
    """So many threads; leaving the context waits until everything is done."""

    def __init__(self, threads: int, name: str = "worker", *, initializer: Callable[[], None] | None = None) -> None:
        self.threads = threads
        self._threads = ThreadPoolExecutor(threads, name, initializer)
        self._urgent: deque[Callable[[], None]] = deque()
        self._usual: deque[Callable[[], None]] = deque()
        self._choosing = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown()

    def submit(self, work: Callable[..., T], /, *args: Any, is_urgent: bool = False) -> Future[T]:
        """What `work` returns or raises. What is urgent is done before all that is not."""
        future: Future[T] = Future()

        def run() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                result = work(*args)
            except BaseException as exc:  # noqa: BLE001  whoever asks for the result has it raised
                future.set_exception(exc)
            else:
                future.set_result(result)

        (self._urgent if is_urgent else self._usual).append(run)
        self._threads.submit(self._run_next)
        return future

    def _run_next(self) -> None:
        with self._choosing:
            run = (self._urgent or self._usual).popleft()
        run()
