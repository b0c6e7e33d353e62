"""Whether the server is ready for streams and requests, and the reason if it is not."""

from dataclasses import dataclass, field
from typing import Literal

from server.runtime.drain import Drain
from server.runtime.thread_watch import ThreadWatch

_SOON_S = 1
"""Retry-After of an unready server that cannot tell when it will be ready."""


@dataclass(frozen=True)
class Obstacle:
    """The reason why the server is not ready: `code` is for programs, `message` for people."""

    code: str
    message: str
    retry_after_s: int


@dataclass
class Readiness:
    """The server is ready once it is warmed up, unless threads fail or it shuts down. Belongs to the event loop."""

    drain: Drain
    watch: ThreadWatch = field(default_factory=lambda: ThreadWatch(()))
    warm_up: Literal["under way", "done", "failed"] = "under way"

    @property
    def obstacle(self) -> Obstacle | None:
        """Why the server is not ready; None if it is."""
        if self.drain.has_begun:
            return Obstacle("server_draining", "the server is shutting down", self.drain.retry_after_s)
        if self.warm_up == "failed":
            return Obstacle("not_ready", "the server's warm-up has failed; its log says why", _SOON_S)
        if self.warm_up == "under way":
            return Obstacle("not_ready", "the server is still warming up", _SOON_S)
        problem = self.watch.problem
        return None if problem is None else Obstacle("not_ready", problem, _SOON_S)
