"""A cache with a limit on its size in bytes. It drops the least recently used values first."""

import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class BoundedCache(Generic[Key, Value]):
    """Holds the most recently used values, up to `max_bytes` in total. Threads may share it if they may share the
    values."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._lock = threading.Lock()
        self._entries: OrderedDict[Key, tuple[Value, int]] = OrderedDict()

    @property
    def bytes(self) -> int:
        """Total size of the values in the cache."""
        return self._bytes

    def get(self, key: Key) -> Value | None:
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                return None
            self._entries.move_to_end(key)
            return entry[0]

    def put(self, key: Key, value: Value, size_bytes: int) -> None:
        """Store a value, replace an older one of the same key, and drop the least recently used values until the rest
        fits. A value larger than the whole cache is not stored."""
        with self._lock:
            _, replaced_bytes = self._entries.pop(key, (None, 0))
            self._bytes -= replaced_bytes
            if size_bytes > self._max_bytes:
                return
            self._entries[key] = value, size_bytes
            self._bytes += size_bytes
            while self._bytes > self._max_bytes:
                _, (_, oldest_bytes) = self._entries.popitem(last=False)
                self._bytes -= oldest_bytes

    def clear(self) -> None:
        with self._lock:
            self._entries.clear()
            self._bytes = 0
