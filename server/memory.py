"""How memory comes from the system and goes back to it, for a process that runs for weeks.

Streams come and go, each with megabytes of filters and spectra, on several threads. By default glibc keeps what they
leave in a heap per thread, between blocks that live longer, and raises by itself the size from which an array has
pages of its own; so a server for hostile clients (`nafir soak`) held four times what it used.

Pages of its own are fresh ones: the system clears each where it is first written, which on a virtual machine takes
longer than what is computed into it, and takes it away again on the thread that lets go. `Spares` are for what comes
and goes many times a second.
"""

import ctypes
import platform
import threading
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h
_LARGE_BYTES = 64 * 1024
"""Less than a stage of an impulse response; many times what asking for pages costs."""
_HEAPS = 2
_CACHE_LINE = 64


def give_back_large_arrays() -> bool:
    """Have arrays from 64 KiB on be pages of their own, which go back to the system with them; whether this system's
    allocator can be told so. From now on, for the whole process."""
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    settings = {_M_MMAP_THRESHOLD: _LARGE_BYTES, _M_TRIM_THRESHOLD: 2 * _LARGE_BYTES, _M_ARENA_MAX: _HEAPS}
    accepted = [libc.mallopt(name, value) for name, value in settings.items()]
    return all(accepted)


class Spares:
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
        # It may come from a collection of garbage amid `_find` on this very thread.
        if self._lock.acquire(blocking=False):
            try:
                self._waiting.append(array)
                self._bytes += array.size
                while self._bytes > self._most_bytes:
                    self._bytes -= self._waiting.popleft().size
            finally:
                self._lock.release()


class _Lent:
    """What every view of an array of spares rests on."""

    def __init__(self, spares: Spares, array: Bytes) -> None:
        self._spares = spares
        self._array = array
        self.__array_interface__: dict[str, Any] = array.__array_interface__

    def __del__(self) -> None:
        self._spares._keep(self._array)


def _aligned(size: int) -> Bytes:
    raw = np.empty(size + _CACHE_LINE, np.uint8)
    skip = -int(raw.__array_interface__["data"][0]) % _CACHE_LINE
    return raw[skip : skip + size]
