"""Large arrays that come and go many times a second, without asking the system for pages each time.

Fresh pages are cleared where they are first written, which on a virtual machine takes longer than what is computed into
them, and are taken away again on the thread that lets go.
"""

import math
import threading
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from server.kernels.cache_lines import LINE_BYTES

Bytes = npt.NDArray[np.uint8]

_LARGE_BYTES = 96 * 1024
"""From which on arrays have pages of their own (`server.runtime.memory`)."""
_FEWEST = 2
"""Arrays of the largest size that may wait."""


class ArrayPool:
    """Arrays that were let go of, for the next that are as large; at most `most_bytes` wait for that.

    Any thread may take one and let go of it, and none waits for another: where two meet, one does without.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._waiting: deque[Bytes] = deque()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Of those that wait."""
        return self._bytes

    def take(self, size: int) -> Bytes:
        """(size,) of anything, at the start of a cache line. It comes back by itself, once no view of it is left."""
        if size < _LARGE_BYTES:
            return _aligned(size)
        found = self._find(size)
        return np.asarray(_Lent(self, _aligned(size) if found is None else found))

    def floats(self, *shape: int) -> npt.NDArray[np.float32]:
        """As `take`."""
        return self.take(math.prod(shape) * np.dtype(np.float32).itemsize).view(np.float32).reshape(shape)

    def _find(self, size: int) -> Bytes | None:
        if self._lock.acquire(blocking=False):
            try:
                # The newest first: it may still be in a cache.
                for back in range(1, len(self._waiting) + 1):
                    if self._waiting[-back].size == size:
                        found = self._waiting[-back]
                        del self._waiting[-back]
                        self._bytes -= size
                        return found
            finally:
                self._lock.release()
        return None

    def _keep(self, array: Bytes) -> None:
        if array.size > self._most_bytes // _FEWEST:
            return  # it would drive out all the others
        superfluous = []  # let go of without the lock
        # It may come from a collection of garbage amid `_find` on this very thread.
        if self._lock.acquire(blocking=False):
            try:
                self._waiting.append(array)
                self._bytes += array.size
                while self._bytes > self._most_bytes:
                    superfluous.append(self._waiting.popleft())
                    self._bytes -= superfluous[-1].size
            finally:
                self._lock.release()


class _Lent:
    """What every view of an array of a pool rests on."""

    def __init__(self, pool: ArrayPool, array: Bytes) -> None:
        self._pool = pool
        self._array = array
        self.__array_interface__: dict[str, Any] = array.__array_interface__

    def __del__(self) -> None:
        self._pool._keep(self._array)


def _aligned(size: int) -> Bytes:
    raw = np.empty(size + LINE_BYTES, np.uint8)
    skip = -int(raw.__array_interface__["data"][0]) % LINE_BYTES
    return raw[skip : skip + size]
