"""The processes of one server (`server.api.processes`) and their metrics, which any of them answers for all."""

import http.client
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

OWN_METRICS = "/metrics/process"
"""Where a process answers with its own metrics only."""
KEY_VARIABLE = "_NAFIR_PEERS_KEY"
"""The variable in the environment that tells a process the key of its peers."""
_PATIENCE_S = 2.0


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

    def _ask(self, number: int) -> bytes | None:
        connection = http.client.HTTPConnection("127.0.0.1", self.ports[number], timeout=_PATIENCE_S)
        try:
            headers = {} if self.key is None else {"Authorization": f"Bearer {self.key}"}
            connection.request("GET", OWN_METRICS, headers=headers)
            answer = connection.getresponse()
            return answer.read() if answer.status == http.client.OK else None
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
