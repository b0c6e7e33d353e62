"""Which of an audio thread's streams asks for impulse responses next.

A request that waits in a long queue is of poses long gone when it is answered. So only as many are made as keep the
workers busy, each of the newest poses, and the stream that has not asked for longest is next. Threads share workers and
know nothing of each other's turns: each counts on its part of them (`server.streaming.load_policy.requests_at_once`).
"""

from collections.abc import Iterable
from operator import attrgetter
from typing import Protocol


class Asker(Protocol):
    """A stream, as far as it asks."""

    @property
    def wants_turn(self) -> bool: ...

    @property
    def is_unanswered(self) -> bool:
        """Whether it has asked, and no answer has come."""

    @property
    def asked_last_s(self) -> float: ...


class RequestQueue:
    """At most so many `requests` are unanswered, but for first ones of emitters, which are asked for at once."""

    def __init__(self, requests: int) -> None:
        self.requests = requests
        self._next: list[Asker] = []
        self._left = requests

    @property
    def are_left(self) -> bool:
        """Whether a stream that comes now may ask at once."""
        return self._left > 0

    def deal(self, askers: Iterable[Asker]) -> None:
        """Give this tick's turns to the streams that wait, longest first; what is left is for those that come."""
        askers = tuple(askers)
        left = self.requests - sum(asker.is_unanswered for asker in askers)
        waiting = [asker for asker in askers if asker.wants_turn] if left > 0 else []
        self._next = sorted(waiting, key=attrgetter("asked_last_s"))[:left]
        self._left = left - len(self._next)

    def is_next(self, asker: Asker) -> bool:
        """Whether it has waited for its turn, and that has come."""
        return asker in self._next

    def may_ask(self, asker: Asker) -> bool:
        """Whether it is its turn, or there is one to spare."""
        return self._left > 0 or asker in self._next

    def note(self, asker: Asker) -> None:
        """It asks."""
        if asker not in self._next:
            self._left -= 1
