"""What happens when three times as many listeners ask at once as one core serves.

The number that a core serves is given, or found as in `server.bench.sessions`. Then a server that refuses what would
break somebody's sound is asked for three times as many streams in the same moment, with all their emitters.

- `admitted`: streams that were let in at once and hear all their emitters. The others come back when they were told to,
  and `admitted_later` of them are let in within half a minute. Of the blocks of all these fewer than one in a thousand
  may be late, and none may step down to a cheaper quality. `blocks_late` came late, `blocks_dropped` had no room among
  those that a client had not acknowledged, and `blocks_missing` were never made.
- `refused`: everybody else has to be told within a second when to come back. `answer_s` is the longest time from when a
  client began to connect until it was let in or refused, `refusal_s` of those refused, `median_answer_s` the median.
- `client_stall_s`: the longest time for which the clients, which share one thread, did not get to read: so much of
  `answer_s` may be theirs. `client_load` is their CPU time meanwhile, divided by wall time.
- `memory_growth`: memory of the server at the end, as a share of what it took ten seconds after the last came back, or
  half of the time if that is less, less one. Until then streams fetch the responses that they keep.
"""

import asyncio
import statistics
import time
import urllib.request
from collections import Counter
from collections.abc import Callable
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from server.bench.crowd import Crowd, Walker
from server.bench.machine import describe_machine
from server.bench.places import Places
from server.bench.scene import bundle_of
from server.bench.sessions import LATE_SHARE, Plan, ask, count_late, measure_sessions, own_core, served

TIMES = 3
_ANSWER_S = 1.0
_MOST_GROWTH = 0.05
_SETTLE_S, _FILLED_S = 2.0, 10.0
_COME_BACK_S = 30.0
"""For how long those who were refused come back."""


def measure_overload(
    scene: str,
    *,
    emitters: int,
    sessions: int | None,
    duration_s: float,
    advance: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure with so many `emitters` a stream; without `sessions`, first find how many a core serves. Raises
    NafirError if a process cannot be confined to a core or the server does not start."""
    if sessions is None:
        found = measure_sessions(Plan(scenes=(scene,), emitters=(emitters,), duration_s=duration_s), advance)
        sessions = int(found["cases"][0]["sessions"]) if found["cases"] else 0
    places = Places.of(bundle_of(scene))
    with own_core() as (core, _), served(core, scene, admits=True) as server:
        crowd = Crowd(server.port, places, emitters=emitters, poses_per_s=Plan.poses_per_s)
        measured = asyncio.run(_overload(server.port, crowd, TIMES * max(1, sessions), duration_s))
    return {"host": describe_machine(), "scene": scene, "emitters": emitters, "capacity": sessions, **measured}


async def _overload(port: int, crowd: Crowd, asked: int, duration_s: float) -> dict[str, Any]:
    try:
        rush = await crowd.rush(asked)
        walkers = rush.walkers
        refused = [walker for walker in walkers if walker.retry_after_s is not None and not walker.hears_all]
        await asyncio.sleep(_SETTLE_S)
        await asyncio.to_thread(ask, port, "begin")
        admitted = len(crowd.walkers)
        asked_again = await crowd.come_back(refused, _COME_BACK_S)
        early = await asyncio.to_thread(ask, port, "report")
        await asyncio.to_thread(ask, port, "begin")
        filled_s = min(_FILLED_S, duration_s / 2)
        await asyncio.sleep(filled_s)
        filled = await asyncio.to_thread(ask, port, "report")
        await asyncio.sleep(duration_s - filled_s)
        report = await asyncio.to_thread(ask, port, "report")
        told = await asyncio.to_thread(_metrics, port)
        memory_bytes = filled["resident_bytes"]
        both = early, report
        due = sum(each[name] for each in both for name in ("blocks_sent", "blocks_dropped", "blocks_missing"))
        return {
            "asked": asked,
            "admitted": admitted,
            "admitted_later": len(crowd.walkers) - admitted,
            "refused": len(refused),
            "unanswered": asked - admitted - len(refused),
            "asked_again": asked_again,
            "answer_s": max(map(_wait_s, walkers)),
            "median_answer_s": statistics.median(map(_wait_s, walkers)),
            "refusal_s": max(map(_wait_s, refused), default=None),
            "client_stall_s": rush.stall_s,
            "client_load": rush.load,
            "least_retry_s": min((walker.retry_after_s or 0 for walker in refused), default=None),
            "most_retry_s": max((walker.retry_after_s or 0 for walker in refused), default=None),
            "late_share": min(1.0, sum(map(count_late, both)) / due) if due else 1.0,
            **{name: sum(each[name] for each in both) for name in ("blocks_late", "blocks_dropped", "blocks_missing")},
            "steps_down": told["nafir_level_steps_total", "load"],
            "quality_at_end": report["quality_at_end"],
            "refused_for": {
                reason: count for (name, reason), count in told.items() if name == "nafir_refusals_total" and count
            },
            "streams": report["streams"],
            "pose_to_audio_ms": report["pose_to_audio_ms"],
            "pose_to_reverberation_ms": report["pose_to_reverberation_ms"],
            "server_load": report["server_load"],
            "server_load_by_thread": report["server_load_by_thread"],
            "resident_bytes": report["resident_bytes"],
            "memory_growth": None if memory_bytes is None else report["resident_bytes"] / memory_bytes - 1,
        }
    finally:
        await crowd.close()


def _wait_s(walker: Walker) -> float:
    """How long a client waited for its answer, so far if it has none."""
    return (walker.answered_s or time.monotonic()) - walker.asked_s


def failures(measured: dict[str, Any]) -> list[str]:
    """What did not hold, a line each."""
    found = []
    if not measured["admitted"]:
        found.append("nobody was let in")
    if measured["unanswered"]:
        found.append(f"{measured['unanswered']} were neither let in whole nor told when to come back")
    if measured["answer_s"] > _ANSWER_S:
        found.append(f"the last of {measured['asked']} was answered after {measured['answer_s']:.1f} s")
    if measured["late_share"] >= LATE_SHARE:
        found.append(f"{measured['late_share']:.2%} of blocks were late; under {LATE_SHARE:.1%} may be")
    if measured["steps_down"]:
        found.append(f"streams stepped down {measured['steps_down']} times")
    if (ended := measured["admitted"] + measured["admitted_later"] - measured["streams"]) > 0:
        found.append(f"{ended} streams that were let in have ended")
    if (measured["memory_growth"] or 0.0) > _MOST_GROWTH:
        found.append(f"memory grew by {measured['memory_growth']:.1%}")
    return found


def _metrics(port: int) -> Counter[tuple[str, str]]:
    """The server's counts by metric and reason."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    counts: Counter[tuple[str, str]] = Counter()
    for sample in (sample for family in families for sample in family.samples):
        if "reason" in sample.labels:
            counts[sample.name, sample.labels["reason"]] += int(sample.value)
    return counts
