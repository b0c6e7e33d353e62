"""However a connection ends, what belongs to it is let go of at once, and not when a collector looks for it."""

import asyncio
import gc
import time
import weakref

import numpy as np
import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from server.api import connection as streaming
from server.api.http_protocol import HttpProtocol
from server.api.web_socket import WebSocketProtocol
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import AddEmitter, AddListener, RemoveListener
from server.rendering.renderer import Renderer
from server.streaming.session import Session
from server.streaming.stream import Stream
from tests.integration.churn import HELLO, visit

pytestmark = pytest.mark.untimed

PATIENCE_S = 5.0


@pytest.fixture
def made(monkeypatch):
    """Weak references to all sessions, streams, connections and protocols made from now on, by kind."""
    kinds = (Session, Renderer, Stream, streaming.Connection, HttpProtocol, WebSocketProtocol)
    references = {kind: [] for kind in kinds}

    class Remembering:
        def __init__(self, kind):
            self._kind = kind

        def __call__(self, *arguments, **named):
            each = self._kind(*arguments, **named)
            references[self._kind].append(weakref.ref(each))
            return each

    def remember(protocol):
        connect = protocol.connection_made

        def connection_made(self, transport):
            references[protocol].append(weakref.ref(self))
            connect(self, transport)

        monkeypatch.setattr(protocol, "connection_made", connection_made)

    remember(HttpProtocol)
    remember(WebSocketProtocol)
    monkeypatch.setattr(streaming, "Session", Remembering(Session))
    monkeypatch.setattr("server.responses.direct_sound.Renderer", Remembering(Renderer))
    monkeypatch.setattr(streaming, "Stream", Remembering(Stream))
    monkeypatch.setattr("server.api.routes.Connection", Remembering(streaming.Connection))
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


async def _speak_to_several(address):
    """Live sound, heard by three listeners, one of whom leaves before the connection is dropped."""
    async with connect(f"ws://{address}/v1/stream", compression=None, max_queue=None) as socket:
        await socket.send(HELLO)
        await socket.send(AddEmitter(id="voice", live=True, position=(6.0, 3.0, 1.5)).serialize())
        for name in ("p2", "p3"):
            await socket.send(AddListener(id=name, position=(2.0, 2.5, 1.5)).serialize())
        await socket.send(RemoveListener(id="p2").serialize())
        for number in range(20):
            await socket.send(DryBlock("voice", number, np.ones(256, np.float32)).serialize("f32"))
        while not isinstance(message := await socket.recv(), str) or "listener_removed" not in message:
            pass
        await socket.recv()
        socket.transport.abort()


ENDS = {
    "said goodbye": lambda address: visit(address, blocks=10, emitters=4),
    "dropped the connection": lambda address: visit(address, blocks=10, emitters=4, is_aborted=True),
    "was sent away": _say_nothing_more,
    "broke the protocol": _break_the_protocol,
    "spoke to several listeners": _speak_to_several,
}


@pytest.mark.usefixtures("uncollected")
@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
def test_nothing_outlives_its_connection(monkeypatch, request, made, end):
    monkeypatch.setenv("NAFIR_STALL_TIMEOUT_S", "0.5")
    served = request.getfixturevalue("served_anew")
    asyncio.run(end(served))
    until_s = time.monotonic() + PATIENCE_S
    while any(left(made).values()) and time.monotonic() < until_s:
        time.sleep(0.02)
    assert left(made) == dict.fromkeys(made, 0)
    # Every question whether the server is ready has a connection of its own.
    assert len(made.pop(HttpProtocol)) > 1
    listeners = 3 if end is _speak_to_several else 1
    assert len(made.pop(Renderer)) >= listeners  # and those of measurements
    assert [len(references) for references in made.values()] == [listeners, 1, 1, 1]


def left(made):
    return {kind: sum(reference() is not None for reference in references) for kind, references in made.items()}
