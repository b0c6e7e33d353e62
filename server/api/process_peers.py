"""The processes of one server (`server.api.processes`) as one to their clients: any of them answers with the metrics of
all, and goes on with a stream that another has kept."""

import hmac
import http.client
import json
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Self

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

OWN_METRICS = "/metrics/process"
"""Where a process answers with its own metrics only."""
OWN_STREAMS = "/streams/process"
"""Where a process gives a stream that it has kept to another, which shows `PEER_KEY`."""
PEER_KEY = "X-Nafir-Process-Key"
"""The header with the key of the processes, where every request counts, also where callers need no key."""
KEY_VARIABLE = "_NAFIR_PEERS_KEY"
"""The variable in the environment that tells a process the key of its peers."""
_PATIENCE_S = 2.0
_PATIENCE_FOR_STREAMS_S = 4.0
"""Longer than a process waits for the connection of a stream that is taken over."""


@dataclass(frozen=True)
class MovedStream:
    """What a process tells of a stream that it has kept (`server.api.kept_streams`), by the monotonic clock, which all
    processes of a machine share."""

    data: bytes
    plays_s: float
    until_s: float

    def serialize(self) -> bytes:
        told = {"data": self.data.decode(), "plays_s": self.plays_s, "until_s": self.until_s}
        return json.dumps(told).encode()

    @classmethod
    def parse(cls, text: bytes) -> Self:
        told = json.loads(text)
        return cls(told["data"].encode(), told["plays_s"], told["until_s"])


@dataclass(frozen=True)
class ProcessPeers:
    """A process of a server: its `number`, at which port of the loopback interface each of them answers, and the `key`
    that they ask each other with."""

    number: int
    ports: tuple[int, ...]
    key: str | None = field(default=None, repr=False)

    def gather(self, own: bytes) -> bytes:
        """The metrics of all processes, with the label `process`; `own` are those of this one. A process that does not
        answer within two seconds is left out. This waits for the network."""
        others = [number for number in range(len(self.ports)) if number != self.number]
        with ThreadPoolExecutor(len(others) or 1, "nafir-metrics") as asking:
            answers = dict(zip(others, asking.map(self._ask, others), strict=True))
        return merged({**answers, self.number: own})

    def is_peer(self, key: str | None) -> bool:
        """Whether a request with this key comes from another of the processes."""
        return self.key is not None and key is not None and hmac.compare_digest(key.encode(), self.key.encode())

    def take(self, token: str, owner: str | None) -> MovedStream | None:
        """The stream of a token that another process has, which has it no more then; None if none has. This waits for
        the network."""
        others = [number for number in range(len(self.ports)) if number != self.number]
        body = json.dumps({"token": token, "owner": owner}).encode()
        with ThreadPoolExecutor(len(others) or 1, "nafir-streams") as asking:
            answers = asking.map(lambda number: self._request(number, "POST", OWN_STREAMS, body), others)
            return next((MovedStream.parse(answer) for answer in answers if answer), None)

    def _ask(self, number: int) -> bytes | None:
        return self._request(number, "GET", OWN_METRICS)

    def _request(self, number: int, method: str, path: str, body: bytes | None = None) -> bytes | None:
        patience_s = _PATIENCE_S if body is None else _PATIENCE_FOR_STREAMS_S
        connection = http.client.HTTPConnection("127.0.0.1", self.ports[number], timeout=patience_s)
        try:
            headers = {} if self.key is None else {"Authorization": f"Bearer {self.key}", PEER_KEY: self.key}
            if body is not None:
                headers["Content-Type"] = "application/json"
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            return answer.read() if answer.status in {http.client.OK, http.client.NO_CONTENT} else None
        except (OSError, http.client.HTTPException):
            return None
        finally:
            connection.close()


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
