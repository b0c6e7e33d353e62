"""Measures latencies inside a server: from when the application receives a pose until it has passed the socket the
first audio block with that pose or a newer one. A pose that is not answered when the measurement ends counts with its
wait so far, as soon as that is among the longest: what never comes is not left out.

`/bench/begin` starts a measurement of the open streams, and `/bench/report` returns the results since then.
`/bench/blocks` returns only the numbers of blocks, which takes hardly any time. `/bench/settled` says whether the
server has finished its one-time work after the start.
"""

import asyncio
import json
import os
import struct
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.connection import StreamHost
from server.api.web_socket import watched
from server.bench.meter import Meter, Spent, Thread
from server.core.durations import DurationHistogram
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import ListenerPose
from server.protocol.server_messages import Durations
from server.rendering.convolver import Sharing
from server.streaming.quality_steps import QualityStep
from server.streaming.stream import Stream
from server.streaming.stream_times import StreamTimes

POSE_ID = struct.Struct("<4xI")
"""The pose id in a binary listener pose."""
POSE_IDS = struct.Struct("<16xII")
"""The two pose ids in an audio block: of the direct sound and of the impulse responses."""
POSE_LISTENER, BLOCK_LISTENER = 1, 3
"""The bytes of both that have the number of the listener."""

_LOOK_EVERY_S = 0.1
"""Time between looks at the quality of all streams. It changes at most four times a second."""


@dataclass
class Waiting:
    """Latencies of poses: the time of each until a block with that pose or a newer one. A pose that a newer one
    overtakes goes on waiting from its own arrival."""

    times: DurationHistogram = field(default_factory=DurationHistogram)
    longest_s: float = 0.0
    """The longest time of a pose that was answered."""
    _since_s: deque[tuple[int, float]] = field(default_factory=deque)

    def begin(self) -> None:
        """Forget the times so far. Poses that wait go on waiting."""
        self.times, self.longest_s = DurationHistogram(), 0.0

    def enter(self, pose_id: int, now_s: float) -> None:
        self._since_s.append((pose_id, now_s))

    def leave(self, pose_id: int, now_s: float) -> None:
        while self._since_s and self._since_s[0][0] <= pose_id:
            waited_s = now_s - self._since_s.popleft()[1]
            self.longest_s = max(self.longest_s, waited_s)
            self.times.add(waited_s)

    def unanswered_s(self, now_s: float) -> list[float]:
        """How long each pose has waited that is not answered, the longest first."""
        return [now_s - since_s for _, since_s in self._since_s]


def latencies(waits: Iterable[Waiting], now_s: float) -> dict[str, float | None]:
    """Quantiles in milliseconds of all waits together, with the longest (`longest`) and the number of poses that were
    answered.

    A pose without an answer counts with its wait so far if that is longer than 99 % of the answered ones; a shorter
    wait says nothing yet.
    """
    waits = list(waits)
    times = DurationHistogram()
    for waiting in waits:
        times.merge(waiting.times)
    answered, (p99_s,) = times.count, times.quantiles_s(0.99)
    unanswered_s = [wait_s for waiting in waits for wait_s in waiting.unanswered_s(now_s)]
    for wait_s in unanswered_s:
        if p99_s is None or wait_s > p99_s:
            times.add(wait_s)
    longest_s = max([*unanswered_s, *(waiting.longest_s for waiting in waits)], default=0.0)
    return {**Durations.of(times).model_dump(), "longest": 1000 * longest_s, "answered": answered}


class Waits:
    """The latencies of one connection, by the numbers of its listeners."""

    def __init__(self) -> None:
        self.direct: defaultdict[int, Waiting] = defaultdict(Waiting)
        self.reverberation: defaultdict[int, Waiting] = defaultdict(Waiting)

    def begin(self) -> None:
        for waiting in (*self.direct.values(), *self.reverberation.values()):
            waiting.begin()

    def enter(self, listener: int, pose_id: int, now_s: float) -> None:
        for waits in (self.direct, self.reverberation):
            waits[listener].enter(pose_id, now_s)

    def leave(self, listener: int, pose_ids: tuple[int, int], now_s: float) -> None:
        """A block of a listener has these poses of its direct sound and of its impulse responses."""
        for waits, pose_id in zip((self.direct, self.reverberation), pose_ids, strict=True):
            waits[listener].leave(pose_id, now_s)

    def behind_s(self, now_s: float) -> float:
        """How long the oldest pose without its reverberation has waited."""
        return max((wait_s for each in self.reverberation.values() for wait_s in each.unanswered_s(now_s)), default=0.0)


class _Counts:
    """A stream's counts at the beginning of a measurement. Its duration histograms start anew."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self._late, self._dropped, self._sent = self._now()
        self.listeners = len(self.times)
        # The audio thread finds the new histograms with the next block. Nothing else replaces them.
        for times in self.times:
            times.render, times.lateness, times.response = (DurationHistogram() for _ in range(3))

    def _now(self) -> tuple[int, int, int]:
        counts, _ = self.stream.audience.totals()
        return self.stream.blocks_late, counts["dropped"], counts["sent"]

    @property
    def times(self) -> list[StreamTimes]:
        """The times of each listener of the stream."""
        return [member.times for member in self.stream.audience.members]

    @property
    def since(self) -> tuple[int, int, int]:
        """Numbers of blocks late, dropped and sent since the beginning."""
        late, dropped, sent = self._now()
        return late - self._late, dropped - self._dropped, sent - self._sent


class Gauge:
    """An ASGI application around the server's. Everything runs on its event loop. With a `meter`, reports say what each
    part of the work cost."""

    def __init__(
        self, app: ASGIApp, *, time_s: Callable[[], float] = time.monotonic, meter: Meter | None = None
    ) -> None:
        self._app = app
        self._time_s = time_s
        self._meter = meter
        self._began_spent: dict[tuple[Thread, str], Spent] = {}
        self._watches: set[Waits] = set()
        self._counts: list[_Counts] = []
        self._began_s = self._began_cpu_s = 0.0
        self._began_thread_cpu_s: dict[threading.Thread, float] = {}
        self._received = 0
        """Messages of clients."""
        self._looks = self._below_best = 0
        """Looks at the quality of streams, and those that found it below the best of their ladder."""
        self._next_look: asyncio.TimerHandle | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        match scope["type"], scope.get("path"):
            case "http", "/bench/begin":
                self._begin(scope["state"]["host"])
                await _answer({"resident_bytes": resident_bytes()}, send)
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
        watch = Waits()

        def see_pose(data: str | bytes) -> None:
            self._received += 1
            if isinstance(data, bytes) and data and data[0] == ListenerPose.KIND:
                (pose_id,) = POSE_ID.unpack_from(data)
                watch.enter(data[POSE_LISTENER], pose_id, self._time_s())

        async def receive_pose() -> Message:
            message = await receive()
            see_pose(message.get("bytes") or message.get("text") or b"")
            return message

        def see_blocks(messages: Sequence[bytes]) -> None:
            """Record the blocks among messages sent at one moment."""
            now_s = self._time_s()
            audio = [data for data in messages if data[0] == AudioBlock.KIND]
            for listener, pose_ids in {(data[BLOCK_LISTENER], POSE_IDS.unpack_from(data)) for data in audio}:
                watch.leave(listener, pose_ids, now_s)

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
            watch.begin()
        self._looks = self._below_best = 0
        if self._next_look is not None:
            self._next_look.cancel()
        self._look_again()
        self._received = 0
        if self._meter is not None:
            self._began_spent = self._meter.spent()
        self._began_s, self._began_cpu_s = self._time_s(), time.process_time()
        self._began_thread_cpu_s = {thread: _thread_cpu_s(thread) for thread in threading.enumerate()}

    def _count_blocks(self) -> dict[str, Any]:
        """Numbers of blocks since the beginning; of streams that have ended, until their end."""
        duration_s = self._time_s() - self._began_s
        blocks = [counts.since for counts in self._counts]
        late, dropped, sent = (sum(column) for column in zip(*blocks, strict=True)) if blocks else (0, 0, 0)
        due = sum(counts.listeners * duration_s / counts.stream.block_s for counts in self._counts)
        listeners = sum(counts.listeners for counts in self._counts)
        return {
            "duration_s": duration_s,
            "streams": len(self._counts),
            "blocks_sent": sent,
            "blocks_late": late,
            "blocks_dropped": dropped,
            # A stream that falls behind skips time. One block of each listener may be in progress at either end.
            "blocks_missing": max(0, round(due) - sent - dropped - listeners),
        }

    def _report(self) -> dict[str, Any]:
        blocks = self._count_blocks()
        duration_s, now_s = blocks["duration_s"], self._time_s()
        self._look_at_quality()
        return {
            **blocks,
            "block_ms": merged(times.render for counts in self._counts for times in counts.times),
            "lateness_ms": merged(times.lateness for counts in self._counts for times in counts.times),
            "ir_ms": merged(times.response for counts in self._counts for times in counts.times),
            "pose_to_audio_ms": latencies(chain(*(watch.direct.values() for watch in self._watches)), now_s),
            "pose_to_reverberation_ms": latencies(
                chain(*(watch.reverberation.values() for watch in self._watches)), now_s
            ),
            "behind_s": [watch.behind_s(now_s) for watch in self._watches],
            "quality_at_end": Counter(_describe(counts.stream.session.quality) for counts in self._counts),
            "below_best_share": self._below_best / self._looks if self._looks else 0.0,
            "server_load": (time.process_time() - self._began_cpu_s) / duration_s,
            "server_load_by_thread": self._loads_by_thread(duration_s),
            "messages": self._received,
            "resident_bytes": resident_bytes(),
            **self._parts(),
        }

    def _parts(self) -> dict[str, Any]:
        """What each part of the work has cost since the beginning."""
        if self._meter is None:
            return {}
        parts = []
        for (thread, part), now in self._meter.spent().items():
            before = self._began_spent.get((thread, part), Spent())
            calls = now.calls - before.calls
            spent = {"cpu_s": now.cpu_s - before.cpu_s, "calls": calls, "units": now.units - before.units}
            parts.append({"thread": thread, "part": part, **spent})
        return {"parts": parts, "meter_call_s": self._meter.cost_s()}

    def _look_again(self) -> None:
        self._look_at_quality()
        self._next_look = asyncio.get_running_loop().call_later(_LOOK_EVERY_S, self._look_again)

    def _look_at_quality(self) -> None:
        streams = [counts.stream for counts in self._counts]
        self._looks += len(streams)
        self._below_best += sum(stream.session.quality != stream.ladder.steps[0] for stream in streams)

    def _loads_by_thread(self, duration_s: float) -> dict[str, float]:
        """CPU load by name, of the threads that exist since the beginning."""
        return {
            thread.name: (_thread_cpu_s(thread) - began_s) / duration_s
            for thread, began_s in self._began_thread_cpu_s.items()
            if thread.is_alive()
        }


def _describe(quality: QualityStep) -> str:
    """A quality step in words, such as "standard, 5 responses a second"."""
    rate = "" if quality.ir_rate_hz is None else f", {quality.ir_rate_hz:g} responses a second"
    shared = {Sharing.NOTHING: "", Sharing.TAIL: ", shared tail", Sharing.REVERBERATION: ", shared reverberation"}
    return f"{quality.level}{rate}{shared[quality.sharing]}"


def _thread_cpu_s(thread: threading.Thread) -> float:
    assert thread.ident is not None
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def resident_bytes() -> int | None:
    """Memory of this process that is in use now; None where the system does not say."""
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if status.exists() else None


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
