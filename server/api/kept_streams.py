"""Streams whose connections were lost, until their clients come back: a snapshot of each, under a token.

A kept stream is no stream any more. Nothing of it is rendered, and it takes a few kilobytes; only its place on the
server may be held. So it costs nothing to keep some, and what resumes is a new stream in the state of the old one.

A token is replaced at every resume. The former one is good until the client has sent something: a client whose
connection broke before the `welcome` arrived knows no other.

A stream belongs to whoever opened it. To another caller its token is as unknown as any, and takes nothing over.

Another process of the server, at which a client resumes, is lent the stream. Its place is held here until that process
says that the stream goes on there; if it does not, the stream is kept here as before.

`KeptStreams` belongs to the event loop.
"""

import asyncio
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Self

from server.api.process_peers import MovedStream, random_token
from server.protocol.snapshot import MOST_BYTES
from server.streaming.admission import Place

_MOST_BYTES = 32 * MOST_BYTES
"""Bytes of all kept snapshots; the oldest make room for the newest."""
_PATIENCE_S = 2.0
"""How long the old connection of a stream that is taken over may take to end."""
_LENT_S = 5.0
"""How long another process may take to say what became of a stream: longer than it waits for the stream."""
_MOST_MOVED = 4096
"""Tokens of which it is known where their streams have gone; the oldest make room for the newest."""


@dataclass(eq=False)
class KeptStream:
    """A stream to go on with: its snapshot as JSON, and when the snapshot's next block would play, in seconds of the
    monotonic clock, which all processes of a machine share. `place` is held for it, if there was one to hold. One that
    a client has kept itself has no `tokens`. `lender` is the process that has lent the stream to this one."""

    data: bytes
    plays_s: float
    place: Place | None = None
    tokens: tuple[str, ...] = field(default=(), init=False)
    owner: str | None = field(default=None, init=False)
    until_s: float = field(default=0.0, init=False)
    expiry: asyncio.TimerHandle | None = field(default=None, init=False)
    lender: int | None = field(default=None, init=False)

    @classmethod
    def moved(cls, stream: MovedStream, token: str, owner: str | None) -> Self:
        """One that another process has kept under a token."""
        kept = cls(stream.data.encode(), stream.plays_s)
        kept.tokens, kept.owner, kept.until_s, kept.lender = (token,), owner, stream.until_s, stream.lender
        return kept


@dataclass(frozen=True)
class _Loan:
    """A stream that another process was given, and what takes it back."""

    kept: KeptStream
    end: asyncio.TimerHandle


@dataclass(eq=False)
class _OpenStream:
    """A stream that has a connection, which `take_over` ends."""

    tokens: tuple[str, ...]
    owner: str | None
    take_over: Callable[[], None]
    has_ended: asyncio.Event = field(default_factory=asyncio.Event)


class KeptStreams:
    """At most `most` streams, each kept for `keep_s` seconds, or none if that is 0. `give_up` is called with the place
    of a stream that did not come back, or that goes on elsewhere. `new_token` makes what nobody guesses."""

    def __init__(
        self,
        *,
        keep_s: float,
        most: int,
        give_up: Callable[[Place], None],
        new_token: Callable[[], str] = random_token,
    ) -> None:
        self.keep_s = keep_s
        self.outcomes: Counter[str] = Counter(
            dict.fromkeys(("kept", "resumed", "resumed_from_snapshot", "expired", "unknown"), 0)
        )
        """How often a stream was kept, went on, or did not come back, and how often a token was not known."""
        self._most = most
        self._give_up = give_up
        self._new_token = new_token
        self._open: dict[str, _OpenStream] = {}
        self._kept: dict[str, KeptStream] = {}
        self._order: dict[KeptStream, None] = {}
        self._bytes = 0
        self._lent: dict[str, _Loan] = {}
        self._moved: dict[str, int] = {}
        """The process to which the stream of a token has gone."""

    def __len__(self) -> int:
        return len(self._order)

    @property
    def has_places(self) -> bool:
        """Whether a place is held for a stream that may come back."""
        return any(kept.place is not None for kept in self._order)

    def open(self, take_over: Callable[[], None], *, owner: str | None = None, former: str | None = None) -> str:
        """Return the token of a stream that begins, or goes on after it was found by a `former` token. `take_over` has
        to end its connection. `owner` is the one who may resume it; None where callers are not told apart."""
        token = self._new_token()
        if former is not None:
            self._moved.pop(former, None)
        stream = _OpenStream((token,) if former is None else (token, former), owner, take_over)
        self._open.update(dict.fromkeys(stream.tokens, stream))
        return token

    def confirm(self, token: str) -> None:
        """Note that the client has the token: the former one is not valid any more."""
        stream = self._open.get(token)
        if stream is not None:
            for former in stream.tokens[1:]:
                del self._open[former]
            stream.tokens = stream.tokens[:1]

    def close(self, token: str, kept: KeptStream | None = None) -> None:
        """Note that the connection of a stream has ended; with `kept` the stream may go on. A second call changes
        nothing."""
        stream = self._open.get(token)
        if stream is None:
            return
        for each in stream.tokens:
            del self._open[each]
        if kept is not None:
            kept.tokens, kept.owner = stream.tokens, stream.owner
            kept.until_s = asyncio.get_running_loop().time() + self.keep_s
            self.outcomes["kept"] += 1
            self.put_back(kept)
        stream.has_ended.set()

    async def take(self, token: str, *, owner: str | None = None) -> KeptStream | None:
        """Return the stream of a token, which is not kept any more then; None if there is none, or if it is not the
        `owner`'s. If the stream has a connection, it is taken over."""
        stream = self._open.get(token)
        if stream is not None and stream.owner == owner:
            stream.take_over()
            try:
                async with asyncio.timeout(_PATIENCE_S):
                    await stream.has_ended.wait()
            except TimeoutError:
                pass
        kept = self._kept.get(token)
        if kept is None or kept.owner != owner:
            return None
        self._remove(kept)
        return kept

    async def lend(self, token: str, *, owner: str | None) -> KeptStream | None:
        """As `take`, for another process. Unless `settle` follows, the stream is put back."""
        kept = await self.take(token, owner=owner)
        if kept is not None:
            end = asyncio.get_running_loop().call_later(_LENT_S, partial(self.settle, token, is_resumed=False))
            self._lent[token] = _Loan(kept, end)
        return kept

    def settle(self, token: str, *, by: int | None = None, is_resumed: bool) -> None:
        """Note whether a stream that was lent goes on at the process `by`, even if that is told late."""
        loan = self._lent.pop(token, None)
        if loan is not None:
            loan.end.cancel()
        if not is_resumed:
            if loan is not None:
                self.put_back(loan.kept)
            return
        kept = self._kept.get(token) if loan is None else loan.kept
        if kept is None:
            return
        if loan is None:
            self._remove(kept)
        if kept.place is not None:
            self._give_up(kept.place)
        if by is not None:
            self._moved.update(dict.fromkeys(kept.tokens, by))
        while len(self._moved) > _MOST_MOVED:
            del self._moved[next(iter(self._moved))]

    def moved_to(self, token: str) -> int | None:
        """The process to which the stream of a token has gone; None if that is not known."""
        return self._moved.get(token)

    def put_back(self, kept: KeptStream) -> None:
        """Keep a stream that could not go on, as long as it was to be kept."""
        if not kept.tokens:
            return
        loop = asyncio.get_running_loop()
        self._kept.update(dict.fromkeys(kept.tokens, kept))
        self._order[kept] = None
        self._bytes += len(kept.data)
        kept.expiry = loop.call_at(kept.until_s, self._expire, kept)
        while len(self._order) > self._most or self._bytes > _MOST_BYTES:
            self._expire(next(iter(self._order)))

    def _expire(self, kept: KeptStream) -> None:
        self.outcomes["expired"] += 1
        self._remove(kept)
        if kept.place is not None:
            self._give_up(kept.place)

    def _remove(self, kept: KeptStream) -> None:
        for each in kept.tokens:
            del self._kept[each]
        del self._order[kept]
        self._bytes -= len(kept.data)
        if kept.expiry is not None:
            kept.expiry.cancel()
            kept.expiry = None
