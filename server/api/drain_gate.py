"""HTTP requests during shutdown. New ones are refused; those in flight finish or are answered 503 in time."""

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from server.api.problems import problem
from server.runtime.drain import Drain
from server.runtime.racing import StoppedError, run_until

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_MESSAGE = "the server is shutting down: ask another, or again once it has restarted"
_ALWAYS_ANSWERED = frozenset({"/livez", "/readyz", "/metrics"})
"""Paths that operators watch during the shutdown."""


class DrainGate:
    """ASGI middleware around `app`. WebSockets pass, since each connection ends its stream itself."""

    def __init__(self, app: App, drain: Drain) -> None:
        self._app = app
        self._drain = drain

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"] in _ALWAYS_ANSWERED:
            await self._app(scope, receive, send)
        elif self._drain.has_begun:
            await self._refuse(scope, receive, send)
        else:
            with self._drain.in_flight():
                await self._answer(scope, receive, send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        has_started = False

        async def send_watched(message: Message) -> None:
            nonlocal has_started
            has_started = True
            await send(message)

        async def answer() -> None:
            await self._app(scope, receive, send_watched)

        try:
            await run_until(answer(), self._drain.out_of_time())
        except StoppedError:
            if not has_started:
                await self._refuse(scope, receive, send)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send) -> None:
        response = problem(503, "server_draining", _MESSAGE, retry_after_s=self._drain.retry_after_s)
        response.headers["Connection"] = "close"
        await response(scope, receive, send)
