"""Number of listeners that one core serves. A server runs on one core, and many clients on the others, connected over
the loopback interface.

The scene's field takes hardly any time (`server.bench.scene`); everything else is as in `nafir serve`: blocks of 256
samples at 48 kHz, and impulse responses (IRs) of a second for each emitter. The emitters play noise without end. Every
listener sends 30 poses a second by default. Direct paths follow each pose, and IRs as fast as the core can.

- A run passes if every session has a stream, gets the blocks that are sent to it and sees its poses followed, if there
  was no error, and if fewer than one block in a thousand was late. Only a run that passes can reach a goal.
- A block is late if it reaches the socket later than a player with the usual reserve of 8 blocks needs it, or if it is
  never made. `late_share` is the share of late blocks among all blocks that were due.
- `sessions`: the largest number that passes. Steps of a few seconds find it to within 5 %, and a long run confirms it;
  if that fails, a tenth less is tried, and so on. A step ends as soon as it has failed. Unless it fails by far, it is
  tried once more, since other tenants of the machine may have disturbed it.
- `with_20_sessions`: the same with 16 emitters and the goal's number of listeners, if more are possible. Latency is
  judged there and not at the limit.
- `block_ms`: time to render a block, or its share of blocks rendered together. `lateness_ms`: time from when a block
  was due until it was ready.
- `pose_to_audio_ms`: time from a pose's arrival at the server until the first block that follows it is passed to the
  socket. `pose_to_reverberation_ms`: the same for the first block with IRs of that pose. `client_pose_to_audio_ms`: the
  former as a client measures it.
- `server_load`, `client_load`: CPU time divided by wall time; the server's also by thread: audio, impulse responses,
  and the event loop (`MainThread`). If the clients' load is near 1, they limit the result and not the server.
"""

import asyncio
import contextlib
import json
import math
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import asdict, dataclass
from typing import IO, Any

from server.bench.crowd import Crowd
from server.bench.gauge import merged
from server.bench.host import ADMISSION
from server.bench.machine import describe_machine
from server.bench.report import Goal, Judgement
from server.bench.scene import IR_S, SAMPLE_RATE
from server.core.errors import NafirError

_BLOCK_SIZE = 256
LATE_SHARE = 0.001
_HOPELESS = 0.5
_ON_THEIR_WAY = 64
"""Blocks of a session that may be sent but not received yet when a run ends."""
_SETTLE_S = 2.0
_LOOK_EVERY_S = 2.0
_MOST = 512
_PATIENCE_S = 20.0
_READY_S = 120.0
"""Limit for becoming ready. Kernels may have to be compiled first."""

_GOAL = 20
_AT_GOAL = f"with_{_GOAL}_sessions"
_SESSIONS = Goal("sessions per core, 16 emitters", _GOAL, 40)
_POSE_TO_AUDIO = Goal("pose to audio on the server, p99, ms", 15, 8, is_at_most=True)

Advance = Callable[[str], None]
"""Progress callback; it gets a description of the step just done."""


@dataclass(frozen=True)
class Plan:
    """Parameters of a run. Without `sessions` the largest possible number is searched."""

    emitters: tuple[int, ...] = (1, 4, 16)
    sessions: int | None = None
    duration_s: float = 60.0
    step_s: float = 8.0
    poses_per_s: float = 30.0
    """Poses per second of each listener; with 0 they stand still."""


def measure_sessions(plan: Plan, advance: Advance = lambda _: None) -> dict[str, Any]:
    """Measure one case for each number of emitters. If interrupted after the first case, it returns the cases so far
    with `is_complete` false. Raises NafirError if a process cannot be confined to a core or the server does not
    start."""
    cases: list[dict[str, Any]] = []
    with one_core() as core, serve(core) as port:
        try:
            asyncio.run(_measure(plan, port, advance, cases))
        except KeyboardInterrupt:
            if not cases:
                raise
    measured: dict[str, Any] = {
        "host": describe_machine(),
        "block_size": _BLOCK_SIZE,
        "sample_rate": SAMPLE_RATE,
        "ir_s": IR_S,
        "poses_per_s": plan.poses_per_s,
        "duration_s": plan.duration_s,
        "clients_have_other_cores": len(usable_cores()) > 1,
        "is_complete": len(cases) == len(plan.emitters),
        "cases": cases,
    }
    measured["summary"] = [asdict(judgement) for judgement in judge(cases)]
    return measured


def usable_cores() -> set[int]:
    """Numbers of the cores that this process may use. Raises NafirError if the system cannot confine a process."""
    if not hasattr(os, "sched_setaffinity"):
        raise NafirError("this system cannot confine a process to one core")
    return os.sched_getaffinity(0)


@contextlib.contextmanager
def one_core() -> Iterator[int]:
    """Keep this process from the last core that it may use, where it has others; yields the number of that core."""
    usable = usable_cores()
    core = max(usable)
    os.sched_setaffinity(0, usable - {core} or usable)
    try:
        yield core
    finally:
        os.sched_setaffinity(0, usable)


def judge(cases: list[dict[str, Any]]) -> list[Judgement]:
    """Judge the cases against the goals, which are for 16 emitters. Only a run that passed can reach a goal."""
    sixteen = next((case for case in cases if case["emitters"] == 16), None)
    if sixteen is None:
        return [goal.skip("needs 16 emitters") for goal in (_SESSIONS, _POSE_TO_AUDIO)]
    return [_judge_sessions(sixteen), _judge_poses(sixteen.get(_AT_GOAL, sixteen))]


def _judge_sessions(case: dict[str, Any]) -> Judgement:
    reason = failure(case)
    if reason is None and case["is_given"] and case["sessions"] < _SESSIONS.limit:
        return _SESSIONS.skip(f"only {case['sessions']} were asked for")
    return _SESSIONS.judge(case["sessions"], failure=reason)


def _judge_poses(run: dict[str, Any]) -> Judgement:
    reason = failure(run)
    if reason is None and run["poses_per_s"] == 0:
        return _POSE_TO_AUDIO.skip("nobody moves")
    return _POSE_TO_AUDIO.judge(run.get("pose_to_audio_ms", {}).get("p99"), failure=reason)


def failure(run: dict[str, Any]) -> str | None:
    """Why a run did not pass; None if it passed."""
    if run["sessions"] == 0:
        return "no number of sessions passed"
    if run["errors"]:
        return f"of {run['sessions']} sessions: {'; '.join(run['errors'])}"
    if run["streams"] < run["sessions"]:
        return f"only {run['streams']} of {run['sessions']} sessions had a stream"
    if run["blocks_sent"] == 0:
        return f"{run['sessions']} sessions were sent no block"
    if run["late_share"] >= LATE_SHARE:
        missing = f", {run['blocks_missing']} never made" if run["blocks_missing"] else ""
        late = f"of {run['sessions']} sessions {run['late_share']:.2%} of blocks were late{missing}"
        return f"{late}; under {LATE_SHARE:.1%} may be"
    if run["blocks_heard"] < run["blocks_sent"] - _ON_THEIR_WAY * run["sessions"]:
        return f"{run['sessions']} sessions heard {run['blocks_heard']} of {run['blocks_sent']} blocks"
    if run["poses_per_s"] > 0 and run["pose_to_audio_ms"]["p99"] is None:
        return f"no pose of {run['sessions']} sessions was followed"
    return None


def failures(cases: list[dict[str, Any]]) -> list[str]:
    """One line for each case without a run that passed."""
    found = [(case["emitters"], failure(case)) for case in cases]
    return [f"{emitters} emitters: {reason}" for emitters, reason in found if reason is not None]


async def find_most(passes: Callable[[int], Awaitable[bool]], *, most: int) -> int:
    """The largest number up to `most` that passes, to within 5 %; 0 if none does. Assumes that all numbers below one
    that passes pass, too."""
    good, bad = 0, most + 1
    while bad - good > max(1, good // 20):
        # Numbers are not doubled: a run with far too many sessions takes long to fail, since they hardly open.
        number = min(max(8, good + good // 2), most) if bad > most else (good + bad) // 2
        if await passes(number):
            good = number
        else:
            bad = number
    return good


async def _measure(plan: Plan, port: int, advance: Advance, cases: list[dict[str, Any]]) -> None:
    for emitters in plan.emitters:
        trial = _Trial(port, emitters, plan.poses_per_s, advance)
        try:
            case = await _measure_case(plan, trial)
            cases.append({"emitters": emitters, **case, "trials": trial.history})
        finally:
            await trial.crowd.close()


async def _measure_case(plan: Plan, trial: "_Trial") -> dict[str, Any]:
    if plan.sessions is not None:
        return {**await trial.run(plan.sessions, plan.duration_s), "is_given": True}

    async def passes(sessions: int) -> bool:
        first = await trial.run(sessions, plan.step_s, until_failed=True)
        if first["late_share"] > _HOPELESS or failure(first) is None:
            return failure(first) is None
        return failure(await trial.run(sessions, plan.step_s, until_failed=True)) is None

    sessions = await find_most(passes, most=_MOST)
    while sessions > 0:
        confirmed = await trial.run(sessions, plan.duration_s, until_failed=True)
        if failure(confirmed) is None:
            if trial.emitters == 16 and sessions > _GOAL:
                confirmed[_AT_GOAL] = await trial.run(_GOAL, plan.duration_s)
            return {**confirmed, "is_given": False}
        sessions -= max(1, sessions // 10)
    return {"sessions": 0, "is_given": False}


class _Trial:
    """Trials with one number of emitters. Clients stay connected from one trial to the next."""

    def __init__(self, port: int, emitters: int, poses_per_s: float, advance: Advance) -> None:
        self.crowd = Crowd(port, emitters=emitters, poses_per_s=poses_per_s)
        self._poses_per_s = poses_per_s
        self.history: list[dict[str, Any]] = []
        self._url = f"http://127.0.0.1:{port}/bench"
        self.emitters = emitters
        self._advance = advance

    async def run(self, sessions: int, duration_s: float, *, until_failed: bool = False) -> dict[str, Any]:
        """Run one trial. If the server cannot open that many streams or cannot report, `late_share` is 1, and `errors`
        says why."""
        try:
            measured = await self._run(sessions, duration_s, until_failed)
        except (OSError, TimeoutError) as exc:
            measured = {"sessions": sessions, "late_share": 1.0, "errors": [str(exc) or type(exc).__name__]}
        self.history.append({name: measured[name] for name in ("sessions", "late_share", "errors")})
        self._advance(f"{sessions} sessions of {self.emitters} emitters: {measured['late_share']:.2%} late")
        return measured

    async def _run(self, sessions: int, duration_s: float, until_failed: bool) -> dict[str, Any]:
        await self.crowd.resize(sessions)
        await asyncio.sleep(_SETTLE_S)
        await self._ask("begin")
        walkers = self.crowd.walkers
        for walker in walkers:
            walker.begin()
        started_s, started_cpu_s = time.perf_counter(), time.process_time()
        too_many = LATE_SHARE * sessions * duration_s * SAMPLE_RATE / _BLOCK_SIZE if until_failed else math.inf
        await self._wait(duration_s, too_many)
        client_load = (time.process_time() - started_cpu_s) / (time.perf_counter() - started_s)
        measured = await self._ask("report")
        due = sum(measured[name] for name in ("blocks_sent", "blocks_dropped", "blocks_missing"))
        return {
            "sessions": sessions,
            "poses_per_s": self._poses_per_s,
            "late_share": min(1.0, count_late(measured) / due) if due else 1.0,
            **measured,
            "client_pose_to_audio_ms": merged(walker.poses.times for walker in walkers),
            "blocks_heard": sum(walker.blocks for walker in walkers),
            "client_load": client_load,
            "errors": sorted({error for walker in walkers for error in walker.errors}),
        }

    async def _wait(self, duration_s: float, too_many: float) -> None:
        """Wait for the duration, or until `too_many` blocks are late."""
        until_s = time.monotonic() + duration_s
        while (left_s := until_s - time.monotonic()) > 0:
            await asyncio.sleep(min(left_s, _LOOK_EVERY_S) if too_many < math.inf else left_s)
            if too_many < math.inf and count_late(await self._ask("blocks")) >= too_many:
                return

    async def _ask(self, what: str) -> dict[str, Any]:
        return await asyncio.to_thread(_get, f"{self._url}/{what}")


def count_late(measured: dict[str, Any]) -> int:
    return sum(measured[name] for name in ("blocks_late", "blocks_dropped", "blocks_missing"))


@contextlib.contextmanager
def serve(core: int, *, admits: bool = False) -> Iterator[int]:
    """Run a server on one core, which refuses streams without room if it `admits` others. Yields its port once it is
    ready and has measured the costs of effects."""
    command = [sys.executable, "-m", "server.bench.host", str(core), *([ADMISSION] if admits else [])]
    # In a process group of its own, so that Ctrl-C does not reach it. It ends with this process.
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, process_group=0
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            port = _read_port(process.stdout)
            _wait_until(lambda: _is_ready(port))
            _wait_until(lambda: _get(f"http://127.0.0.1:{port}/bench/settled")["is_settled"])
            yield port
        finally:
            process.stdin.close()
            process.wait()


def _read_port(stdout: IO[str]) -> int:
    line = stdout.readline()
    if not line:
        raise NafirError("the bench's server did not start")
    return int(json.loads(line)["port"])


def _wait_until(is_so: Callable[[], bool]) -> None:
    until_s = time.monotonic() + _READY_S
    while not is_so():
        if time.monotonic() > until_s:
            raise NafirError(f"the bench's server was not ready after {_READY_S:.0f} s")
        time.sleep(0.1)


def _is_ready(port: int) -> bool:
    try:
        _get(f"http://127.0.0.1:{port}/readyz")
    except urllib.error.HTTPError as answer:
        answer.close()
        return False
    except OSError:
        return False
    return True


def ask(port: int, what: str) -> dict[str, Any]:
    """The answer of a bench's server to `/bench/{what}`."""
    return _get(f"http://127.0.0.1:{port}/bench/{what}")


def _get(url: str) -> dict[str, Any]:
    with urllib.request.urlopen(url, timeout=_PATIENCE_S) as answer:
        document: dict[str, Any] = json.load(answer)
    return document
