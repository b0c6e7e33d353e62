"""Goals of the benchmarks on one core, for processors with and without AVX-512."""

from reference_text import number, table
from server.bench.convolver import ratio_goals
from server.bench.report import Goal
from server.bench.sessions import Goals

_SETS = "AVX2", "AVX-512"


def bench_goals() -> str:
    """Return a table of the goals, at least and stretch, for each instruction set."""
    by_set = [_goals(instructions) for instructions in _SETS]
    rows = [(goals[0].measure, *(_limits(goal) for goal in goals)) for goals in zip(*by_set, strict=True)]
    return table(["measure", *_SETS], rows)


def _goals(instructions: str) -> list[Goal]:
    goals = Goals.of("each scene", instructions)
    streams = [goals.sixteen, goals.one, goals.pose_to_audio, goals.pose_to_reverberation]
    return [*streams, *ratio_goals(instructions)]


def _limits(goal: Goal) -> str:
    sign = "≤" if goal.is_at_most else "≥"
    stretch = "" if goal.stretch is None else f" (stretch {number(goal.stretch)})"
    return f"{sign} {number(goal.limit)}{stretch}"
