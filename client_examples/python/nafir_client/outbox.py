"""Messages that wait to be sent, in order. Of poses and acknowledgements only the newest waits."""

from collections.abc import Hashable


class Outbox:
    """A queue whose messages may have a key: a newer message takes the place of an older one with the same key, and
    goes to the end, so that pose ids rise."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, str | bytes] = {}
        self._count = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, message: str | bytes, key: Hashable | None = None) -> None:
        if key is None:
            self._count += 1
            key = self._count
        self._waiting.pop(key, None)
        self._waiting[key] = message

    def take(self) -> str | bytes | None:
        """The oldest message; None if none waits."""
        if not self._waiting:
            return None
        return self._waiting.pop(next(iter(self._waiting)))

    def clear(self) -> None:
        self._waiting.clear()
