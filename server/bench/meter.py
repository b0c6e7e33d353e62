"""CPU time of a server by part: where a listener-second goes.

`Meter.install` puts a clock around the functions in which each part of the work happens, for the rest of the process:
only a benchmark's server does that. Times are CPU times of the thread, so other processes and waiting do not count.
What a function spends in another measured one counts there only. The rest of a thread's time, in which nothing measured
runs, is its *remainder*: waking, sleeping, the interpreter's loop.
"""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from typing import Any, Final, Literal, ParamSpec, TypeVar

from server.api.web_socket import WebSocketProtocol
from server.planning.planned_effects import PlanRequest
from server.protocol.blocks import AudioBlock
from server.rendering.renderer import Renderer
from server.streaming import audio_engine, stream
from server.streaming.plan_audit import PlanAudit
from server.streaming.session import Session
from server.streaming.stream import Stream

P = ParamSpec("P")
R = TypeVar("R")

Thread = Literal["audio", "loop", "worker"]
Part = Literal[
    "receiving",
    "inbox",
    "planning",
    "checking plans",
    "responses",
    "partitions",
    "direct paths",
    "rendering",
    "finishing",
    "encoding",
    "sending",
]
PARTS: Final[Mapping[Part, tuple[Thread, str]]] = {
    "receiving": ("loop", "messages of clients: cut from bytes, parsed, handed to their streams"),
    "inbox": ("audio", "messages and answers taken in, requests made"),
    "planning": ("worker", "plans of effects"),
    "checking plans": ("worker", "plans compared with everything on"),
    "responses": ("worker", "impulse responses from the field, with first reflections"),
    "partitions": ("worker", "their spectra, partition by partition"),
    "direct paths": ("audio", "direct paths found anew"),
    "rendering": ("audio", "direct paths and convolution, mixed and limited"),
    "finishing": ("audio", "blocks numbered and timed"),
    "encoding": ("loop", "blocks as bytes"),
    "sending": ("loop", "bytes to the socket"),
}
"""The parts, each with its kind of thread and what it does."""
THREADS: Final[Mapping[Thread, str]] = {"audio": "nafir-audio", "worker": "nafir-ir", "loop": "MainThread"}
"""Beginnings of the names of each kind of thread."""


@dataclass
class Spent:
    """CPU seconds of a part on a thread, its calls, and what it worked on in all of them (`units`): blocks for
    rendering, emitters for responses, and else calls."""

    cpu_s: float = 0.0
    calls: int = 0
    units: int = 0


class _Local(threading.local):
    """The state of one thread. For each measured function that is running, it has the seconds that measured functions
    within it took."""

    def __init__(self) -> None:
        self.inner_s: list[float] = []


class Meter:
    """Measures functions given to `timed`."""

    def __init__(self, time_s: Callable[[], float] = time.thread_time) -> None:
        self._time_s = time_s
        self._local = _Local()
        self._spent: dict[tuple[str, str], Spent] = {}
        """By the names of thread and part. Each entry is changed by its own thread alone."""

    def timed(
        self, part: str, function: Callable[P, R], units: Callable[..., int] = lambda *_, **__: 1
    ) -> Callable[P, R]:
        """The function with a clock around it. `units` counts, from the same arguments, what a call works on."""
        time_s, local, spent = self._time_s, self._local, self._spent

        @wraps(function)
        def measured(*args: P.args, **kwargs: P.kwargs) -> R:
            inner_s = local.inner_s
            began_s = time_s()
            inner_s.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                took_s = time_s() - began_s
                own_s = took_s - inner_s.pop()
                if inner_s:
                    inner_s[-1] += took_s
                key = threading.current_thread().name, part
                entry = spent.get(key)
                if entry is None:
                    entry = spent.setdefault(key, Spent())
                entry.cpu_s += own_s
                entry.calls += 1
                entry.units += units(*args, **kwargs)

        return measured

    def spent(self) -> dict[tuple[Thread, str], Spent]:
        """What has been spent so far, by kind of thread and part."""
        found: dict[tuple[Thread, str], Spent] = {}
        for (name, part), entry in tuple(self._spent.items()):
            if (kind := kind_of(name)) is not None:
                total = found.setdefault((kind, part), Spent())
                total.cpu_s += entry.cpu_s
                total.calls += entry.calls
                total.units += entry.units
        return found

    def cost_s(self, calls: int = 2_000) -> float:
        """CPU seconds that the clock around one call takes itself."""
        meter = Meter(self._time_s)
        nothing = meter.timed("nothing", lambda: None)
        began_s = self._time_s()
        for _ in range(calls):
            nothing()
        return (self._time_s() - began_s) / calls

    def install(self) -> None:
        """Measure this process's server from now on."""
        self._replace("receiving", WebSocketProtocol, "data_received")
        self._replace("inbox", Stream, "drain_inbox")
        self._replace("planning", PlanRequest, "plan")
        self._replace("checking plans", PlanAudit, "run")
        self._replace("responses", stream, "compute_irs", lambda _levels, request, _renderer: len(request.asked))
        self._replace("partitions", Renderer, "prepare")
        self._replace("direct paths", Session, "begin_block")
        self._replace("rendering", audio_engine, "render_all", len)
        self._replace("finishing", Stream, "finish_blocks")
        self._replace("encoding", AudioBlock, "serialize")
        self._replace("sending", WebSocketProtocol, "_write")

    def _replace(self, part: Part, owner: Any, name: str, units: Callable[..., int] | None = None) -> None:
        function = getattr(owner, name)
        setattr(owner, name, self.timed(part, function) if units is None else self.timed(part, function, units))


def kind_of(thread_name: str) -> Thread | None:
    """The kind of a server's thread; None for those that take no part in streams."""
    return next((kind for kind, beginning in THREADS.items() if thread_name.startswith(beginning)), None)
