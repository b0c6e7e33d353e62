"""Measures what a listener costs on one core of this machine: a few short runs of a server whose parts have clocks
(`server.bench.meter`), with few and with many sessions, of few and of many emitters.

The runs are those of `nafir bench stream`. The numbers of sessions follow from the runs before: two, then half of what
the model says that the core bears, then nearly all, and in the end more than it bears: a server that is asked for too
much shows what share of the core it gets, and what blocks cost when as many as possible are rendered at once. From few
sessions the model may expect far too many, which take long to open and longer to fail. So no run has more than
`_GROWTH` times the sessions of the one before, one that does not open is tried again with fewer, and none follows one
that was more than the core bears.
"""

import asyncio
import contextlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from server.bench.capacity import TERMS, Driver, Measured, Model, Run
from server.bench.crowd import BLOCK_SIZE, Crowd
from server.bench.history import current_commit
from server.bench.machine import instruction_set, processor
from server.bench.meter import THREADS, Thread, kind_of
from server.bench.places import Places
from server.bench.scene import bundle_of
from server.bench.sessions import Advance, Trial, own_core, served
from server.core.errors import NafirError

EMITTERS = 1, 4, 16
STEP_S = 4.0
_FEW = 2
_SHARES = 0.0, 0.5, 0.9, 1.2
"""Shares of what a core bears at which it is measured; the last is more than it bears."""
_GROWTH = 3.0
_FEWER = 0.7
"""Share of the sessions that did not open with which a run is tried again."""
_TRIES = 3
_OVERLOADED = 0.1
"""Late share of a run that was certainly more than the core bears."""
_MOST = 400
_LEAST_USABLE = 0.5
_SPARE: dict[Thread, str] = {"audio": "waking (audio)", "loop": "waking (loop)", "worker": "waking (workers)"}


def measure_costs(
    scene: str, *, poses_per_s: float = 30.0, step_s: float = STEP_S, advance: Advance = lambda _: None
) -> Measured:
    """Measure a scene: about two minutes. Raises NafirError if the server does not start, too few runs succeed, or the
    system cannot confine a process to a core."""
    places = Places.of(bundle_of(scene))
    with own_core() as (core, _), served(core, scene, is_metered=True) as server:
        first = Measured.model_construct(
            processor=processor(),
            instruction_set=instruction_set(),
            date=datetime.now(UTC).date().isoformat(),
            commit=current_commit(),
            scene=places.bundle.id,
            sample_rate=places.bundle.manifest.codec.sample_rate,
            block_size=BLOCK_SIZE,
            poses_per_s=poses_per_s,
            scene_bytes=float(max(0, server.scene_bytes)),
            usable_share=_LEAST_USABLE,
            runs=(),
        )
        return asyncio.run(_measure(first, places, server.port, step_s, advance))


async def _measure(measured: Measured, places: Places, port: int, step_s: float, advance: Advance) -> Measured:
    for emitters in EMITTERS:
        crowd = Crowd(port, places, emitters=emitters, poses_per_s=measured.poses_per_s)
        trial = Trial(port, crowd, advance)
        try:
            for share in _SHARES:
                before = [run for run in measured.runs if run.emitters == emitters]
                if share > 1 and before[-1].late_share >= _OVERLOADED:
                    continue
                sessions = _sessions(measured, emitters, share) if share else _FEW
                if before:
                    sessions = min(sessions, round(_GROWTH * max(run.sessions for run in before)))
                if any(run.sessions == sessions for run in before):
                    continue
                found = await _try(trial, sessions, step_s, is_needed=share < 1)
                if found is not None:
                    runs = (*measured.runs, run_of(found, emitters))
                    usable = min(1.0, max(measured.usable_share, found["server_load"]))
                    measured = measured.model_copy(update={"runs": runs, "usable_share": usable})
        finally:
            await crowd.close()
    return Measured.model_validate(measured.model_dump())


async def _try(trial: Trial, sessions: int, step_s: float, *, is_needed: bool) -> dict[str, Any] | None:
    """The report of a run in which there were blocks, if need be with fewer sessions; None for a run that failed and is
    not needed. Raises NafirError if it is."""
    for _ in range(_TRIES if is_needed else 1):
        found = await trial.run(sessions, step_s)
        if found.get("blocks_sent"):
            return found
        sessions = max(1, round(_FEWER * sessions))
    if not is_needed:
        return None
    why = "; ".join(found["errors"]) or "no block was sent"
    raise NafirError(f"{sessions} sessions of {trial.emitters} emitters: {why}")


def _sessions(measured: Measured, emitters: int, share: float) -> int:
    """So many sessions as take a share of a core, as far as the runs so far tell."""
    model = Model.of(measured.model_copy(update={"usable_share": 1.0}))
    return min(_MOST, max(1, round(share * model.most(emitters))))


def run_of(found: dict[str, Any], emitters: int) -> Run:
    """A run as the model wants it, from the report of a metered server."""
    duration_s, sessions = found["duration_s"], found["sessions"]
    spent: dict[tuple[str, str], dict[str, Any]] = {(each["thread"], each["part"]): each for each in found["parts"]}
    by_part: dict[str, float] = dict.fromkeys(TERMS, 0.0)
    clocks: dict[str, float] = dict.fromkeys(THREADS, 0.0)
    in_parts: dict[str, float] = dict.fromkeys(THREADS, 0.0)
    for (thread, part), each in spent.items():
        share = each["cpu_s"] / duration_s
        clocks[thread] += each["calls"] * found["meter_call_s"] / duration_s
        in_parts[thread] += share
        by_part[part] = by_part.get(part, 0.0) + share
    of_threads: dict[str, float] = dict.fromkeys(THREADS, 0.0)
    for name, share in found["server_load_by_thread"].items():
        if (kind := kind_of(name)) is not None:
            of_threads[kind] += share
    for kind, part in _SPARE.items():
        by_part[part] = max(0.0, of_threads[kind] - in_parts[kind] - clocks[kind])

    def count(part: str, of: str) -> float:
        return float(sum(each[of] for (_, its_part), each in spent.items() if its_part == part) / duration_s)

    blocks, groups = count("rendering", "units"), count("direct paths", "calls")
    plans = count("planning", "calls")
    rates: dict[Driver, float] = {
        "block": blocks,
        "block_emitter": blocks * emitters,
        "group": groups,
        "group_emitter": groups * emitters,
        "tick": count("rendering", "calls"),
        "message": found["messages"] / duration_s,
        "request": count("responses", "calls"),
        "response": count("responses", "units"),
        "plan": plans,
        "plan_emitter": plans * emitters,
        "check": count("checking plans", "calls"),
    }
    return Run(
        sessions=sessions,
        emitters=emitters,
        late_share=found["late_share"],
        rates=rates,
        shares=by_part,
        resident_bytes=float(found["resident_bytes"] or 0),
    )


def read_costs(path: Path) -> Measured:
    """Read a file of `nafir bench costs`. Raises NafirError, which names the file and the field."""
    try:
        return Measured.model_validate_json(path.read_bytes())
    except OSError as exc:
        raise NafirError(f"{path}: {exc.strerror or exc}") from exc
    except ValidationError as exc:
        problem = exc.errors()[0]
        field = ".".join(str(part) for part in problem["loc"]) or "document"
        raise NafirError(f"{path}: {field}: {problem['msg']}") from exc


def write_costs(path: Path, measured: Measured) -> None:
    """Raises NafirError if it cannot be written."""
    with _written(path):
        path.write_text(measured.model_dump_json(indent=2) + "\n", encoding="utf-8")


@contextlib.contextmanager
def _written(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as exc:
        raise NafirError(f"{path}: {exc.strerror or exc}") from exc


def listener_second(run: Run) -> list[dict[str, Any]]:
    """Rows of the table "where a listener-second goes": milliseconds of a core that each part takes for a listener in a
    second, and its share of all."""
    total = sum(run.shares.values())
    return [
        {
            "part": part,
            "thread": TERMS[part][0],
            "ms": 1000 * run.shares.get(part, 0.0) / run.sessions,
            "share": run.shares.get(part, 0.0) / total if total else 0.0,
        }
        for part in TERMS
    ]
