"""Computation and cache of HTTP response bodies that take time to compute. A few threads compute them, at a lower
priority than the workers of streams. Bodies are cached by entity tag, which identifies a body completely.

Requests with the same tag share one computation, which is cancelled when no request waits for it any more. The kinds
of computation take turns, and within a kind the clients do. Maps never take the last thread, so that cheap requests
need not wait for them. A batch is computed part by part, each when its turn comes.

A `ResponseCache` belongs to the event loop. Computations run on its threads.
"""

import asyncio
import contextlib
import math
import time
from collections import Counter, deque
from collections.abc import AsyncGenerator, Callable, Iterable
from concurrent.futures import CancelledError
from functools import partial
from typing import Literal, Self, get_args

from server.core.bounded_cache import BoundedCache
from server.core.errors import RequestError
from server.runtime.pace import Checkpoint, CpuBudget, Pace
from server.runtime.priority import become_background
from server.runtime.thread_pool import ThreadPool

Kind = Literal["single", "batch", "map"]
"""Computations that take milliseconds, parts of a longer answer that do, and those that take seconds."""
Lookup = Literal["hit", "shared", "miss"]
"""A body is in the cache, is being computed for another request, or has to be computed."""
Compute = Callable[[Checkpoint], bytes]

_MAX_BYTES = 32 * 1024 * 1024
_NICENESS = 10
"""Niceness of the threads; the workers of streams have 5."""
_PATIENCE_S = 300.0
"""The longest map takes two minutes, and longer while streams are busy."""
_STOP_S = 1.0
_FIRST_GUESS_S = {"single": 0.05, "batch": 0.05, "map": 5.0}
_SMOOTHING = 0.3
_LONGEST_RETRY_S = 120
_MOST_CLIENTS = 256


class _Computation:
    """The computation of one body, which all requests with its entity tag wait for, or one alone if it has no tag."""

    def __init__(
        self, etag: str | None, compute: Compute, kind: Kind, client: str, *, keeps_place: bool = False
    ) -> None:
        self.etag = etag
        self.compute = compute
        self.kind: Kind = kind
        self.client = client
        """Address of the first client that asked."""
        self.keeps_place = keeps_place
        """Whether this waits although no room is left, and loses its place to nobody."""
        self.body: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self.waiters = 0
        self.is_called_off = False


class ResponseCache:
    """Computes bodies on `workers` threads; at most `waiting` computations wait for a thread. Computations pause while
    `is_urgent`, which any thread may call, says that streams need the processor, and wait until their `budget` of CPU
    time allows them. `on_refusal` is called whenever there is no room for one.

    Leaving the context cancels all computations.
    """

    def __init__(
        self,
        *,
        workers: int,
        waiting: int,
        is_urgent: Callable[[], bool] = lambda: False,
        budget: CpuBudget | None = None,
        on_refusal: Callable[[], None] = lambda: None,
    ) -> None:
        self.pool = ThreadPool(
            workers, "nafir-http", initializer=partial(become_background, _NICENESS), patience_s=_PATIENCE_S
        )
        self._most_waiting = waiting
        self._most_running = workers
        self._most_maps = max(1, workers - 1)
        self._is_urgent = is_urgent
        self._budget = budget
        self._on_refusal = on_refusal
        self._bodies: BoundedCache[str, bytes] = BoundedCache(_MAX_BYTES)
        self._by_tag: dict[str, _Computation] = {}
        self._waiting: deque[_Computation] = deque()
        self._batches: Counter[str] = Counter()
        """Batches under way, by client."""
        self._running: list[_Computation] = []
        self._turns: deque[Kind] = deque(get_args(Kind))
        self._served: dict[tuple[Kind, str], int] = {}
        """Number of the last turn of each client, by kind."""
        self._turn = 0
        self._takes_s: dict[str, float] = dict(_FIRST_GUESS_S)
        """Smoothed duration of recent computations, by kind."""
        self.lookups: Counter[Lookup] = Counter(dict.fromkeys(get_args(Lookup), 0))
        """How often a body was asked for, by how it was found."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for computation in (*self._waiting, *self._running):
            computation.is_called_off = True
        self._waiting.clear()
        self.pool.stop(_STOP_S)

    @property
    def waiting(self) -> int:
        """Number of computations that wait for a thread."""
        return len(self._waiting)

    @property
    def kept_bytes(self) -> int:
        """Total size of the bodies in the cache."""
        return self._bodies.bytes

    @property
    def retry_after_s(self) -> int:
        """Whole seconds until there is room again, estimated from the computations that run and wait."""
        pending_s = sum(self._takes_s[each.kind] for each in (*self._waiting, *self._running))
        return min(_LONGEST_RETRY_S, max(1, math.ceil(pending_s / self._most_running)))

    async def get(self, etag: str, compute: Compute, *, kind: Kind, client: str) -> bytes:
        """The cached or computed body. `client` is the client's address. If this call is cancelled, the computation
        goes on only if other requests wait for it. Raises RequestError server_busy if too many computations wait, and
        what `compute` raises."""
        if (kept := self._bodies.get(etag)) is not None:
            self.lookups["hit"] += 1
            return kept
        computation = self._by_tag.get(etag)
        self.lookups["miss" if computation is None else "shared"] += 1
        if computation is None:
            computation = self._admit(_Computation(etag, compute, kind, client))
        return await self._result(computation)

    async def batch(self, parts: Iterable[Compute], *, client: str) -> AsyncGenerator[bytes]:
        """The computed parts of one answer, which are not cached. Each is computed only when the one before has been
        taken. A batch under way keeps its place: after the first part none is refused. If the generator is closed, or
        waiting for it cancelled, nothing more is computed. Raises what `get` raises; and server_busy if as many batches
        are under way as computations may wait, or half as many of this client."""
        if self._batches.total() >= self._most_waiting or self._batches[client] >= max(1, self._most_waiting // 2):
            raise self._busy()
        self._batches[client] += 1
        try:
            for number, compute in enumerate(parts):
                computation = _Computation(None, compute, "batch", client, keeps_place=number > 0)
                yield await self._result(self._admit(computation))
        finally:
            self._batches -= Counter([client])

    async def _result(self, computation: _Computation) -> bytes:
        computation.waiters += 1
        try:
            return await asyncio.shield(computation.body)
        finally:
            computation.waiters -= 1
            if not computation.waiters and not computation.body.done():
                self._call_off(computation)

    def _admit(self, computation: _Computation) -> _Computation:
        """Queue a computation. If there is no room, the client with the most waiting computations loses its newest one,
        or this one is refused."""
        waiting = sum(not each.keeps_place for each in self._waiting)
        is_full = waiting >= self._most_waiting and not self._may_start(computation.kind)
        if is_full and not computation.keeps_place and not self._make_room(computation.client):
            raise self._busy()
        if computation.etag is not None:
            self._by_tag[computation.etag] = computation
        self._waiting.append(computation)
        self._start()
        return computation

    def _make_room(self, client: str) -> bool:
        displaceable = [each for each in self._waiting if not each.keeps_place]
        counts = Counter(each.client for each in displaceable)
        greediest, most = max(counts.items(), key=lambda item: item[1])
        if most <= counts[client] + 1:
            return False
        newest = next(each for each in reversed(displaceable) if each.client == greediest)
        self._forget(newest)
        self._waiting.remove(newest)
        newest.body.set_exception(self._busy())
        return True

    def _busy(self) -> RequestError:
        self._on_refusal()
        return RequestError(
            "server_busy",
            "too many requests wait for an answer: ask again later",
            status=503,
            retry_after_s=self.retry_after_s,
        )

    def _call_off(self, computation: _Computation) -> None:
        computation.is_called_off = True
        self._forget(computation)
        if computation in self._waiting:
            self._waiting.remove(computation)

    def _forget(self, computation: _Computation) -> None:
        """Let later requests with the same tag start a new computation."""
        if computation.etag is not None and self._by_tag.get(computation.etag) is computation:
            del self._by_tag[computation.etag]

    def _may_start(self, kind: Kind) -> bool:
        maps = sum(each.kind == "map" for each in self._running)
        return len(self._running) < self._most_running and (kind != "map" or maps < self._most_maps)

    def _start(self) -> None:
        while (computation := self._choose()) is not None:
            self._waiting.remove(computation)
            self._running.append(computation)
            self.pool.submit(partial(self._run, computation, asyncio.get_running_loop()))

    def _choose(self) -> _Computation | None:
        """The next computation: of the kind whose turn is longest ago, and of the client whose turn is longest ago."""
        for kind in tuple(self._turns):
            waiting = [each for each in self._waiting if each.kind == kind]
            if not waiting or not self._may_start(kind):
                continue
            self._turns.remove(kind)
            self._turns.append(kind)
            chosen = min(waiting, key=lambda each: self._served.get((each.kind, each.client), -1))
            if len(self._served) >= _MOST_CLIENTS:
                self._served.clear()
            self._turn += 1
            self._served[kind, chosen.client] = self._turn
            return chosen
        return None

    def _run(self, computation: _Computation, loop: asyncio.AbstractEventLoop) -> None:
        """Compute the body, on a thread of the pool."""
        began_s = time.monotonic()
        pace = Pace(is_urgent=self._is_urgent, is_wanted=lambda: not computation.is_called_off, budget=self._budget)
        body, failure = b"", None
        try:
            pace.wait()
            pace()
            body = computation.compute(pace)
        except (Exception, CancelledError) as exc:  # noqa: BLE001  raised where the body is awaited
            failure = exc
        except BaseException as exc:  # noqa: BLE001
            failure = RuntimeError(f"the computation was ended: {exc!r}")
        _post(loop, partial(self._settle, computation, body, failure, time.monotonic() - began_s))
        # The next computation waits for streams, too.
        pace.rest()
        _post(loop, partial(self._free, computation))

    def _settle(self, computation: _Computation, body: bytes, failure: BaseException | None, took_s: float) -> None:
        self._forget(computation)
        if computation.body.done() or computation.is_called_off:
            return
        if failure is not None:
            computation.body.set_exception(failure)
            return
        self._takes_s[computation.kind] += _SMOOTHING * (took_s - self._takes_s[computation.kind])
        if computation.etag is not None:
            self._bodies.put(computation.etag, body, len(body))
        computation.body.set_result(body)

    def _free(self, computation: _Computation) -> None:
        self._running.remove(computation)
        self._start()


def _post(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    with contextlib.suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(call)
