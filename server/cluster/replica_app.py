"""The application as one of several replicas behind a router that starts, asks and ends them.

It differs from a single server in three ways. It is started only when it is warmed up, so that no client is sent to a
replica that refuses it. State that an application shares with its requests is handed to them here, since a router does
not. And it can be asked how much of it is free, and told to drain: then one stream after the other ends on a block with
`server_draining`, and its client comes back at once, to another replica.
"""

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from server.api.app import create_app
from server.api.connection import StreamHost
from server.api.settings import Settings
from server.core.errors import NafirError
from server.runtime.drain import Drain

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_POLL_S = 0.05
"""Seconds between looks at whether the warm-up is done."""


class ReplicaError(NafirError):
    """A replica that cannot serve. Its message says why."""


class ReplicaApp:
    """ASGI application of a replica. Belongs to the event loop."""

    def __init__(self, settings: Settings, *, build: Callable[..., App] = create_app) -> None:
        """`build` takes the settings and a `drain`, and makes the application."""
        self._drain = Drain(settings.drain_s, in_turn=True)
        self._app = build(settings, drain=self._drain)
        self._state: dict[str, Any] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._live(scope, receive, send)
        else:
            await self._app({**scope, "state": {**scope.get("state", {}), **self._state}}, receive, send)

    async def _live(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the lifespan on, and say that the application has started once it is warmed up."""
        state: dict[str, Any] = {}

        async def send_when_warm(message: Message) -> None:
            if message["type"] == "lifespan.startup.complete":
                self._state = state
                await self._warmed_up()
            await send(message)

        await self._app({**scope, "state": state}, receive, send_when_warm)

    async def _warmed_up(self) -> None:
        """Return when the warm-up is done. Raises ReplicaError if it fails."""
        readiness = self._host.readiness
        while readiness.warm_up == "under way":  # noqa: ASYNC110  once, at the start
            await asyncio.sleep(_POLL_S)
        self.require_working()

    @property
    def _host(self) -> StreamHost:
        host: StreamHost = self._state["host"]
        return host

    def require_working(self) -> None:
        """Raises ReplicaError if the replica will not serve any more, and does not drain: it is to be replaced."""
        obstacle = self._host.readiness.obstacle
        if obstacle is not None and not self._drain.has_begun:
            raise ReplicaError(obstacle.message)

    @property
    def headroom(self) -> float:
        """Share of the replica, from 0 to 1, that is free for more streams."""
        return self._host.admission.headroom

    @property
    def streams(self) -> int:
        """Streams that are open, or being opened."""
        return self._host.admission.streams

    def begin_drain(self) -> None:
        """Accept nothing new, and end one stream after the other."""
        self._drain.begin()
