"""A network between a client and a server that delays, stalls, goes silent or breaks when a test wants it to."""

import asyncio
import contextlib
import random
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_NO_LINGER = struct.pack("ii", 1, 0)
_RETRANSMISSION_S = 0.2
"""What a lost packet costs on TCP: all behind it waits as long."""


class LossyProxy:
    """Forwards TCP connections at `address` to a server. Every piece takes `delay_s`, and the share `loss` of them as
    much longer as a retransmission takes. Its methods may be called from any thread."""

    def __init__(self, target: str, *, delay_s: float = 0.0, loss: float = 0.0, seed: int = 1) -> None:
        self._target = target.split(":")
        self._delay_s, self._loss, self._luck = delay_s, loss, random.Random(seed)
        self._is_dark = False
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()

    def cut(self) -> None:
        """Reset all connections, on both sides."""
        asyncio.run_coroutine_threadsafe(self._cut(), self._loop).result(5)

    def redirect(self, target: str) -> None:
        """New connections go to another server."""
        self._target = target.split(":")

    def go_dark(self) -> None:
        """From now on nothing passes on the connections that there are, in either direction, and nothing ends them. New
        ones work."""
        for task in tuple(self._tasks):
            self._loop.call_soon_threadsafe(task.cancel)

    async def _cut(self) -> None:
        for writer in tuple(self._writers):
            if not writer.transport.is_closing():
                raw = writer.get_extra_info("socket")
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
            writer.transport.abort()
        self._writers.clear()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        other_reader, other_writer = await asyncio.open_connection(*self._target)
        self._writers |= {writer, other_writer}
        for source, sink in ((reader, other_writer), (other_reader, writer)):
            pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(256)
            for work in (self._read(source, pieces), self._write(pieces, sink)):
                task = asyncio.create_task(work)
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    async def _read(self, source: asyncio.StreamReader, pieces: "asyncio.Queue[tuple[float, bytes]]") -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(65_536):
                lost_s = _RETRANSMISSION_S if self._luck.random() < self._loss else 0.0
                await pieces.put((self._loop.time() + self._delay_s + lost_s, data))
        await pieces.put((0.0, b""))

    async def _write(self, pieces: "asyncio.Queue[tuple[float, bytes]]", sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while True:
                at_s, data = await pieces.get()
                await asyncio.sleep(max(0.0, at_s - self._loop.time()))
                if not data:
                    break
                sink.write(data)
                await sink.drain()
        sink.close()

    async def _listen(self, started: threading.Event) -> None:
        server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.address = "{}:{}".format(*server.sockets[0].getsockname())
        self._stop = asyncio.Event()
        started.set()
        async with server:
            await self._stop.wait()
            await self._cut()
            for task in tuple(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    @contextmanager
    def running(self) -> Iterator["LossyProxy"]:
        started = threading.Event()
        thread = threading.Thread(target=lambda: self._loop.run_until_complete(self._listen(started)))
        thread.start()
        started.wait(5)
        try:
            yield self
        finally:
            self._loop.call_soon_threadsafe(self._stop.set)
            thread.join()
            self._loop.close()
