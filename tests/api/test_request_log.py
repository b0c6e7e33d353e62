import logging

import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from server.api import request_log
from server.api.http_durations import HttpDurations
from server.api.problems import problem
from server.api.request_log import REQUEST_ID, RefusedRequests, RequestLog


@pytest.fixture
def counted():
    return RefusedRequests()


@pytest.fixture
def durations():
    return HttpDurations()


@pytest.fixture
def client(counted, durations):
    async def good(_):
        return PlainTextResponse("heard")

    async def refused(_):
        return problem(409, "map_too_fine", "no")

    async def silent(_):
        return Response(status_code=204)

    async def failing(_):
        raise ValueError("a fault")

    async def bare(_):
        return Response(b"not JSON", 400, media_type="application/problem+json")

    async def stream(websocket):
        if "deny" in websocket.query_params:
            await websocket.send_denial_response(problem(401, "key_required", "no"))
        elif "close" in websocket.query_params:
            await websocket.close(1008, "origin_not_allowed")
        else:
            await websocket.accept(headers=[(b"x-own", b"1")])
            await websocket.close()

    routes = [
        Route("/v1/good", good),
        Route("/livez", good),
        Route("/metrics", refused),
        Route("/streams/process", silent, methods=["PUT"]),
        Route("/v1/refused", refused),
        Route("/v1/failing", failing),
        Route("/v1/rooms/{room}", good),
        Route("/v1/bare", bare),
        WebSocketRoute("/v1/stream", stream),
    ]
    app = RequestLog(Starlette(routes=routes), routes=routes, refused=counted, durations=durations)
    return TestClient(app, raise_server_exceptions=False)


@pytest.fixture
def logged(caplog):
    """The fields of the lines since the last call."""
    caplog.set_level(logging.INFO, request_log.__name__)
    names = ("method", "path", "status", "code", "client")

    def logged():
        records = [record for record in caplog.records if record.name == request_log.__name__]
        lines = [tuple(getattr(record, name, None) for name in names) for record in records]
        assert all(record.duration_ms >= 0 for record in records)
        caplog.clear()
        return lines

    return logged


def test_every_request_has_a_line_without_its_query(client, logged):
    client.get("/v1/good?key=nafir_secret")
    assert logged() == [("GET", "/v1/good", 200, None, "testclient")]
    client.post("/v1/refused")
    client.get("/v1/refused")
    client.get("/nowhere")
    assert [line[:4] for line in logged()] == [
        ("POST", "/v1/refused", 405, None),
        ("GET", "/v1/refused", 409, "map_too_fine"),
        ("GET", "/nowhere", 404, None),
    ]
    client.get("/v1/bare")
    assert logged()[0][2:4] == (400, None)
    with pytest.raises(ValueError, match="a fault"):
        TestClient(client.app).get("/v1/failing")
    assert logged()[0][2:4] == (500, "internal_error")


def test_of_a_long_path_the_beginning_is_written(client, logged):
    for length in (256, 257, 8_000):
        client.get("/" + "x" * (length - 1))
    assert [line[1] for line in logged()] == ["/" + "x" * 255, *["/" + "x" * 255 + "…"] * 2]


def test_what_is_asked_all_the_time_has_lines_only_if_it_fails(client, logged):
    client.get("/livez")
    assert client.put("/streams/process").status_code == 204
    assert logged() == []
    client.get("/metrics")
    assert [line[:4] for line in logged()] == [("GET", "/metrics", 409, "map_too_fine")]


def test_a_refused_handshake_has_a_line(client, logged):
    answers = (
        ("?deny", WebSocketDenialResponse, 401, "key_required"),
        ("?close", WebSocketDisconnect, 403, "origin_not_allowed"),
    )
    for query, refusal, status, code in answers:
        with pytest.raises(refusal) as refused, client.websocket_connect(f"/v1/stream{query}"):
            pass
        assert refused.type is refusal
        assert [line[:4] for line in logged()] == [("WEBSOCKET", "/v1/stream", status, code)]
    with client.websocket_connect("/v1/stream") as socket:
        headers = dict(socket.extra_headers)
    assert headers[b"x-own"] == b"1"
    assert len(headers[REQUEST_ID.lower().encode()]) == 32
    assert logged() == []  # the stream's own lines say what became of it


def test_who_is_refused_is_counted_once(client, counted):
    client.get("/v1/good")
    client.get("/v1/refused")
    for query, refusal in (("?deny", WebSocketDenialResponse), ("?close", WebSocketDisconnect)):
        with pytest.raises(refusal), client.websocket_connect(f"/v1/stream{query}"):
            pass
    told = {refusal: count for refusal, count in counted.counts.items() if count}
    assert told == {("401", "key_required"): 1, ("403", "origin_not_allowed"): 1}


def timed(durations):
    """How many answers were timed, by method, route and status."""
    return {labels: buckets[-1][1] for labels, buckets, _ in durations.told()}


def test_answers_are_timed_by_the_route_and_not_by_what_a_client_writes_there(client, durations):
    for room in range(5):
        client.get(f"/v1/rooms/{room}?key=secret")
        client.get(f"/nowhere/{room}")
    client.post("/v1/rooms/a")
    client.get("/v1/failing")
    assert timed(durations) == {
        ("GET", "/v1/rooms/{room}", "2xx"): 5,
        ("GET", "other", "4xx"): 5,
        ("POST", "/v1/rooms/{room}", "4xx"): 1,
        ("GET", "/v1/failing", "5xx"): 1,
    }


def test_a_stream_that_was_opened_is_not_timed_and_a_refused_one_is(client, durations):
    with client.websocket_connect("/v1/stream"):
        pass
    assert timed(durations) == {}
    with pytest.raises(WebSocketDenialResponse), client.websocket_connect("/v1/stream?deny"):
        pass
    assert timed(durations) == {("GET", "/v1/stream", "4xx"): 1}


def test_an_id_is_taken_over_if_it_is_a_plain_word(client):
    assert client.get("/v1/good", headers={REQUEST_ID: "trace-1.A_b"}).headers[REQUEST_ID] == "trace-1.A_b"
    made = {client.get("/v1/refused").headers[REQUEST_ID] for _ in range(3)}
    assert len(made) == 3
    for odd in ("", "two words", "x" * 65, "a,b", "<script>", "ä", "a\tb"):
        answered = client.get("/v1/good", headers={REQUEST_ID: odd.encode()}).headers[REQUEST_ID]
        assert answered != odd
        assert len(answered) == 32
    twice = client.get("/v1/good", headers=[(REQUEST_ID, "a"), (REQUEST_ID, "b")]).headers[REQUEST_ID]
    assert twice not in {"a", "b", "a, b"}
