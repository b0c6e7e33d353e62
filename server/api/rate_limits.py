"""How much one client may ask for in a time: requests, streams and bytes of uploads, by its address and by its key.

Each actor has a bucket for each kind. It holds what may come at once and fills at a steady rate, so that whoever has
spent it goes on at that rate. All that is kept of a bucket is when it will be full again (the generic cell rate
algorithm of ATM networks), on a clock that nobody can set.

Addresses of this machine have no bucket: behind them is its owner, or a proxy with all its clients. Buckets are those
of one process. The module does no I/O.
"""

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Final, Literal, Self

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.access_gate import caller_of, scopes_for
from server.api.client_address import client_address
from server.api.problems import Refusal, refuse
from server.api.seats import address_key
from server.api.settings import Settings

Kind = Literal["request", "stream", "upload"]
_MOST_BUCKETS: Final = 50_000
"""Buckets of one kind that are kept, a few megabytes. Beyond that the one that was used longest ago is dropped."""
_TOLD: Final = {
    "request": "requests come too fast",
    "stream": "streams are opened too fast",
    "upload": "too much was uploaded",
}


@dataclass(frozen=True)
class Rate:
    """At most `amount` at once, and as much in every `period_s`."""

    amount: int
    period_s: float


class Buckets:
    """The buckets of all actors for one kind of thing."""

    def __init__(self, rate: Rate, *, most: int = _MOST_BUCKETS) -> None:
        self._rate = rate
        self._most = most
        self._full_s: OrderedDict[str, float] = OrderedDict()
        """By actor, when the bucket will be full again; the one that was used last comes last."""

    def __len__(self) -> int:
        return len(self._full_s)

    def wait_s(self, actor: str, amount: float, now_s: float) -> float:
        """How long an actor has to wait until `amount` may be taken; 0 if it may be now."""
        full_s = max(self._full_s.get(actor, now_s), now_s)
        return max(0.0, full_s + self._duration_s(amount) - now_s - self._rate.period_s)

    def take(self, actor: str, amount: float, now_s: float) -> None:
        """Take `amount`, also where it is more than there is."""
        full_s = max(self._full_s.pop(actor, now_s), now_s)
        self._full_s[actor] = full_s + self._duration_s(amount)
        while self._full_s and (len(self._full_s) > self._most or next(iter(self._full_s.values())) <= now_s):
            self._full_s.popitem(last=False)

    def _duration_s(self, amount: float) -> float:
        """How long `amount` takes to come in."""
        return amount / self._rate.amount * self._rate.period_s


class RateLimits:
    """The limits of a server. Belongs to the event loop."""

    def __init__(self, rates: dict[Kind, Rate], *, time_s: Callable[[], float] = time.monotonic) -> None:
        self._buckets = {kind: Buckets(rate) for kind, rate in rates.items() if rate.amount}
        self._time_s = time_s

    @classmethod
    def of(cls, settings: Settings) -> Self:
        return cls(
            {
                "request": Rate(settings.requests_per_min, 60.0),
                "stream": Rate(settings.stream_openings_per_min, 60.0),
                "upload": Rate(settings.upload_bytes_per_h, 3600.0),
            }
        )

    def refusal(self, kind: Kind, actor: str) -> Refusal | None:
        """Take one thing of a kind for an actor, or say when to come back. Uploads are only asked for; `take` counts
        their bytes."""
        buckets = self._buckets.get(kind)
        if buckets is None:
            return None
        now_s, amount = self._time_s(), int(kind != "upload")
        wait_s = buckets.wait_s(actor, amount, now_s)
        if not wait_s:
            if amount:
                buckets.take(actor, amount, now_s)
            return None
        retry_after_s = math.ceil(wait_s)
        detail = f"{_TOLD[kind]} from one address or with one key: come back in {retry_after_s} s"
        return Refusal(429, "too_many_requests", detail, (("Retry-After", str(retry_after_s)),))

    def take(self, kind: Kind, actor: str, amount: int) -> None:
        """Count what has come already."""
        if kind in self._buckets:
            self._buckets[kind].take(actor, amount, self._time_s())


def address_of(scope: Scope) -> str | None:
    """The actor by its address; None for this machine, and for what is no address."""
    address = client_address(scope)
    return None if address is None or address.is_loopback else f"address {address_key(str(address))}"


def key_of(scope: Scope) -> str | None:
    """The actor by its key or token; None without one, and for this server's own processes."""
    caller = caller_of(scope)
    return None if caller is None or caller.is_own_process else caller.name


class RateGate:
    """ASGI middleware that refuses with 429 what comes too fast from an `actor`. `open_paths` are not
    counted."""

    def __init__(
        self, app: ASGIApp, *, limits: RateLimits, actor: Callable[[Scope], str | None], open_paths: Collection[str]
    ) -> None:
        self._app = app
        self._limits = limits
        self._actor = actor
        self._open = frozenset(open_paths)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        path, actor = scope["path"].removeprefix(scope.get("root_path", "")), self._actor(scope)
        if actor is None or path in self._open:
            await self._app(scope, receive, send)
            return
        kind: Kind = "stream" if scope["type"] == "websocket" else "request"
        refusal = self._limits.refusal(kind, actor)
        is_upload = kind == "request" and scopes_for(scope["method"], path) == {"upload"}
        if refusal is None and is_upload:
            refusal = self._limits.refusal("upload", actor)
        if refusal is not None:
            await refuse(refusal, scope, receive, send)
            return

        async def receive_counted() -> Message:
            message = await receive()
            if message["type"] == "http.request":
                self._limits.take("upload", actor, len(message.get("body", b"")))
            return message

        await self._app(scope, receive_counted if is_upload else receive, send)
