"""HTTP requests while a server ends: those in flight finish or are told in time, new ones are told at once."""

import asyncio
import json

import pytest

from server.api.drain_gate import DrainGate
from server.runtime.drain import Drain


class Client:
    """What one request is answered."""

    def __init__(self, gate, path="/v1/scenes", kind="http"):
        self.scope = {"type": kind, "path": path, "method": "GET", "headers": []}
        self.sent = []
        self._gate = gate

    async def ask(self):
        async def receive():
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message):
            self.sent.append(message)

        await self._gate(self.scope, receive, send)
        return self

    @property
    def status(self):
        return self.sent[0]["status"]

    @property
    def headers(self):
        return {name.decode(): value.decode() for name, value in self.sent[0]["headers"]}

    @property
    def problem(self):
        return json.loads(b"".join(message.get("body", b"") for message in self.sent[1:]))


def app_that_takes(duration_s, log):
    async def app(_scope, _receive, send):
        try:
            await asyncio.sleep(duration_s)
        except asyncio.CancelledError:
            log.append("cancelled")
            raise
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"answer"})

    return app


def test_what_is_in_flight_finishes_and_the_drain_waits_for_it():
    async def scenario():
        drain = Drain(30.0)
        client = Client(DrainGate(app_that_takes(0.2, []), drain))
        asking = asyncio.create_task(client.ask())
        await asyncio.sleep(0.05)
        await drain.settle()
        assert asking.done()
        return client

    assert asyncio.run(scenario()).status == 200


def test_what_takes_too_long_is_cancelled_and_answered_503_in_time():
    log = []

    async def scenario():
        drain = Drain(2.0)
        client = Client(DrainGate(app_that_takes(60, log), drain))
        asking = asyncio.create_task(client.ask())
        await asyncio.sleep(0.05)
        await asyncio.wait_for(drain.settle(), 2)
        await asyncio.wait_for(asking, 1)
        return client

    client = asyncio.run(scenario())
    assert client.status == 503
    assert client.problem["code"] == "server_draining"
    assert int(client.headers["retry-after"]) >= 1
    assert log == ["cancelled"]


def test_an_answer_that_has_begun_is_not_begun_again():
    async def scenario():
        drain = Drain(2.0)

        async def app(_scope, _receive, send):
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await asyncio.sleep(60)

        client = Client(DrainGate(app, drain))
        asking = asyncio.create_task(client.ask())
        await asyncio.sleep(0.05)
        await drain.settle()
        await asyncio.wait_for(asking, 1)
        return client

    assert [message["type"] for message in asyncio.run(scenario()).sent] == ["http.response.start"]


def test_who_comes_later_is_told_at_once_and_operators_are_answered():
    async def scenario():
        drain = Drain(7.0)
        gate = DrainGate(app_that_takes(0, []), drain)
        drain.begin()
        paths = ("/v1/scenes", "/", "/livez", "/readyz", "/metrics")
        return {path: await Client(gate, path).ask() for path in paths}

    clients = asyncio.run(scenario())
    assert {path: client.status for path, client in clients.items()} == {
        "/v1/scenes": 503,
        "/": 503,
        "/livez": 200,
        "/readyz": 200,
        "/metrics": 200,
    }
    assert clients["/"].headers["retry-after"] == "7"
    assert clients["/"].headers["connection"] == "close"
    assert clients["/"].problem["code"] == "server_draining"


def test_a_stream_passes_to_be_told_in_its_own_words():
    async def scenario():
        drain, passed = Drain(7.0), []

        async def app(scope, _receive, _send):
            passed.append(scope["type"])

        drain.begin()
        await Client(DrainGate(app, drain), kind="websocket").ask()
        return passed

    assert asyncio.run(scenario()) == ["websocket"]


def test_an_exception_of_the_app_passes_through():
    async def scenario():
        async def app(*_):
            raise KeyError("x")

        await Client(DrainGate(app, Drain(7.0))).ask()

    with pytest.raises(KeyError):
        asyncio.run(scenario())
