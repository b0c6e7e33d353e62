"""Work that workers have not finished yet, and that is called off when nobody wants it any more."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")


class PendingWork:
    """Unfinished work of one stream, or of one of its listeners. Its length may be read by any thread."""

    def __init__(self) -> None:
        # A future keeps its callbacks, so that what one that was called off refers to is not to be found there.
        self._futures: dict[Future[Any], Callable[[Any], None]] = {}

    def __len__(self) -> int:
        return len(self._futures)

    def keep_outcome(self, future: "Future[T]", keep: "Callable[[T | BaseException], None]") -> None:
        """Call `keep` with the result or the exception: on the worker's thread, or at once if it is done."""
        self._futures[future] = keep
        future.add_done_callback(self._settle)

    def cancel(self) -> None:
        """Call off what has not begun. What is being done is left, and comes to its end."""
        for future in tuple(self._futures):
            future.cancel()

    def _settle(self, future: Future[Any]) -> None:
        keep = self._futures.pop(future)
        if not future.cancelled():
            failure = future.exception()
            keep(future.result() if failure is None else failure)
