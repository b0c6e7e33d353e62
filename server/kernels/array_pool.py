"""A pool of large arrays that are needed many times a second, without requesting pages from the system each time.

The system clears fresh pages when they are first written, which on a virtual machine takes longer than the computation
that fills them. It also unmaps them on the thread that frees the array.
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
"""Arrays from this size on have pages of their own (`server.runtime.memory`)."""
_FLOAT_BYTES = 4
_FEWEST = 2
"""The pool has room for at least this many arrays of the largest size that it keeps."""


class ArrayPool:
    """Keeps freed arrays and reuses them for requests of the same size; at most `most_bytes` are kept.

    Any thread may take and free arrays, and no thread waits for another: if two threads access the pool at once, one
    goes without it.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._waiting: deque[_Memory] = deque()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """The size of the arrays that are kept for reuse."""
        return self._bytes

    def take(self, size: int) -> Bytes:
        """An uninitialised array (size,) that begins on a cache line. It returns to the pool by itself when its last
        view is gone."""
        return (
            _aligned(size)
            if size < _LARGE_BYTES
            else np.asarray(_Lent(self, self._find(size) or _Memory(size), "|u1", (size,)))
        )

    def floats(self, *shape: int) -> npt.NDArray[np.float32]:
        """As `take`, for float32 of any shape."""
        size = math.prod(shape) * _FLOAT_BYTES
        if size < _LARGE_BYTES:
            return _aligned(size).view(np.float32).reshape(shape)
        return np.asarray(_Lent(self, self._find(size) or _Memory(size), "<f4", shape))

    def _find(self, size: int) -> "_Memory | None":
        if self._lock.acquire(blocking=False):
            try:
                # Try the newest first: it may still be in a cache.
                for back in range(1, len(self._waiting) + 1):
                    if self._waiting[-back].size == size:
                        found = self._waiting[-back]
                        del self._waiting[-back]
                        self._bytes -= size
                        return found
            finally:
                self._lock.release()
        return None

    def _keep(self, memory: "_Memory") -> None:
        if memory.size > self._most_bytes // _FEWEST:
            return  # too large: it would displace all the others
        superfluous = []  # freed after the lock is released
        # The garbage collector may call this during `_find`, on this very thread.
        if self._lock.acquire(blocking=False):
            try:
                self._waiting.append(memory)
                self._bytes += memory.size
                while self._bytes > self._most_bytes:
                    superfluous.append(self._waiting.popleft())
                    self._bytes -= superfluous[-1].size
            finally:
                self._lock.release()


class _Memory:
    """`size` bytes, and how NumPy last saw them: mostly an array is needed again as it was."""

    __slots__ = ("_array", "interface", "size")

    def __init__(self, size: int) -> None:
        self.size = size
        self._array = _aligned(size)
        self.interface: dict[str, Any] = dict(self._array.__array_interface__)


class _Lent:
    """The base object of all views of an array from a pool; when it is deleted, the memory returns to the pool."""

    __slots__ = ("__array_interface__", "_memory", "_pool")

    def __init__(self, pool: ArrayPool, memory: _Memory, kind: str, shape: tuple[int, ...]) -> None:
        """NumPy sees it as an array of a `kind` and a `shape`, in a third of the time of two views."""
        self._pool = pool
        self._memory = memory
        interface = memory.interface
        if interface["shape"] != shape or interface["typestr"] != kind:
            interface = {"data": interface["data"], "shape": shape, "typestr": kind, "version": 3}
            memory.interface = interface
        self.__array_interface__ = interface

    def __del__(self) -> None:
        self._pool._keep(self._memory)


def _aligned(size: int) -> Bytes:
    raw = np.empty(size + LINE_BYTES, np.uint8)
    skip = -int(raw.__array_interface__["data"][0]) % LINE_BYTES
    return raw[skip : skip + size]
