"""Hours of streaming in minutes of malice: a server of its own, hostile clients, and a witness who hears whether any of
it shows.

- `samples_not_finite`: in what any client received, and, as the server counts, in what it rendered.
- `crashes`: the server's end before its time, exceptions that nobody caught, and answers of 5xx but for 503, which says
  that there is too much to do.
- `faults_unanswered`: messages that had to be refused and were not.
- `memory_growth`: of the server's resident memory once its caches have filled, after six minutes: the median of
  the last fifth of the time after that over the median of the first. A run of less than twelve minutes leaves it out.
- `drift_db`: see `server.soak.witness`. `silence_to_sound`: see `server.soak.silence`, measured when all else is over.
- `blocks_late` are told, not judged: they say how busy the host was.
"""

import asyncio
import math
import statistics
import time
import urllib.error
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

from server.bench.machine import describe_machine
from server.bench.report import Goal, Judgement
from server.core.errors import NafirError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import Acknowledge
from server.protocol.server_messages import EmitterAdded, Welcome, parse_server_message
from server.scene.bundle import Bundle, find_bundle
from server.soak.host import Host, serve
from server.soak.hostile import Hostile
from server.soak.silence import silence_to_sound
from server.soak.witness import Witness

_ACKNOWLEDGE_EVERY = 4
_WATCH_S = 2.0
_FIFTH = 5
_ODDS = 0.8, *5 * (0.04,)
"""Of a coordinate that is right, and of others."""

_FILLING_S = 360.0
"""How long caches fill: it takes them four to six minutes with three clients."""
_LEAST_S = 2 * _FILLING_S
"""That memory is judged for."""

_NOT_FINITE = Goal("samples not finite", 0, is_at_most=True)
_CRASHES = Goal("crashes", 0, is_at_most=True)
_UNANSWERED = Goal("faults unanswered", 0, is_at_most=True)
_GROWTH = Goal("memory growth", 0.05, is_at_most=True)
_ERROR = Goal("largest error of the witness, dB", -90, is_at_most=True)
_DRIFT = Goal("drift of the witness, dB", 1.0, is_at_most=True)
_SILENCE = Goal("a block in silence over one in sound", 1.0, is_at_most=True)

Advance = Callable[[float], None]
"""Told every now and then what share of the time is over."""


@dataclass(frozen=True)
class Plan:
    scene: str = "apartment"
    duration_s: float = 1_800.0
    clients: int = 3
    """Hostile ones, at any time."""
    seed: int = 0


def soak(plan: Plan, advance: Advance = lambda _: None) -> dict[str, Any]:
    """Raises NafirError where the server does not start or ends before the first sound."""
    folder = find_bundle(plan.scene)
    levels = FieldsByLevel.load(Bundle.load(folder))
    with serve(folder) as host:
        measured = asyncio.run(_Soak(plan, levels, host, advance).run())
    measured["silence_to_sound"] = silence_to_sound(levels.default)
    measured["summary"] = [asdict(judgement) for judgement in judge(measured)]
    return measured


def judge(measured: dict[str, Any]) -> list[Judgement]:
    """Beside what has to hold. What nobody tried does not hold: without a block heard, or a fault sent."""
    silent = None if measured["blocks"] else "no hostile client heard a block"
    harmless = None if measured["faults"] else "no client did anything that had to be refused"
    unheard = None if measured["witness"]["seconds"] else "the witness heard nothing"
    return [
        _NOT_FINITE.judge(measured["samples_not_finite"], failure=silent),
        _CRASHES.judge(measured["crashes"]),
        _UNANSWERED.judge(measured["faults_unanswered"], failure=harmless),
        _judge_growth(measured),
        _ERROR.judge(measured["witness"]["worst_error_db"], failure=unheard),
        _DRIFT.judge(measured["witness"]["drift_db"], failure=unheard),
        _SILENCE.judge(measured["silence_to_sound"]),
    ]


def _judge_growth(measured: dict[str, Any]) -> Judgement:
    if measured["duration_s"] < _LEAST_S:
        return _GROWTH.skip(
            f"caches fill for {_FILLING_S / 60:.0f} minutes: takes --minutes {_LEAST_S / 60:.0f} or more"
        )
    return _GROWTH.judge(measured["memory_growth"])


class _Soak:
    def __init__(self, plan: Plan, levels: FieldsByLevel, host: Host, advance: Advance) -> None:
        self._plan = plan
        self._host = host
        self._advance = advance
        self._witness = Witness(levels)
        self._url = f"ws://127.0.0.1:{host.port}/v1/stream"
        self._clients = [Hostile(self._url, plan.seed + number) for number in range(plan.clients)]
        self._memory: list[tuple[float, float]] = []
        """Seconds since the beginning, and bytes."""
        self._metrics: dict[str, float] = {}
        self._answers: Counter[int] = Counter()
        self._complaints: list[str] = []
        self._blocks = self._blocks_late = self._not_finite = 0

    async def run(self) -> dict[str, Any]:
        over = asyncio.Event()
        tasks = [
            asyncio.create_task(work)
            for work in (
                self._watch(over),
                self._listen(over),
                self._visit(over),
                *(client.run(self._plan.scene, over) for client in self._clients),
            )
        ]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
        return self._measured()

    async def _watch(self, over: asyncio.Event) -> None:
        started_s = time.monotonic()
        while (elapsed_s := time.monotonic() - started_s) < self._plan.duration_s and self._host.is_running:
            self._advance(elapsed_s / self._plan.duration_s)
            try:
                self._metrics = await asyncio.to_thread(self._host.metrics)
                self._memory.append((elapsed_s, self._metrics["process_resident_memory_bytes"]))
            except OSError as exc:
                self._complaints.append(f"/metrics: {exc}")
            await asyncio.sleep(_WATCH_S)
        over.set()

    async def _listen(self, over: asyncio.Event) -> None:
        """The witness's stream, which nothing may break."""
        witness = self._witness
        try:
            async with connect(self._url, compression=None) as socket:
                await socket.send(witness.hello.serialize())
                welcome = parse_server_message(str(await socket.recv()))
                if not isinstance(welcome, Welcome):
                    raise NafirError(f"the witness was refused: {welcome.serialize()}")
                await socket.send(witness.emitter.serialize())
                while not over.is_set():
                    message = await socket.recv()
                    if isinstance(message, str):
                        event = parse_server_message(message)
                        if isinstance(event, EmitterAdded):
                            witness.begin(event.sample_clock)
                        continue
                    block = AudioBlock.parse(message, welcome.encoding)
                    witness.hear(block)
                    self._blocks += 1
                    self._blocks_late += block.is_late
                    self._not_finite += block.samples.size - int(np.count_nonzero(np.isfinite(block.samples)))
                    if self._blocks % _ACKNOWLEDGE_EVERY == 0:
                        await socket.send(Acknowledge(sequence=block.sequence).serialize())
        except (OSError, WebSocketException) as exc:
            self._complaints.append(f"witness: {type(exc).__name__}: {exc}")

    async def _visit(self, over: asyncio.Event) -> None:
        """Requests over HTTP, good and bad."""
        rng = np.random.default_rng(self._plan.seed)
        path = f"/v1/scenes/{self._plan.scene}/impulse-response"
        start = self._witness.emitter.position
        while not over.is_set():
            point = [str(rng.choice((f"{at:g}", "1e9", "nan", "inf", "", "one"), p=_ODDS)) for at in start]
            query = f"listener={','.join(f'{at:g}' for at in start)}&emitter={','.join(point)}"
            query += f"&format={rng.choice(('wav', 'npy', 'json', 'mp3'))}"
            try:
                await asyncio.to_thread(self._host.get, f"{path}?{query}")
                self._answers[200] += 1
            except urllib.error.HTTPError as answer:
                self._answers[answer.code] += 1
                answer.close()
            except OSError as exc:
                self._complaints.append(f"{query}: {exc}")
            await asyncio.sleep(0.5)

    def _measured(self) -> dict[str, Any]:
        clients = self._clients
        failed = sum(count for code, count in self._answers.items() if code >= 500 and code != 503)
        complaints = self._complaints + [complaint for client in clients for complaint in client.complaints]
        complaints += self._host.tracebacks()
        ended_early = not self._host.is_running
        not_finite = self._not_finite + sum(client.samples_not_finite for client in clients)
        errors = self._witness.errors
        actions, faults, endings = (
            dict(sum((getattr(client, name) for client in clients), Counter()))
            for name in ("actions", "faults", "endings")
        )
        return {
            "host": describe_machine(),
            "scene": self._plan.scene,
            "duration_s": self._plan.duration_s,
            "clients": self._plan.clients,
            "seed": self._plan.seed,
            "samples_not_finite": not_finite + int(self._metrics.get("nafir_samples_not_finite_total", 0)),
            "crashes": ended_early + failed + len(complaints),
            "complaints": dict(Counter(complaints)),
            "faults_unanswered": sum(client.faults_unanswered for client in clients),
            "memory_growth": _growth([used for at_s, used in self._memory if at_s >= _FILLING_S]),
            "memory_mib": self._memory[-1][1] / 2**20 if self._memory else math.nan,
            "witness": {
                "seconds": len(errors.db),
                "worst_error_db": errors.worst_db,
                "drift_db": errors.drift_db(),
                "blocks": self._blocks,
                "blocks_late": self._blocks_late,
            },
            "blocks": sum(client.blocks for client in clients),
            "blocks_late": sum(client.blocks_late for client in clients),
            "actions": sum(actions.values()),
            "faults": sum(faults.values()),
            "kinds_of_fault": faults,
            "connections": endings,
            "http_answers": {str(code): count for code, count in sorted(self._answers.items())},
        }


def _growth(samples: list[float]) -> float | None:
    """None where there are too few samples to tell."""
    fifth = len(samples) // _FIFTH
    if fifth == 0:
        return None
    return statistics.median(samples[-fifth:]) / statistics.median(samples[:fifth]) - 1
