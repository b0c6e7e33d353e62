"""Whether a server should get streams and requests, and if not, why."""

from dataclasses import dataclass, field
from typing import Literal

from server.runtime.drain import Drain
from server.runtime.thread_watch import ThreadWatch

_SOON_S = 1
"""After which it is worth asking again, where nobody knows better."""


@dataclass(frozen=True)
class Obstacle:
    """Why the server is not ready: `code` for programs, `message` for people, and when to ask again."""

    code: str
    message: str
    retry_after_s: int


@dataclass
class Readiness:
    """Ready once warmed up, unless threads fail or the server drains. Belongs to the event loop."""

    drain: Drain
    watch: ThreadWatch = field(default_factory=lambda: ThreadWatch(()))
    warm_up: Literal["under way", "done", "failed"] = "under way"

    @property
    def obstacle(self) -> Obstacle | None:
        """None where it is ready."""
        if self.drain.has_begun:
            return Obstacle("server_draining", "the server is shutting down", self.drain.retry_after_s)
        if self.warm_up == "failed":
            return Obstacle("not_ready", "the server's warm-up has failed; its log says why", _SOON_S)
        if self.warm_up == "under way":
            return Obstacle("not_ready", "the server is still warming up", _SOON_S)
        problem = self.watch.problem
        return None if problem is None else Obstacle("not_ready", problem, _SOON_S)
