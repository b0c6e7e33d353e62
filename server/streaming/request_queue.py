"""Which stream of an audio thread may request impulse responses next.

A request that waits in a long queue has outdated poses when it is answered. So there are only as many requests as keep
the workers busy, each with the newest poses, and the stream whose last request is oldest is next. Threads share the
workers without knowing each other's turns, so each uses its part of them
(`server.streaming.load_policy.requests_at_once`).
"""

from collections.abc import Iterable
from operator import attrgetter
from typing import Protocol


class Asker(Protocol):
    """The part of a stream that the queue uses."""

    @property
    def wants_turn(self) -> bool: ...

    @property
    def is_unanswered(self) -> bool:
        """Whether a request of the stream is unanswered."""

    @property
    def asked_last_s(self) -> float: ...


class RequestQueue:
    """The turns of streams to make requests, of which at most `requests` may be unanswered. First requests of emitters
    do not count: they are made at once."""

    def __init__(self, requests: int) -> None:
        self.requests = requests
        self._next: list[Asker] = []
        self._left = requests

    @property
    def are_left(self) -> bool:
        """Whether a stream that did not wait may make a request at once."""
        return self._left > 0

    def deal(self, askers: Iterable[Asker]) -> None:
        """Give this tick's turns to the waiting streams, longest wait first; the rest are left for streams that did not
        wait."""
        askers = tuple(askers)
        left = self.requests - sum(asker.is_unanswered for asker in askers)
        waiting = [asker for asker in askers if asker.wants_turn] if left > 0 else []
        self._next = sorted(waiting, key=attrgetter("asked_last_s"))[:left]
        self._left = left - len(self._next)

    def is_next(self, asker: Asker) -> bool:
        """Whether a stream has waited for its turn, which has come."""
        return asker in self._next

    def may_ask(self, asker: Asker) -> bool:
        """Whether it is the stream's turn, or there is a turn to spare."""
        return self._left > 0 or asker in self._next

    def note(self, asker: Asker) -> None:
        """Note that a stream makes a request."""
        if asker not in self._next:
            self._left -= 1
