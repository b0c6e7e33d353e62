import numpy as np
import pytest

from server.scene.manifest import Accuracy, Cost, QualityLevel
from training.frontier.points import Point, default_point, pareto

PAIRS = 50


def point(name: str, ms: float, error: float, *, seed: int = 0, missing: float = 0.0, bound: bool = False) -> Point:
    spread = np.random.default_rng(seed).normal(0, 0.05, PAIRS)
    spread -= spread.mean()
    level = QualityLevel(
        name=name,
        field="a",
        accuracy=Accuracy(pairs=PAIRS, yaws=1, errors={"t60": error}, floor={}),
        cost=Cost(ms_p50=ms, ms_p99=2 * ms, storage_mb=1, memory_mb=1, host="here"),
    )
    return Point(level, {"t60": error}, error + spread, missing, bound)


def names(points: list[Point]) -> list[str]:
    return [point.level.name for point in points]


def test_none_of_the_optimal_points_is_both_slower_and_worse_than_another() -> None:
    rng = np.random.default_rng(1)
    points = [point(f"p{i}", *rng.uniform(0.1, 2, 2), seed=i) for i in range(60)]
    best = pareto(points)
    times, errors = [p.cost.ms_p50 for p in best], [p.audible_error for p in best]
    assert times == sorted(times)
    assert errors == sorted(errors, reverse=True)
    quickest = min(points, key=lambda p: p.cost.ms_p50)
    assert best[0] is quickest
    for other in set(names(points)) - set(names(best)):
        chosen = next(p for p in points if p.level.name == other)
        assert any(b.cost.ms_p50 <= chosen.cost.ms_p50 and b.audible_error <= chosen.audible_error + 0.03 for b in best)


def test_a_gain_within_the_luck_of_the_draw_is_not_worth_time() -> None:
    assert names(pareto([point("a", 1, 0.5), point("b", 2, 0.499, seed=1)])) == ["a"]
    assert names(pareto([point("a", 1, 0.5), point("b", 2, 0.4, seed=1)])) == ["a", "b"]


def test_what_cannot_be_offered_or_measured_is_never_optimal() -> None:
    points = [point("bound", 0.1, 0.1, bound=True), point("silent", 0.2, 0.1, missing=0.2), point("a", 1, 0.5)]
    assert names(pareto(points)) == ["a"]
    assert names(pareto(points, missing=0.2)) == ["silent"]


@pytest.mark.parametrize(("ms", "chosen"), [(0.5, "a"), (1.0, "a"), (2.5, "b"), (100.0, "c")])
def test_the_default_is_the_most_accurate_in_time(ms, chosen) -> None:
    best = pareto([point("a", 1, 0.5), point("b", 2, 0.4), point("c", 3, 0.3)])
    assert default_point(best, ms=ms).level.name == chosen
