"""However a connection ends, its session is let go of at once, and not when a collector looks for it."""

import asyncio
import gc
import time
import weakref

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from server import streaming
from server.session import Session
from server.stream import Stream
from tests.integration.churn import HELLO, visit

PATIENCE_S = 5.0


@pytest.fixture
def made(monkeypatch):
    """Weak references to all sessions, streams and connections made from now on."""
    references = []

    class Remembering:
        def __init__(self, kind):
            self._kind = kind

        def __call__(self, *arguments, **named):
            each = self._kind(*arguments, **named)
            references.append(weakref.ref(each))
            return each

    monkeypatch.setattr(streaming, "Session", Remembering(Session))
    monkeypatch.setattr(streaming, "Stream", Remembering(Stream))
    monkeypatch.setattr("server.routes.Connection", Remembering(streaming.Connection))
    return references


@pytest.fixture
def uncollected():
    gc.collect()
    gc.disable()
    yield
    gc.enable()


async def _say_nothing_more(address):
    """Until the server closes the connection."""
    async with connect(f"ws://{address}/v1/stream", compression=None) as socket:
        await socket.send(HELLO)
        await _read_until_closed(socket, "stalled")


async def _read_until_closed(socket, reason):
    with pytest.raises(ConnectionClosed, match=reason):
        await _read_for_ever(socket)


async def _read_for_ever(socket):
    while True:
        await socket.recv()


async def _break_the_protocol(address):
    async with connect(f"ws://{address}/v1/stream", compression=None) as socket:
        await socket.send(HELLO)
        await socket.recv()
        socket.transport.write(b"\xff" * 64)
        await _read_until_closed(socket, "1002")


ENDS = {
    "said goodbye": lambda address: visit(address, blocks=10, emitters=4),
    "dropped the connection": lambda address: visit(address, blocks=10, emitters=4, is_aborted=True),
    "was sent away": _say_nothing_more,
    "broke the protocol": _break_the_protocol,
}


@pytest.mark.usefixtures("uncollected")
@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
def test_no_session_outlives_its_connection(monkeypatch, request, made, end):
    monkeypatch.setenv("NAFIR_STALL_TIMEOUT_S", "0.5")
    served = request.getfixturevalue("served")
    asyncio.run(end(served))
    until_s = time.monotonic() + PATIENCE_S
    while any(reference() is not None for reference in made) and time.monotonic() < until_s:
        time.sleep(0.02)
    assert len(made) == 3
    assert [reference() for reference in made] == [None] * 3
