"""Spans of requests and streams, and that they begin nowhere and hold nothing that they should not."""

import sys
import time

import pytest
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from starlette.testclient import TestClient

from server.api.app import create_app
from server.api.settings import Settings
from server.core.errors import NafirError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, Hello
from server.runtime.traces import begin_traces, span

URL = "http://127.0.0.1:9/v1/traces"


@pytest.fixture
def traced():
    """Ends traces, and returns the spans there were, by name."""
    exporter = InMemorySpanExporter()
    end = begin_traces(URL, exporter=exporter)
    yield lambda: (end(), {each.name: each for each in exporter.get_finished_spans()})[1]
    end()


def test_a_span_has_what_was_said_of_it_and_the_exception_that_ended_it(traced):
    def fail():
        with span("inner") as inner:
            inner.set_attribute("count", 3)
            raise ValueError("no")

    with span("outer", {"nafir.kind": "map"}), pytest.raises(ValueError, match="no"):
        fail()
    spans = traced()
    assert dict(spans["outer"].attributes) == {"nafir.kind": "map"}
    assert spans["inner"].parent.span_id == spans["outer"].context.span_id
    assert dict(spans["inner"].attributes) == {"count": 3}
    assert [event.name for event in spans["inner"].events] == ["exception"]


def test_without_traces_a_span_is_nothing():
    with span("outer") as outer:
        outer.set_attribute("count", 3)
        outer.update_name("other")


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(NafirError, match=r"traces_url: .*nafir\[otel\]"):
        create_app(Settings(traces_url=URL))


@pytest.mark.timed
def test_requests_and_streams_are_parts_of_their_callers_traces(traced, bundle, hrtfs):
    caller = "4bf92f3577b34da6a3ce929d0e0e4736"
    headers = {"traceparent": f"00-{caller}-00f067aa0ba902b7-01", "Authorization": "Bearer secret-word"}
    with TestClient(create_app(Settings(), scenes={"flat": FieldsByLevel.load(bundle)}, hrtfs=hrtfs)) as client:
        while client.get("/readyz").status_code != 200:
            time.sleep(0.05)
        query = {"listener": "2,2,1.5", "emitter": "6,3,1.5"}
        assert client.get("/v1/scenes/flat/impulse-response", params=query, headers=headers).status_code == 200
        assert client.get("/v1/scenes/moon", headers=headers).status_code == 404
        with client.websocket_connect("/v1/stream", headers=headers) as socket:
            socket.send_text(Hello(protocol=PROTOCOL, scene="flat").serialize())
            socket.receive()
    spans = traced()
    whole = spans["GET /v1/scenes/{scene}/impulse-response"]
    assert format(whole.context.trace_id, "032x") == caller
    assert whole.attributes["http.response.status_code"] == 200
    assert spans["compute"].parent.span_id == whole.context.span_id
    assert spans["GET /v1/scenes/{scene}"].attributes["http.response.status_code"] == 404
    assert spans["open stream"].attributes["nafir.scene"] == "flat"
    assert format(spans["open stream"].context.trace_id, "032x") == caller
    told = str([dict(each.attributes) for each in spans.values()])
    assert "secret" not in told
    assert "2,2,1.5" not in told
