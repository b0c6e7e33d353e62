"""Traces by OpenTelemetry: what a request or the opening of a stream spent its time on, across services.

They are off until `begin_traces` is called, and a `span` then costs a comparison. Spans become children of the caller's
where its headers name one (`traceparent`, W3C Trace Context). They hold no positions, keys or queries.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from server.core.errors import NafirError

Attribute = str | int | float | bool


class Span(Protocol):
    """A piece of work that is being timed."""

    def set_attribute(self, key: str, value: Attribute) -> None:
        """Note something about the work."""

    def update_name(self, name: str) -> None:
        """Name the work, now that it is known what it is."""


class _NoSpan:
    def set_attribute(self, key: str, value: Attribute) -> None:
        pass

    def update_name(self, name: str) -> None:
        pass


_NO_SPAN = _NoSpan()


class _InForce:
    tracer: Any = None
    """What begins spans; None while traces are off."""


def begin_traces(url: str, *, exporter: Any = None) -> Callable[[], None]:
    """Send spans to `url` by OTLP over HTTP, or to `exporter`, from now on. Call what this returns at the end: it sends
    what waits. Raises NafirError if the extra `otel` is not installed."""
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as exc:
        raise NafirError("traces_url: traces need `pip install 'nafir[otel]'`") from exc
    provider = TracerProvider(resource=Resource.create({"service.name": "nafir"}))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=url) if exporter is None else exporter))
    _InForce.tracer = provider.get_tracer("nafir")

    def end() -> None:
        _InForce.tracer = None
        provider.shutdown()

    return end


@contextlib.contextmanager
def span(
    name: str, attributes: Mapping[str, Attribute] | None = None, *, headers: Mapping[str, str] | None = None
) -> Iterator[Span]:
    """Time a piece of work of this task. With the `headers` of a request, it may be part of the caller's trace. An
    exception is noted in the span and goes on."""
    if _InForce.tracer is None:
        yield _NO_SPAN
        return
    parent = None
    if headers is not None:
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        parent = TraceContextTextMapPropagator().extract(headers)
    with _InForce.tracer.start_as_current_span(name, context=parent, attributes=attributes) as begun:
        yield begun
