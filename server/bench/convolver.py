"""Benchmark of the convolver against pedalboard and SciPy, and of properties that only ours has, in one run.

All cases are at 48 kHz with stereo IRs. Each measure is explained in its module: `server.bench.throughput`,
`.exchanges`, `.endurance` and `.startup`.
"""

import itertools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

import numpy as np

from server.bench.endurance import measure_drift, threads_scale
from server.bench.exchanges import fade_cost_ratio, splatter_db
from server.bench.machine import describe_machine, has_wide_vectors
from server.bench.peers import Pedalboard, error_db, find_pedalboard, reference
from server.bench.report import Goal, Judgement, show
from server.bench.rooms import noise, room
from server.bench.startup import cold_start_s, warm_start_s
from server.bench.throughput import SAMPLE_RATE, Case, Rooms, measure_case

Advance = Callable[[str], None]
"""Progress callback; it gets a description of the measurement just done."""


@dataclass(frozen=True)
class Plan:
    """Measurements to make, and their lengths."""

    cases: tuple[Case, ...]
    rounds: int
    splatter_s: float
    drift_s: float
    fade_sources: tuple[int, ...] = (1, 16)
    thread_sources: int = 16
    thread_blocks: int = 1_000
    has_cold_start: bool = True
    """Whether to measure the cold start, which takes half a minute."""

    @property
    def steps(self) -> int:
        return len(self.cases) + len(self.fade_sources) + 4 + self.has_cold_start


FULL = Plan(
    cases=tuple(
        Case(block_size, ir_s, sources)
        for ir_s, block_size, sources in itertools.product((0.5, 1.0, 2.0), (128, 256, 512), (1, 4, 16, 64))
    ),
    rounds=5,
    splatter_s=10.0,
    drift_s=600.0,
)
QUICK = Plan(
    cases=(Case(256, 1.0, 1), Case(256, 1.0, 16)), rounds=3, splatter_s=3.0, drift_s=600.0, has_cold_start=False
)

_EVENNESS = Goal("worst block / mean block, 16 sources", 2.5, 1.5, is_at_most=True)
_ERROR = Goal("largest error of any case, dB", -120, -126, is_at_most=True)
_SPLATTER = Goal("splatter above 4 kHz of a 997 Hz tone at 90 exchanges/s, dB", -95, -98, is_at_most=True)
_DRIFT = Goal("growth of the error over 10 minutes, dB", 0, is_at_most=True)
_WARM_START = Goal("fresh process to its first block, s", 1, is_at_most=True)
_PEER_DB = -90.0
"""Largest error of pedalboard, relative to its largest sample, at which the comparison counts."""


def measure_convolver(plan: Plan, advance: Advance = lambda _: None) -> dict[str, Any]:
    """Make all measurements of the plan. `advance` is called `plan.steps` times."""
    peer = find_pedalboard()
    measured: dict[str, Any] = {"host": describe_machine(), "rounds": plan.rounds}
    measured["peer"] = None if peer is None else {"name": "pedalboard", "error_db": peer_error_db(peer)}
    cases = []
    for ir_samples, group in itertools.groupby(plan.cases, lambda case: case.ir_samples):
        alike = list(group)
        rooms = Rooms.of(ir_samples, {case.sources for case in alike})
        for case in alike:
            cases.append(measure_case(case, rooms, rounds=plan.rounds, peer=peer))
            advance(f"{case.block_size} samples, {case.ir_s:g} s, {case.sources} sources")
    measured["cases"] = cases
    measured["splatter_db"] = {
        name: splatter_db(exchanges_per_s=rate, duration_s=plan.splatter_s)
        for name, rate in {"steady": 0, "10_hz": 10, "90_hz": 90}.items()
    }
    advance("splatter")
    measured["fade_cost_ratio"] = {}
    for sources in plan.fade_sources:
        measured["fade_cost_ratio"][str(sources)] = fade_cost_ratio(sources=sources, rounds=plan.rounds)
        advance(f"fades of {sources}")
    measured["drift"] = measure_drift(duration_s=plan.drift_s)
    advance("drift")
    measured["threads_scale"] = threads_scale(
        sources=plan.thread_sources, rounds=plan.rounds, blocks=plan.thread_blocks
    )
    advance("two threads")
    measured["warm_start_s"] = warm_start_s(plan.rounds)
    advance("warm start")
    measured["cold_start_s"] = None
    if plan.has_cold_start:
        measured["cold_start_s"] = cold_start_s()
        advance("cold start")
    measured["summary"] = [asdict(judgement) for judgement in judge(measured)]
    return measured


def ratio_goals(instructions: str | None = None) -> tuple[Goal, Goal]:
    """The goals for 1 and 16 sources of a processor with these `instructions`, by default of this one. Whatever is not
    AVX-512 has those of AVX2."""
    is_wide = has_wide_vectors(instructions)
    return (
        Goal("ratio to pedalboard, 1 source", 15 if is_wide else 18, 27),
        Goal("ratio to pedalboard, 16 sources", 40 if is_wide else 60, 77),
    )


def judge(measured: dict[str, Any], instructions: str | None = None) -> list[Judgement]:
    """Judge the measurements against the goals, which are for 256-sample blocks and 1 s of IR. The largest error is
    over all cases. Speed counts only if the output is correct."""
    ratio_1, ratio_16 = ratio_goals(instructions)
    typical = {case["sources"]: case for case in measured["cases"] if (case["block_size"], case["ir_s"]) == (256, 1)}
    error_db = np.max([case["max_error_db"] for case in measured["cases"]], initial=-np.inf)  # np.max keeps NaN
    return [
        _judge_ratio(ratio_1, typical.get(1), measured["peer"]),
        _judge_ratio(ratio_16, typical.get(16), measured["peer"]),
        _ERROR.judge(float(error_db)) if measured["cases"] else _ERROR.skip("there was no case"),
        _SPLATTER.judge(measured["splatter_db"]["90_hz"]),
        _judge_drift(measured["drift"]),
        _judge_evenness(typical.get(16)),
        _WARM_START.judge(measured["warm_start_s"]),
    ]


def _judge_ratio(goal: Goal, case: dict[str, Any] | None, peer: dict[str, Any] | None) -> Judgement:
    if case is None:
        return goal.skip("not among the cases")
    if peer is None:
        return goal.skip("pedalboard is not installed")
    failure = _wrong("its output", case["max_error_db"], _ERROR.limit)
    return goal.judge(case["ratio"], failure=failure or _wrong("pedalboard's output", peer["error_db"], _PEER_DB))


def _judge_evenness(case: dict[str, Any] | None) -> Judgement:
    if case is None:
        return _EVENNESS.skip("not among the cases")
    failure = _wrong("its output", case["max_error_db"], _ERROR.limit)
    return _EVENNESS.judge(case["worst_to_mean_block"], failure=failure)


def _judge_drift(drift: dict[str, Any]) -> Judgement:
    """Judge the drift. Drift counts only if the output is correct at the beginning."""
    failure = _wrong("the first second", drift["first_second_error_db"], _ERROR.limit)
    return _DRIFT.judge(drift["drift_db"], failure=failure)


def _wrong(what: str, error_db: float, limit_db: float) -> str | None:
    """A message that `what` is wrong; None if its error is at most `limit_db`."""
    return None if error_db <= limit_db else f"{what} is off by {show(error_db)} dB, and may be by {show(limit_db)}"


def peer_error_db(peer: ModuleType) -> float:
    """Pedalboard's largest error, which shows whether it computes the same convolution. Its normalisation of the IR's
    level is compensated."""
    block_size = 256
    dry, ir = noise(1, 300 * block_size), room(2, SAMPLE_RATE)
    player = Pedalboard(peer, ir[np.newaxis], SAMPLE_RATE)
    stereo = np.repeat(dry.reshape(-1, 1, 1, block_size), 2, axis=2)
    wet = np.concatenate([player.process(block)[0] for block in stereo], axis=1)
    expected = reference(dry, ir)
    gain = np.vdot(wet, expected) / np.vdot(expected, expected)
    return error_db(wet, gain * expected)
