"""The soak test: a server, hostile clients, and a witness that checks whether they affect other streams.

- `samples_not_finite`: number of such samples that clients received or that the server rendered.
- `crashes`: early ends of the server, uncaught exceptions, and 5xx answers except 503, which means that it is busy.
- `faults_unanswered`: invalid messages that were not refused.
- `memory_growth`: growth of the server's resident memory after six minutes, when its caches are full. It compares the
  medians of the last and the first fifth of the remaining time. Runs of less than twelve minutes leave it out.
- `drift_db`: see `server.soak.witness`. `silence_to_sound`: see `server.soak.silence`; it is measured at the end.
- `blocks_late` is reported but not judged, since it depends on how busy the host is.
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
from server.protocol.client_messages import Acknowledge
from server.protocol.packets import BlockReader
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
"""Probability of a valid coordinate, and of each invalid one."""

_FILLING_S = 360.0
"""Time until the caches are full; with three clients it takes four to six minutes."""
_LEAST_S = 2 * _FILLING_S
"""Shortest run for which memory is judged."""

_NOT_FINITE = Goal("samples not finite", 0, is_at_most=True)
_CRASHES = Goal("crashes", 0, is_at_most=True)
_UNANSWERED = Goal("faults unanswered", 0, is_at_most=True)
_GROWTH = Goal("memory growth", 0.05, is_at_most=True)
_ERROR = Goal("largest error of the witness, dB", -90, is_at_most=True)
_DRIFT = Goal("drift of the witness, dB", 1.0, is_at_most=True)
_SILENCE = Goal("a block in silence over one in sound", 1.0, is_at_most=True)

Advance = Callable[[float], None]
"""Progress callback; it gets the share of the time that is over."""


@dataclass(frozen=True)
class Plan:
    scene: str = "apartment"
    duration_s: float = 1_800.0
    clients: int = 3
    """Number of hostile clients at any time."""
    seed: int = 0


def soak(plan: Plan, advance: Advance = lambda _: None) -> dict[str, Any]:
    """Run the soak test. Raises NafirError if the server does not start or ends before the first sound."""
    folder = find_bundle(plan.scene)
    levels = FieldsByLevel.load(Bundle.load(folder))
    with serve(folder) as host:
        measured = asyncio.run(_Soak(plan, levels, host, advance).run())
    measured["silence_to_sound"] = silence_to_sound(levels.default)
    measured["summary"] = [asdict(judgement) for judgement in judge(measured)]
    return measured


def judge(measured: dict[str, Any]) -> list[Judgement]:
    """Judge the measurements against the requirements. A requirement that was not tested, because no block was received
    or no fault was sent, counts as not met."""
    silent = None if measured["blocks"] else "no hostile client heard a block"
    harmless = None if measured["faults"] else "no client did anything that had to be refused"
    unmeasured = None if measured["witness"]["seconds"] else "the witness heard nothing"
    return [
        _NOT_FINITE.judge(measured["samples_not_finite"], failure=silent),
        _CRASHES.judge(measured["crashes"]),
        _UNANSWERED.judge(measured["faults_unanswered"], failure=harmless),
        _judge_growth(measured),
        _ERROR.judge(measured["witness"]["worst_error_db"], failure=unmeasured),
        _DRIFT.judge(measured["witness"]["drift_db"], failure=unmeasured),
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
        """Pairs of seconds since the beginning and resident bytes."""
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
        """Run the witness's stream, which must not break."""
        witness = self._witness
        try:
            async with connect(self._url, compression=None) as socket:
                await socket.send(witness.hello.serialize())
                welcome = parse_server_message(str(await socket.recv()))
                if not isinstance(welcome, Welcome):
                    raise NafirError(f"the witness was refused: {welcome.serialize()}")
                reader = BlockReader(welcome)
                await socket.send(witness.emitter.serialize())
                while not over.is_set():
                    message = await socket.recv()
                    if isinstance(message, str):
                        event = parse_server_message(message)
                        if isinstance(event, EmitterAdded):
                            witness.begin(event.sample_clock)
                        continue
                    block = reader.read(message)
                    witness.compare(block)
                    self._blocks += 1
                    self._blocks_late += block.is_late
                    self._not_finite += block.samples.size - int(np.count_nonzero(np.isfinite(block.samples)))
                    if self._blocks % _ACKNOWLEDGE_EVERY == 0:
                        await socket.send(Acknowledge(sequence=block.sequence).serialize())
        except (OSError, WebSocketException) as exc:
            self._complaints.append(f"witness: {type(exc).__name__}: {exc}")

    async def _visit(self, over: asyncio.Event) -> None:
        """Send valid and invalid HTTP requests."""
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
    """Relative growth of the memory samples; None if there are too few."""
    fifth = len(samples) // _FIFTH
    if fifth == 0:
        return None
    return statistics.median(samples[-fifth:]) / statistics.median(samples[:fifth]) - 1
