"""Messages that wait to be sent, in order. Of poses and acknowledgements only the newest waits.

A server that resumes a stream says how many messages it has handled, of those that are *counted*: texts that change
something and are not poses. They are kept after they were sent, until a snapshot covers them, so that the others can be
sent again.
"""

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, replace
from typing import Final, Literal

Added = Literal["emitter", "listener"]
_MOST_KEPT: Final = 1_000
"""Counted messages that are kept."""


@dataclass(frozen=True)
class Outgoing:
    """A message. `adds` is what it adds, if it does: the kind and the id of an emitter or listener. Once that has ended
    by itself, the message `is_over`, and is not sent again."""

    data: str | bytes
    is_counted: bool = False
    adds: tuple[Added, str] | None = None
    is_over: bool = False


class Outbox:
    """A queue whose messages may have a key: a newer message takes the place of an older one with the same key, and
    goes to the end, so that pose ids rise."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Outgoing] = {}
        self._number = 0
        self._sent: deque[Outgoing] = deque(maxlen=_MOST_KEPT)
        self._sent_count = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, message: Outgoing, key: Hashable | None = None) -> None:
        if key is None:
            self._number += 1
            key = self._number
        self._waiting.pop(key, None)
        self._waiting[key] = message

    def take(self) -> str | bytes | None:
        """The oldest message; None if none waits."""
        if not self._waiting:
            return None
        message = self._waiting.pop(next(iter(self._waiting)))
        if message.is_counted:
            self._sent.append(message)
            self._sent_count += 1
        return message.data

    @property
    def adds(self) -> set[tuple[Added, str]]:
        """Kinds and ids of what waiting messages add."""
        return {message.adds for message in self._waiting.values() if message.adds is not None}

    def begin(self) -> None:
        """A new stream begins, of which nothing waits and nothing was sent."""
        self._waiting.clear()
        self._sent.clear()
        self._sent_count = 0

    def put_first(self, messages: list[Outgoing]) -> None:
        """Put messages before those that wait."""
        waiting = self._waiting
        self._waiting = {}
        for message in messages:
            self.put(message)
        self._waiting |= waiting

    def can_resume(self, handled: int) -> bool:
        """Whether all counted messages but the first so many are still there."""
        return self._sent_count - handled <= len(self._sent)

    def end(self, added: tuple[Added, str]) -> None:
        """What the newest message with these `adds` has added has ended by itself."""
        for index in reversed(range(len(self._sent))):
            if self._sent[index].adds == added:
                self._sent[index] = replace(self._sent[index], is_over=True)
                return

    def forget(self, handled: int) -> None:
        """The first so many counted messages need not be sent again."""
        while self._sent and self._sent_count - len(self._sent) < handled:
            self._sent.popleft()

    def resume(self, handled: int) -> None:
        """The server has handled so many counted messages of this stream. The others wait again, before all else."""
        assert self.can_resume(handled)
        lost = max(0, self._sent_count - handled)
        again = [self._sent.pop() for _ in range(lost)][::-1]
        self._sent_count -= lost
        self.put_first([message for message in again if not message.is_over])
