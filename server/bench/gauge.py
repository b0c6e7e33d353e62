"""Measures latencies inside a server: from when the application receives a pose until it has passed the socket the
first audio block with that pose or a newer one.

`/bench/begin` starts a measurement of the open streams, and `/bench/report` returns the results since then.
`/bench/blocks` returns only the numbers of blocks, which takes hardly any time. `/bench/settled` says whether the
server has finished its one-time work after the start.
"""

import json
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.connection import StreamHost
from server.api.web_socket import watched
from server.core.durations import DurationHistogram
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import ListenerPose
from server.protocol.server_messages import Durations
from server.streaming.stream import Stream

POSE_ID = struct.Struct("<4xI")
"""The pose id in a binary listener pose."""
POSE_IDS = struct.Struct("<16xII")
"""The two pose ids in an audio block: of the direct sound and of the impulse responses."""


@dataclass
class Waiting:
    """Latencies of poses: the time of each until a block with that pose or a newer one."""

    times: DurationHistogram = field(default_factory=DurationHistogram)
    _since_s: deque[tuple[int, float]] = field(default_factory=deque)

    def enter(self, pose_id: int, now_s: float) -> None:
        self._since_s.append((pose_id, now_s))

    def leave(self, pose_id: int, now_s: float) -> None:
        while self._since_s and self._since_s[0][0] <= pose_id:
            self.times.add(now_s - self._since_s.popleft()[1])


class _Watch:
    """The latencies of one connection."""

    def __init__(self) -> None:
        self.direct, self.reverberation = Waiting(), Waiting()


class _Counts:
    """A stream's counts at the beginning of a measurement. Its duration histograms start anew."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self._late, self._dropped, self._sent = self._now()
        # The audio thread finds the new histograms with the next block. Nothing else replaces them.
        times = stream.times
        times.render, times.lateness, times.response = (DurationHistogram() for _ in range(3))

    def _now(self) -> tuple[int, int, int]:
        session = self.stream.session
        return self.stream.blocks_late, session.blocks_dropped, session.window.sent

    @property
    def since(self) -> tuple[int, int, int]:
        """Numbers of blocks late, dropped and sent since the beginning."""
        late, dropped, sent = self._now()
        return late - self._late, dropped - self._dropped, sent - self._sent


class Gauge:
    """An ASGI application around the server's. Everything runs on its event loop."""

    def __init__(self, app: ASGIApp, *, time_s: Callable[[], float] = time.monotonic) -> None:
        self._app = app
        self._time_s = time_s
        self._watches: set[_Watch] = set()
        self._counts: list[_Counts] = []
        self._began_s = self._began_cpu_s = 0.0
        self._began_thread_cpu_s: dict[threading.Thread, float] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        match scope["type"], scope.get("path"):
            case "http", "/bench/begin":
                self._begin(scope["state"]["host"])
                await _answer({"resident_mb": resident_mb()}, send)
            case "http", "/bench/settled":
                host = scope["state"]["host"]
                await _answer({"is_settled": host.effect_costs.keys() >= host.scenes.keys()}, send)
            case "http", "/bench/blocks":
                await _answer(self._count_blocks(), send)
            case "http", "/bench/report":
                await _answer(self._report(), send)
            case "websocket", _:
                await self._watch(scope, receive, send)
            case _:
                await self._app(scope, receive, send)

    async def _watch(self, scope: Scope, receive: Receive, send: Send) -> None:
        watch = _Watch()

        def see_pose(data: str | bytes) -> None:
            if isinstance(data, bytes) and data and data[0] == ListenerPose.KIND:
                (pose_id,) = POSE_ID.unpack_from(data)
                now_s = self._time_s()
                watch.direct.enter(pose_id, now_s)
                watch.reverberation.enter(pose_id, now_s)

        async def receive_pose() -> Message:
            message = await receive()
            see_pose(message.get("bytes") or b"")
            return message

        def see_blocks(messages: Sequence[bytes]) -> None:
            """Record the blocks among messages sent at one moment."""
            now_s = self._time_s()
            blocks = {POSE_IDS.unpack_from(data) for data in messages if data[0] == AudioBlock.KIND}
            for pose_id, reverberation_pose_id in blocks:
                watch.direct.leave(pose_id, now_s)
                watch.reverberation.leave(reverberation_pose_id, now_s)

        async def send_block(message: Message) -> None:
            await send(message)
            if data := message.get("bytes"):
                see_blocks([data])

        self._watches.add(watch)
        try:
            await self._app(watched(scope, sent=see_blocks, received=see_pose), receive_pose, send_block)
        finally:
            self._watches.remove(watch)

    def _begin(self, host: StreamHost) -> None:
        self._counts = [_Counts(stream) for stream in host.audio.streams]
        for watch in self._watches:
            watch.direct.times, watch.reverberation.times = DurationHistogram(), DurationHistogram()
        self._began_s, self._began_cpu_s = self._time_s(), time.process_time()
        self._began_thread_cpu_s = {thread: _thread_cpu_s(thread) for thread in threading.enumerate()}

    def _count_blocks(self) -> dict[str, Any]:
        """Numbers of blocks since the beginning; of streams that have ended, until their end."""
        duration_s = self._time_s() - self._began_s
        blocks = [counts.since for counts in self._counts]
        late, dropped, sent = (sum(column) for column in zip(*blocks, strict=True)) if blocks else (0, 0, 0)
        due = sum(duration_s / counts.stream.block_s for counts in self._counts)
        return {
            "duration_s": duration_s,
            "streams": len(self._counts),
            "blocks_sent": sent,
            "blocks_late": late,
            "blocks_dropped": dropped,
            # A stream that falls behind skips time. One block of each stream may be in progress at either end.
            "blocks_missing": max(0, round(due) - sent - dropped - len(self._counts)),
        }

    def _report(self) -> dict[str, Any]:
        blocks = self._count_blocks()
        duration_s = blocks["duration_s"]
        return {
            **blocks,
            "block_ms": merged(counts.stream.times.render for counts in self._counts),
            "lateness_ms": merged(counts.stream.times.lateness for counts in self._counts),
            "ir_ms": merged(counts.stream.times.response for counts in self._counts),
            "pose_to_audio_ms": merged(watch.direct.times for watch in self._watches),
            "pose_to_reverberation_ms": merged(watch.reverberation.times for watch in self._watches),
            "resident_mb": resident_mb(),
            "server_load": (time.process_time() - self._began_cpu_s) / duration_s,
            "server_load_by_thread": self._loads_by_thread(duration_s),
        }

    def _loads_by_thread(self, duration_s: float) -> dict[str, float]:
        """CPU load by name, of the threads that exist since the beginning."""
        return {
            thread.name: (_thread_cpu_s(thread) - began_s) / duration_s
            for thread, began_s in self._began_thread_cpu_s.items()
            if thread.is_alive()
        }


def resident_mb() -> float | None:
    """Memory of this process in megabytes; None where the system does not say."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6 if statm.exists() else None


def _thread_cpu_s(thread: threading.Thread) -> float:
    assert thread.ident is not None
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def merged(histograms: Iterable[DurationHistogram]) -> dict[str, float | None]:
    """Quantiles in milliseconds of all histograms together, as in a status message."""
    together = DurationHistogram()
    for histogram in histograms:
        together.merge(histogram)
    return Durations.of(together).model_dump()


async def _answer(document: dict[str, Any], send: Send) -> None:
    body = json.dumps(document).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})
