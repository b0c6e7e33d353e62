"""The web server of one of several processes. It takes connections that another process has accepted, and reports its
load."""

import asyncio
import contextlib
import json
import os
import signal
import socket
from collections.abc import Callable

import uvicorn

from server.api.connection import StreamHost
from server.api.processes import REPORT_S
from server.api.serving import Server
from server.api.settings import usable_cores
from server.runtime.drain import Drain
from server.streaming.load_thresholds import THRESHOLDS

_AT_ONCE = 64


class MemberServer(Server):
    """Serves the connections that come through `channel`, and ends when the channel does."""

    def __init__(
        self,
        config: uvicorn.Config,
        drain: Drain,
        channel: socket.socket,
        *,
        on_start: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(config, drain, on_start=on_start)
        self._channel = channel
        self._tasks: set[asyncio.Task[None]] = set()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._channel.setblocking(False)
            asyncio.get_running_loop().add_reader(self._channel, self._take)
            self._spawn(self._report())

    def _take(self) -> None:
        """Take the connections that wait in the channel."""
        try:
            data, descriptors, _, _ = socket.recv_fds(self._channel, _AT_ONCE, _AT_ONCE)
        except BlockingIOError:
            return
        except OSError:
            data, descriptors = b"", []
        for descriptor in descriptors:
            self._spawn(self._serve_connection(socket.socket(fileno=descriptor)))
        if not data:
            asyncio.get_running_loop().remove_reader(self._channel)
            os.kill(os.getpid(), signal.SIGTERM)

    async def _serve_connection(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError):  # the client may have gone
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setblocking(False)
            await asyncio.get_running_loop().connect_accepted_socket(self._make_protocol, connection)

    def _make_protocol(self) -> asyncio.Protocol:
        """Make the protocol of a connection, as uvicorn does for those that it accepts."""
        return self.config.http_protocol_class(  # type: ignore[call-arg]
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )

    async def _report(self) -> None:
        """Report to the other process, until the server ends, whether this one is ready, and its load."""
        host: StreamHost = self.lifespan.state["host"]
        while True:
            # If the channel is full, nobody reads; if it is closed, `_take` sees that.
            with contextlib.suppress(OSError):
                self._channel.send(json.dumps(report(host)).encode() + b"\n")
            await asyncio.sleep(REPORT_S)

    def _spawn(self, work: "asyncio._CoroutineLike[None]") -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def report(host: StreamHost) -> dict[str, bool | float]:
    """Whether a server may open streams, and the share of its cores that streams take. Those that are being opened are
    taken to need as little as any."""
    opening = host.streams - len(host.audio.streams) + len(host.silent)
    return {
        "is_ready": host.readiness.obstacle is None,
        "load": (host.audio.demand + max(0, opening) * THRESHOLDS.presumed_load) / usable_cores(),
    }
