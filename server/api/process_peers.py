"""The processes of one server (`server.api.processes`) as one to their clients: any of them answers with the metrics of
all, and goes on with a stream that another has kept.

A token says which process gave it, and bears a tag (HMAC) that only the processes can make. So one process is asked
for a stream, and none for a token that a client has made up.
"""

import asyncio
import base64
import hashlib
import hmac
import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample
from pydantic import BaseModel

Ending = Literal["died", "hung"]
"""Why a process was replaced: it ended by itself, or was ended since its event loop did nothing any more."""
OWN_METRICS = "/metrics/process"
"""Where a process answers with its own metrics only."""
OWN_STREAMS = "/streams/process"
"""Where a process gives a stream that it has kept to another, which shows `PEER_KEY`."""
PEER_KEY = "X-Nafir-Process-Key"
"""The header with the key of the processes, where every request counts, also where callers need no key."""
KEY_VARIABLE = "_NAFIR_PEERS_KEY"
"""The variable in the environment that tells a process the key of its peers."""
_TOKEN_BYTES: Final = 24
_TAG_BYTES: Final = 12
_LIVE: Final = "/livez"
_ANSWERS_WITHIN_S: Final = 1.0
"""How long a process may take to show that it answers at all. One that is being started accepts connections before it
does: its socket is its parent's."""
_METRICS_WITHIN_S: Final = 2.0
_STREAM_WITHIN_S: Final = 4.0
"""Longer than a process waits for the connection of a stream that is taken over."""
_MOST_ANSWER_BYTES: Final = 2**24


@dataclass(frozen=True)
class MovedStream:
    """What a process tells of a stream that it has kept (`server.api.kept_streams`), by the monotonic clock, which all
    processes of a machine share. `lender` is that process."""

    data: str
    plays_s: float
    until_s: float
    lender: int


class AskedStream(BaseModel):
    """A process, `by` its number, asks for the stream of a token."""

    token: str
    owner: str | None
    by: int


class SettledStream(BaseModel):
    """A process, `by` its number, tells whether the stream that it was given goes on there."""

    token: str
    by: int
    is_resumed: bool


class ToldStream(BaseModel):
    """The answer to `AskedStream`: the stream, or the process to which it has moved, or neither."""

    stream: MovedStream | None = None
    moved_to: int | None = None


def random_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


@dataclass(frozen=True)
class ProcessPeers:
    """A process of a server: its `number`, at which port of the loopback interface each of them answers, the `key` that
    they ask each other with, and how often those before it of this number have ended."""

    number: int
    ports: tuple[int, ...]
    key: str | None = field(default=None, repr=False)
    endings: Mapping[Ending, int] = field(default_factory=dict)

    async def gather(self, own: bytes) -> dict[int, bytes | None]:
        """The metrics of all processes by number; `own` are those of this one. A process that does not answer within
        two seconds has None."""
        others = [number for number in range(len(self.ports)) if number != self.number]
        answers = await asyncio.gather(*(self._metrics(number) for number in others))
        return {**dict(zip(others, answers, strict=True)), self.number: own}

    def is_peer(self, key: str | None) -> bool:
        """Whether a request with this key comes from another of the processes."""
        return self.key is not None and key is not None and hmac.compare_digest(key.encode(), self.key.encode())

    def new_token(self) -> str:
        """A token for a stream of this process."""
        if self.key is None:
            return random_token()
        told = f"{self.number}.{random_token()}"
        return f"{told}.{self._tag(told)}"

    def home_of(self, token: str) -> int | None:
        """The process that gave a token; None if none has."""
        told, _, tag = token.rpartition(".")
        # guard: for a token that a client has made up nobody is asked
        if self.key is None or not hmac.compare_digest(tag.encode(), self._tag(told).encode()):
            return None
        return int(told.partition(".")[0])

    async def take(self, token: str, owner: str | None, number: int | None) -> MovedStream | None:
        """The stream of a token from the process of a `number`, or from the one to which it has moved; None if it is
        not there. The process keeps it until it learns what became of it (`settle`)."""
        body = AskedStream(token=token, owner=owner, by=self.number).model_dump_json().encode()
        for _ in self.ports:
            if number is None or number == self.number or not 0 <= number < len(self.ports):
                return None
            told = await self._request(number, "POST", OWN_STREAMS, body)
            if told is None:
                return None
            answer = ToldStream.model_validate_json(told)
            if answer.stream is not None:
                return answer.stream
            number = answer.moved_to
        return None

    async def settle(self, number: int, token: str, *, is_resumed: bool) -> None:
        """Tell the process of a `number` whether the stream that it gave goes on here."""
        told = SettledStream(token=token, by=self.number, is_resumed=is_resumed)
        await self._request(number, "PUT", OWN_STREAMS, told.model_dump_json().encode())

    def _tag(self, told: str) -> str:
        assert self.key is not None
        tag = hmac.digest(self.key.encode(), told.encode(), hashlib.sha256)[:_TAG_BYTES]
        return base64.urlsafe_b64encode(tag).decode()

    async def _metrics(self, number: int) -> bytes | None:
        return await self._request(number, "GET", OWN_METRICS)

    async def _request(self, number: int, method: str, path: str, body: bytes | None = None) -> bytes | None:
        """The body of an answer; None if there is none in time, or if it is a refusal."""
        writer = None
        try:
            async with asyncio.timeout(_ANSWERS_WITHIN_S):
                reader, writer = await asyncio.open_connection("127.0.0.1", self.ports[number])
                await self._exchange(reader, writer, "GET", _LIVE, b"")
            async with asyncio.timeout(_METRICS_WITHIN_S if body is None else _STREAM_WITHIN_S):
                return await self._exchange(reader, writer, method, path, body or b"")
        except (OSError, EOFError, ValueError):  # TimeoutError is an OSError
            return None
        finally:
            if writer is not None:
                writer.close()

    async def _exchange(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, method: str, path: str, body: bytes
    ) -> bytes | None:
        """The body of an answer; None for a refusal. Raises OSError, EOFError, or ValueError for one that is none."""
        headers = {"Host": "127.0.0.1", "Content-Length": str(len(body))}
        if body:
            headers["Content-Type"] = "application/json"
        if self.key is not None:
            headers |= {"Authorization": f"Bearer {self.key}", PEER_KEY: self.key}
        lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items()), "", ""]
        writer.write("\r\n".join(lines).encode() + body)
        await writer.drain()
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        status = int(head[0].split()[1])
        told = {name.lower(): value for name, _, value in (line.partition(":") for line in head[1:])}
        size = int(told.get("content-length", 0))
        if size > _MOST_ANSWER_BYTES:
            raise ValueError("the answer is too long")
        answer = await reader.readexactly(size)
        return answer if status in {200, 204} else None


def merged(texts: Mapping[int, bytes | None]) -> bytes:
    """The metrics of processes by number in one text; None is a process that does not answer."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Merged(texts))
    return generate_latest(registry)


class _Merged(Collector):
    def __init__(self, texts: Mapping[int, bytes | None]) -> None:
        self._texts = texts

    def collect(self) -> Iterator[Metric]:
        up = GaugeMetricFamily("nafir_process_up", "1 if the process answers.", labels=["process"])
        families: dict[str, Metric] = {}
        for number, text in sorted(self._texts.items()):
            up.add_metric([str(number)], text is not None)
            for family in text_string_to_metric_families((text or b"").decode()):
                known = families.setdefault(family.name, Metric(family.name, family.documentation, family.type))
                known.samples += [_labelled(sample, number) for sample in family.samples]
        yield up
        yield from families.values()


def _labelled(sample: Sample, number: int) -> Sample:
    return sample._replace(labels={"process": str(number), **sample.labels})
