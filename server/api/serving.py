"""The process of the web server. It prints its address once it serves, and shuts down within a stated time.

uvicorn's own shutdown closes streams after 0.1 s without a message, and answers longer requests with 500.
"""

import asyncio
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, NoReturn

import uvicorn

from server.api.connection_limits import ConnectionLimits
from server.api.http_protocol import limited_http
from server.api.process_peers import ProcessPeers
from server.api.settings import Settings, usable_cores
from server.runtime.drain import Drain
from server.runtime.service_notices import ServiceNotices

_CORES_OF_A_PROCESS = 2
"""Cores that the streams of one process fill, about (`docs/results/processes.md`)."""
_CUT_OFF_CODE = 1
_CLOSING_SHARE = 0.05
"""Share of the drain time in which idle connections close."""
_OWN_THREADS = "nafir-"

_logger = logging.getLogger(__name__)


def announcement(scenes: Sequence[str], url: str, *, peers: ProcessPeers | None = None) -> str:
    """What is printed once a server accepts requests, with markup. Where one process leaves most cores idle, it says
    so."""
    said = f"[bold]Nafir[/] serves {', '.join(scenes)} at [link]{url}[/]"
    if peers is not None:
        return f"{said} with {len(peers.ports)} processes"
    cores = usable_cores()
    if cores < 2 * _CORES_OF_A_PROCESS:
        return said
    processes = cores // _CORES_OF_A_PROCESS
    return f"{said}\nOne process fills about two of the {cores} cores: --processes {processes} uses them all"


def uvicorn_options(settings: Settings) -> dict[str, Any]:
    """Options with which uvicorn has to run the application."""
    return {
        "http": limited_http(ConnectionLimits.of(settings)),
        "timeout_keep_alive": settings.keep_alive_s,
        "host": settings.host,
        "port": settings.port,
        "loop": "auto",  # uvloop if it is installed
        "ws": "server.api.web_socket:WebSocketProtocol",
        "ws_max_size": settings.max_frame_bytes,
        "ws_per_message_deflate": False,
        "log_config": None,  # `server.runtime.logs` writes all logs, and `server.api.request_log` those of requests
        "access_log": False,
    }


class Server(uvicorn.Server):
    """uvicorn with an orderly shutdown, which takes at most `drain.drain_s` and no time if nothing is in flight.

    The first SIGTERM or SIGINT begins the shutdown, and the exit code is 0. A second one ends the process at once.
    `on_start` is called when the server accepts requests. The event loop gives the signs of life of `notices`.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        drain: Drain,
        *,
        on_start: Callable[[], None] = lambda: None,
        notices: ServiceNotices | None = None,
    ) -> None:
        super().__init__(config)
        self._drain = drain
        self._on_start = on_start
        self._notices = ServiceNotices() if notices is None else notices
        self._loop: asyncio.AbstractEventLoop | None = None
        self._is_stopping = False

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        self._loop = asyncio.get_running_loop()
        await super().startup(sockets)
        if self.started:
            self._on_start()
            self._notices.ready()

    async def on_tick(self, counter: int) -> bool:
        """uvicorn calls this ten times a second."""
        self._notices.beat()
        return await super().on_tick(counter)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:  # noqa: ARG002  uvicorn's signature
        """Begin the shutdown. uvicorn calls this as a signal handler, on the main thread."""
        if self._is_stopping:
            _end_process(128 + sig, f"{signal.Signals(sig).name} again: ended at once")
        self._is_stopping = self.should_exit = True
        self._notices.stopping()
        end = threading.Timer(self._drain.drain_s, _cut_off, [self._drain.drain_s])
        end.daemon = True
        end.start()
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._drain.begin)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        _logger.info("draining: no new streams and requests, at most %g s left", self._drain.drain_s)
        await self._drain.settle()
        self.config.timeout_graceful_shutdown = self._drain.drain_s * _CLOSING_SHARE  # type: ignore[assignment]
        await super().shutdown(sockets)


def serve(server: Server, listeners: Sequence[socket.socket]) -> None:
    """Serve until a signal. If a thread of the server cannot be stopped, for instance while it compiles, the process
    ends here with exit code 0."""
    server.run(sockets=list(listeners))
    if any(thread.name.startswith(_OWN_THREADS) for thread in threading.enumerate()):
        _end_process(0)


def _cut_off(drain_s: float) -> NoReturn:
    _end_process(_CUT_OFF_CODE, f"not everything had ended {drain_s:g} s after the server was told to stop: cut off")


def _end_process(code: int, message: str = "") -> NoReturn:
    """End the process without waiting for any thread."""
    if message:
        os.write(sys.stderr.fileno(), f"nafir: {message}\n".encode())
    sys.stdout.flush()
    os._exit(code)
