"""Number of listeners that one core serves. A server runs on one core, and many clients on the others, connected over
the loopback interface.

Two scenes are measured unless one is chosen, since neither is the harder one in everything, and a goal has to hold in
both:

- `apartment` is a scene as users have it, at its default level (`auto`): a trained field, whose responses take a good
  part of the time, the planner of effects, and all else as in `nafir serve`. Its sound is at 24 kHz, its impulse
  responses (IRs) have 0.6 s.
- `bench` (`server.bench.scene`) isolates rendering: 48 kHz and IRs of a second, which a bank answers in no time.

Blocks have 256 samples. Everybody hears emitters of their own, which play noise without end, and walks in a circle,
with 30 poses a second by default. Direct paths follow each pose, and IRs as fast as the core can. Emitters stand unless
`sways` is set: to a listener who walks, all of them move. With several `listeners` a session is a stream that has so
many, each with poses of its own; counts of blocks and poses are of all of them.

- A run passes if every session has a stream, gets the blocks that are sent to it and sees its poses followed, if there
  was no error, and if fewer than one block in a thousand was late. Only a run that passes can reach a goal.
- Goals are for 60 s or longer and 30 poses a second or more. A run with less reaches none and misses none.
- A block is late if it reaches the socket later than a player with the usual reserve of 8 blocks needs it, or if it is
  never made. `late_share` is the share of late blocks among all blocks that were due.
- `sessions`: the largest number that passes. Steps of a few seconds find it to within 5 %, and a long run confirms it;
  if that fails, a tenth less is tried, and so on. A step ends as soon as it has failed. Unless it fails by far, it is
  tried once more, since other tenants of the machine may have disturbed it.
- `with_20_sessions`: the same with 16 emitters and 20 listeners, if more are possible and runs are long enough for
  goals. Latency is judged there and not at the limit; where 20 are too many, its goals are missed.
- `block_ms`: time to render a block, or its share of blocks rendered together. `lateness_ms`: time from when a block
  was due until it was ready.
- `pose_to_audio_ms`: time from a pose's arrival at the server until the first block that follows it is passed to the
  socket. `pose_to_reverberation_ms`: the same for the first block with IRs of that pose. `client_…`: both as a client
  measures them. A pose counts from its own arrival, however many newer ones overtake it, and counts with its wait so
  far if it was never answered. `longest` is the longest wait.
- `behind_s`: for each stream, how long the oldest pose without its reverberation had waited at the end. A run fails if
  one has waited for too long: a reverberation that stands still is a wrong sound.
- `quality_at_end`: number of streams by quality. `below_best_share`: share of the time that streams spent below the
  best quality of their ladder.
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
from itertools import chain
from typing import IO, Any, NamedTuple

from server.bench.crowd import BLOCK_SIZE, Crowd
from server.bench.gauge import latencies
from server.bench.host import ADMISSION, METER
from server.bench.machine import describe_machine, has_wide_vectors
from server.bench.places import Places
from server.bench.report import Goal, Judgement
from server.bench.scene import SCENE, bundle_of
from server.core.errors import NafirError
from server.protocol.client_messages import BlockSize

LATE_SHARE = 0.001
_HOPELESS = 0.5
_ON_THEIR_WAY = 64
"""Blocks of a listener that may be sent but not received yet when a run ends."""
_SETTLE_S = 2.0
_LOOK_EVERY_S = 2.0
_MOST = 512
_PATIENCE_S = 20.0
_OPEN_S = 30.0
"""How long all sessions of a run may take to open: on a server that has room, a thirtieth of a second each."""
_READY_S = 600.0
"""Limit for becoming ready. Kernels may have to be compiled first."""

MOST_EMITTERS = 16
"""Emitters of a stream that the bench's server allows, as `nafir serve` does by default."""
_BEHIND_S = 5.0
"""How long a reverberation may stand still while its listener moves."""
_JUDGED = 20
"""Sessions at which latency is judged."""
_AT_GOAL = f"with_{_JUDGED}_sessions"
_GOAL_S = 60.0
_GOAL_POSES_PER_S = 30.0
"""Conditions under which goals are judged, at the least."""

Advance = Callable[[str], None]
"""Progress callback; it gets a description of the step just done."""


@dataclass(frozen=True)
class Goals:
    """The goals of a processor, for one core and one scene."""

    sixteen: Goal
    one: Goal
    pose_to_audio: Goal
    pose_to_reverberation: Goal

    @classmethod
    def of(cls, scene: str, instructions: str | None = None) -> "Goals":
        """The goals in a scene of a processor with these `instructions`, by default of this one. Whatever is not
        AVX-512 has those of AVX2."""
        wide = has_wide_vectors(instructions)
        at_20 = f"with {_JUDGED} sessions of 16 emitters, p99, ms"
        return cls(
            Goal(f"{scene}: sessions per core, 16 emitters", *((40, 80) if wide else (20, 40))),
            Goal(f"{scene}: sessions per core, 1 emitter", *((120, 200) if wide else (80, 120))),
            Goal(f"{scene}: pose to audio {at_20}", *((8, 6) if wide else (12, 8)), is_at_most=True),
            Goal(f"{scene}: pose to reverberation {at_20}", 250, 100, is_at_most=True),
        )


@dataclass(frozen=True)
class Plan:
    """Parameters of a run. Without `sessions` the largest possible number is searched."""

    scenes: tuple[str, ...] = ("apartment", SCENE)
    emitters: tuple[int, ...] = (1, 16)
    sessions: int | None = None
    duration_s: float = 60.0
    step_s: float = 8.0
    poses_per_s: float = 30.0
    """Poses per second of each listener; with 0 they stand still."""
    sways: bool = False
    """Whether emitters move as well, as often as their listener."""
    block_size: BlockSize = BLOCK_SIZE
    listeners: int = 1
    """Of each stream."""
    near: int | None = None
    """Where the search begins, if it is known about how many sessions there will be."""


def measure_sessions(plan: Plan, advance: Advance = lambda _: None) -> dict[str, Any]:
    """Measure one case for each scene and number of emitters. If interrupted after the first case, it returns the cases
    so far with `is_complete` false. Raises NafirError if a process cannot be confined to a core, the server does not
    start, or there is no such scene."""
    places = {scene: Places.of(bundle_of(scene)) for scene in plan.scenes}
    cases: list[dict[str, Any]] = []
    try:
        with own_core() as (core, has_others):
            for scene, its_places in places.items():
                with served(core, scene) as server:
                    asyncio.run(_measure(plan, its_places, server.port, advance, cases))
    except KeyboardInterrupt:
        if not cases:
            raise
    measured: dict[str, Any] = {
        "host": describe_machine(),
        "scenes": [describe_scene(each) for each in places.values()],
        "block_size": plan.block_size,
        "poses_per_s": plan.poses_per_s,
        "emitters_move": plan.sways,
        "listeners": plan.listeners,
        "duration_s": plan.duration_s,
        "clients_have_other_cores": has_others,
        "is_complete": len(cases) == len(plan.emitters) * len(places),
        "cases": cases,
    }
    measured["summary"] = [asdict(judgement) for judgement in judge(cases)]
    return measured


@contextlib.contextmanager
def own_core() -> Iterator[tuple[int, bool]]:
    """Keep this process off one core, which a server is to have to itself. Yields its number, and whether there are
    others. Raises NafirError if the system cannot confine a process to a core."""
    if not hasattr(os, "sched_setaffinity"):
        raise NafirError("this system cannot confine a process to one core")
    usable = os.sched_getaffinity(0)
    core = max(usable)
    os.sched_setaffinity(0, usable - {core} or usable)
    try:
        yield core, len(usable) > 1
    finally:
        os.sched_setaffinity(0, usable)


def describe_scene(places: Places) -> dict[str, Any]:
    manifest = places.bundle.manifest
    codec = manifest.codec
    return {
        "id": manifest.id,
        "sample_rate": codec.sample_rate,
        "ir_s": codec.samples / codec.sample_rate,
        "walk_radius_m": places.walk.radius_m,
    }


def judge(cases: list[dict[str, Any]], instructions: str | None = None) -> list[Judgement]:
    """Judge the cases of each scene against the goals, which are for 1 and for 16 emitters. Only a run that passed can
    reach a goal."""
    judgements: list[Judgement] = []
    for scene in dict.fromkeys(case["scene"] for case in cases):
        goals = Goals.of(scene, instructions)
        by_emitters = {case["emitters"]: case for case in cases if case["scene"] == scene}
        one, sixteen = by_emitters.get(1), by_emitters.get(16)
        judgements += [
            goals.sixteen.skip("needs 16 emitters") if sixteen is None else _judge_sessions(goals.sixteen, sixteen),
            goals.one.skip("needs 1 emitter") if one is None else _judge_sessions(goals.one, one),
        ]
        for goal, measure in (
            (goals.pose_to_audio, "pose_to_audio_ms"),
            (goals.pose_to_reverberation, "pose_to_reverberation_ms"),
        ):
            judgements.append(
                goal.skip("needs 16 emitters") if sixteen is None else _judge_poses(goal, measure, sixteen)
            )
    return judgements


def _judge_sessions(goal: Goal, case: dict[str, Any]) -> Judgement:
    reason = failure(case)
    if reason is None:
        if (too_easy := _too_easy(case)) is not None:
            return goal.skip(too_easy)
        if case["is_given"] and case["sessions"] < goal.limit:
            return goal.skip(f"only {case['sessions']} were asked for")
    return goal.judge(case["sessions"], failure=reason, note=below_best(case))


def _judge_poses(goal: Goal, measure: str, case: dict[str, Any]) -> Judgement:
    run = case.get(_AT_GOAL, case)
    reason = failure(run)
    if reason is None:
        if (too_easy := _too_easy(run)) is not None:
            return goal.skip(too_easy)
        if run["sessions"] < _JUDGED:
            if case["is_given"]:
                return goal.skip(f"only {run['sessions']} sessions were asked for")
            reason = f"no more than {run['sessions']} sessions passed"
    return goal.judge(run.get(measure, {}).get("p99"), failure=reason, note=below_best(run))


def _too_easy(run: dict[str, Any]) -> str | None:
    """Why a run that passed says nothing of the goals, since it is another or easier; None if it does."""
    if (listeners := run.get("listeners", 1)) != 1:
        return f"the goal is for streams of one listener, and these had {listeners}"
    if run["poses_per_s"] == 0:
        return "nobody moves"
    if run["poses_per_s"] < _GOAL_POSES_PER_S:
        return f"the goal is for {_GOAL_POSES_PER_S:g} poses a second, and there were {run['poses_per_s']:g}"
    if run["duration_s"] < _GOAL_S:
        return f"the goal is for {_GOAL_S:g} s, and this run took {run['duration_s']:.0f}"
    return None


def below_best(run: dict[str, Any]) -> str | None:
    """How long the streams of a run had less than their best quality; None if they always had it."""
    share = run.get("below_best_share", 0.0)
    if share == 0:
        return None
    ends = "; ".join(f"{count} at {name}" for name, count in run["quality_at_end"].items())
    return f"below the best quality for {share:.0%} of the time, at the end {ends}"


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
    if run["blocks_heard"] < run["blocks_sent"] - _ON_THEIR_WAY * run["sessions"] * run.get("listeners", 1):
        return f"{run['sessions']} sessions heard {run['blocks_heard']} of {run['blocks_sent']} blocks"
    if run["poses_per_s"] > 0:
        for heard, measure in (("sound", "pose_to_audio_ms"), ("reverberation", "pose_to_reverberation_ms")):
            if not run[measure]["answered"]:
                return f"no pose of {run['sessions']} sessions was followed by {heard}"
        stuck = [behind_s for behind_s in run["behind_s"] if behind_s > _BEHIND_S]
        if stuck:
            worst = f"stood still, for {max(stuck):.0f} s at the worst; {_BEHIND_S:g} may be"
            return f"of {run['sessions']} sessions the reverberation of {len(stuck)} {worst}"
    return None


def failures(cases: list[dict[str, Any]]) -> list[str]:
    """One line for each case without a run that passed."""
    found = [(case["scene"], case["emitters"], failure(case)) for case in cases]
    return [f"{scene}, {emitters} emitters: {reason}" for scene, emitters, reason in found if reason is not None]


async def find_most(passes: Callable[[int], Awaitable[bool]], *, most: int, near: int | None = None) -> int:
    """The largest number up to `most` that passes, to within 5 %; 0 if none does. Assumes that all numbers below one
    that passes pass, too. It is found soon if it is `near` a number that is given."""
    good, bad = 0, most + 1
    first = None if near is None else min(max(1, near), most)
    stride = max(1, (near or 0) // 10)
    while bad - good > max(1, good // 20):
        if good and bad <= most:
            number = (good + bad) // 2
        elif first is not None:
            number, first = first, None
        elif near is not None:
            number = min(good + stride, most) if good else max(1, bad - stride)
            stride *= 2
        else:
            # Numbers are not doubled: a run with far too many sessions takes long to fail, since they hardly open.
            number = min(max(8, good + good // 2), most) if bad > most else (good + bad) // 2
        if await passes(number):
            good = number
        else:
            bad = number
    return good


async def _measure(plan: Plan, places: Places, port: int, advance: Advance, cases: list[dict[str, Any]]) -> None:
    for emitters in plan.emitters:
        crowd = Crowd(
            port,
            places,
            emitters=emitters,
            poses_per_s=plan.poses_per_s,
            sways=plan.sways,
            block_size=plan.block_size,
            listeners=plan.listeners,
        )
        trial = Trial(port, crowd, advance)
        try:
            case = await _measure_case(plan, trial)
            cases.append({"scene": places.bundle.id, "emitters": emitters, **case, "trials": trial.history})
        finally:
            await trial.crowd.close()


async def _measure_case(plan: Plan, trial: "Trial") -> dict[str, Any]:
    if plan.sessions is not None:
        return {**await trial.run(plan.sessions, plan.duration_s), "is_given": True}

    async def passes(sessions: int) -> bool:
        first = await trial.run(sessions, plan.step_s, until_failed=True)
        if first["late_share"] > _HOPELESS or failure(first) is None:
            return failure(first) is None
        return failure(await trial.run(sessions, plan.step_s, until_failed=True)) is None

    sessions = await find_most(passes, most=_MOST, near=plan.near)
    while sessions > 0:
        confirmed = await trial.run(sessions, plan.duration_s, until_failed=True)
        if failure(confirmed) is None:
            if trial.emitters == 16 and sessions > _JUDGED and plan.duration_s >= _GOAL_S:
                confirmed[_AT_GOAL] = await trial.run(_JUDGED, plan.duration_s)
            return {**confirmed, "is_given": False}
        sessions -= max(1, sessions // 10)
    return {"sessions": 0, "is_given": False}


class Trial:
    """Trials with one crowd. Clients stay connected from one trial to the next."""

    def __init__(self, port: int, crowd: Crowd, advance: Advance) -> None:
        self.crowd = crowd
        self.emitters = crowd.emitters
        self.history: list[dict[str, Any]] = []
        self._url = f"http://127.0.0.1:{port}/bench"
        self._advance = advance

    async def run(self, sessions: int, duration_s: float, *, until_failed: bool = False) -> dict[str, Any]:
        """Run one trial. If the server cannot open that many streams or cannot report, `late_share` is 1, and `errors`
        says why."""
        try:
            measured = await self._run(sessions, duration_s, until_failed)
        except (OSError, TimeoutError) as exc:
            measured = {"sessions": sessions, "late_share": 1.0, "errors": [str(exc) or type(exc).__name__]}
        self.history.append({name: measured[name] for name in ("sessions", "late_share", "errors")})
        self._advance(
            f"{self.crowd.scene}: {sessions} sessions of {self.emitters} emitters, {measured['late_share']:.2%} late"
        )
        return measured

    async def _run(self, sessions: int, duration_s: float, until_failed: bool) -> dict[str, Any]:
        try:
            async with asyncio.timeout(_OPEN_S):
                await self.crowd.resize(sessions)
        except TimeoutError as exc:
            raise TimeoutError(f"not all of {sessions} sessions opened within {_OPEN_S:g} s") from exc
        await asyncio.sleep(_SETTLE_S)
        await self._ask("begin")
        walkers = self.crowd.walkers
        for walker in walkers:
            walker.begin()
        started_s, started_cpu_s = time.perf_counter(), time.process_time()
        too_many = LATE_SHARE * sessions * duration_s * self.crowd.blocks_per_s if until_failed else math.inf
        await self._wait(duration_s, too_many)
        client_load = (time.process_time() - started_cpu_s) / (time.perf_counter() - started_s)
        measured = await self._ask("report")
        now_s = time.monotonic()
        due = sum(measured[name] for name in ("blocks_sent", "blocks_dropped", "blocks_missing"))
        return {
            "sessions": sessions,
            "listeners": self.crowd.listeners,
            "poses_per_s": self.crowd.poses_per_s,
            "late_share": min(1.0, count_late(measured) / due) if due else 1.0,
            **measured,
            "client_pose_to_audio_ms": latencies(chain(*(each.waits.direct.values() for each in walkers)), now_s),
            "client_pose_to_reverberation_ms": latencies(
                chain(*(each.waits.reverberation.values() for each in walkers)), now_s
            ),
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


class Served(NamedTuple):
    """A running server: its port, and the memory that its scene took when it was loaded."""

    port: int
    scene_bytes: int


@contextlib.contextmanager
def served(core: int, scene: str, *, is_metered: bool = False, admits: bool = False) -> Iterator[Served]:
    """Run a server of a scene on one core. Yields where it is once it is ready and has measured the costs of effects.
    With `is_metered` its reports say what each part of its work costs; if it `admits` others, it refuses those without
    room."""
    options = [name for name, is_wanted in ((METER, is_metered), (ADMISSION, admits)) if is_wanted]
    command = [sys.executable, "-m", "server.bench.host", str(core), scene, *options]
    # In a process group of its own, so that Ctrl-C does not reach it. It ends with this process.
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, process_group=0
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            server = _read_served(process.stdout)
            _wait_until(lambda: _is_ready(server.port))
            _wait_until(lambda: _get(f"http://127.0.0.1:{server.port}/bench/settled")["is_settled"])
            yield server
        finally:
            process.stdin.close()
            process.wait()


def _read_served(stdout: IO[str]) -> Served:
    line = stdout.readline()
    if not line:
        raise NafirError("the bench's server did not start")
    return Served(**json.loads(line))


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
