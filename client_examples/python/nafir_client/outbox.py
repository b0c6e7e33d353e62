"""Messages that wait to be sent, in order. Of poses and acknowledgements only the newest waits.

A server that resumes a stream says how many messages it has handled, of those that are *counted*: texts that change
something and are not poses. They are kept after they were sent, until a snapshot covers them, so that the others can be
sent again.
"""

from collections import deque
from collections.abc import Hashable, Iterable, Set
from dataclasses import dataclass
from typing import Final, Literal

Thing = tuple[Literal["emitter", "listener"], str]
"""The kind and the id of an emitter or listener."""
_MOST_KEPT: Final = 1_000
"""Counted messages that are kept."""


@dataclass(eq=False)
class Outgoing:
    """A message. `about` is the emitter or listener that it adds, if it `adds` one, or changes. Once that has ended by
    itself, the message `is_over`, and is not sent again."""

    data: str | bytes
    is_counted: bool = False
    about: Thing | None = None
    adds: bool = False
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
    def adds(self) -> set[Thing]:
        """What waiting messages add."""
        return {message.about for message in self._waiting.values() if message.adds and message.about is not None}

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

    def end(self, thing: Thing) -> None:
        """It has ended by itself. What added it, and what was said about it since, is over."""
        _end(self._sent, thing)

    def forget(self, handled: int) -> None:
        """The first so many counted messages need not be sent again."""
        while self._sent and self._sent_count - len(self._sent) < handled:
            self._sent.popleft()

    def resume(self, handled: int, played: Set[Thing] = frozenset()) -> set[Thing]:
        """The server has handled so many counted messages of this stream. The others wait again, before all else, but
        for those that are over. So are, of things in `played` that the server lacks, what would add them and what was
        said about them since. Returns those things."""
        assert self.can_resume(handled)
        lost = max(0, self._sent_count - handled)
        again = [self._sent.pop() for _ in range(lost)][::-1]
        self._sent_count -= lost
        self.put_first([message for message in again if not message.is_over])
        lacking = self.adds & played
        for thing in lacking:
            _end(self._waiting.values(), thing)
        self._waiting = {key: message for key, message in self._waiting.items() if not message.is_over}
        return lacking


def _end(messages: Iterable[Outgoing], thing: Thing) -> None:
    """The newest of the messages that adds a thing, and those about it after that, are over."""
    since: list[Outgoing] = []
    for message in messages:
        if message.about == thing and (since or message.adds):
            since = [message] if message.adds else [*since, message]
    for message in since:
        message.is_over = True
