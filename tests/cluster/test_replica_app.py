import asyncio
from types import SimpleNamespace

import pytest

from server.api.settings import Settings
from server.cluster.replica_app import ReplicaApp, ReplicaError
from server.runtime.readiness import Readiness

SETTINGS = Settings(max_streams=8)


class PretendedServer:
    """An application with the state and the readiness of the server's."""

    def __init__(self) -> None:
        self.asked = []
        self.host = None

    def build(self, settings, *, drain):
        self.host = SimpleNamespace(readiness=Readiness(drain), settings=settings, streams=0)
        return self

    async def __call__(self, scope, receive, send) -> None:
        if scope["type"] == "lifespan":
            await receive()
            scope["state"]["host"] = self.host
            await send({"type": "lifespan.startup.complete"})
            await receive()
            await send({"type": "lifespan.shutdown.complete"})
        else:
            self.asked.append(scope)


class Router:
    """What starts and ends the replica."""

    def __init__(self, app) -> None:
        self._told = asyncio.Queue()
        self.heard = []
        self.task = asyncio.create_task(app({"type": "lifespan"}, self._told.get, self._hear))
        self.tell("lifespan.startup")

    async def _hear(self, message) -> None:
        self.heard.append(message["type"])

    def tell(self, kind) -> None:
        self._told.put_nowait({"type": kind})


def run(test):
    server = PretendedServer()
    app = ReplicaApp(SETTINGS, build=server.build)

    async def with_router():
        router = Router(app)
        await test(server, app, router)
        router.task.cancel()

    asyncio.run(with_router())


def test_it_has_started_when_it_is_warm() -> None:
    async def starts(server, _, router):
        await asyncio.sleep(0.2)
        assert router.heard == []
        server.host.readiness.warm_up = "done"
        await asyncio.sleep(0.2)
        assert router.heard == ["lifespan.startup.complete"]
        router.tell("lifespan.shutdown")
        await router.task
        assert router.heard[1:] == ["lifespan.shutdown.complete"]

    run(starts)


def test_a_failed_warm_up_is_told() -> None:
    async def fails(server, _, router):
        await asyncio.sleep(0.1)
        server.host.readiness.warm_up = "failed"
        with pytest.raises(ReplicaError, match="warm-up has failed"):
            await router.task

    run(fails)


async def _started(server):
    await asyncio.sleep(0.1)
    server.host.readiness.warm_up = "done"
    await asyncio.sleep(0.1)


def test_requests_have_the_applications_state() -> None:
    async def asks(server, app, _):
        await _started(server)
        await app({"type": "websocket", "path": "/v1/stream", "state": {"request_id": 7}}, None, None)
        (scope,) = server.asked
        assert scope["state"] == {"request_id": 7, "host": server.host}
        assert scope["path"] == "/v1/stream"

    run(asks)


def test_its_drain_is_the_applications_and_no_reason_to_replace_it() -> None:
    async def drains(server, app, _):
        await _started(server)
        app.require_working()
        assert not server.host.readiness.drain.has_begun
        app.begin_drain()
        assert server.host.readiness.drain.has_begun
        app.require_working()

    run(drains)


def test_its_streams_end_one_after_the_other_and_are_taken_by_others_at_once() -> None:
    async def drains(server, app, _):
        await _started(server)
        drain, ended = server.host.readiness.drain, []

        async def stream(number):
            await drain.turn()
            ended.append(number)

        streams = [asyncio.create_task(stream(number)) for number in range(4)]
        await asyncio.sleep(0.1)
        app.begin_drain()
        await asyncio.sleep(0.1)  # the next has its turn a second later
        assert ended == [0]
        assert drain.streams_retry_after_s is None
        for task in streams:
            task.cancel()

    run(drains)


def test_it_says_how_much_of_it_is_free() -> None:
    async def measures(server, app, _):
        await _started(server)
        server.host.admission = SimpleNamespace(headroom=0.25, streams=7)
        assert (app.headroom, app.streams) == (0.25, 7)

    run(measures)
