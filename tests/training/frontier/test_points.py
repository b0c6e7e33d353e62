from typing import Literal

import numpy as np
import pytest

from server.scene.manifest import Accuracy, Cost, QualityLevel
from training.frontier.points import LEAST_COST_RATIO, Point, default_among, default_point, offered_points, pareto

PAIRS = 50


def point(
    name: str,
    ms: float,
    error: float,
    *,
    seed: int = 0,
    missing: float = 0.0,
    bound: bool = False,
    miss_ms: float | None = None,
    ms_turn: float | None = None,
    predicts: Literal["ears", "directions"] = "ears",
) -> Point:
    """On a walk most poses take no time: the mean is what counts."""
    spread = np.random.default_rng(seed).normal(0, 0.05, PAIRS)
    spread -= spread.mean()
    level = QualityLevel(
        name=name,
        field="a",
        accuracy=Accuracy(pairs=PAIRS, yaws=1, errors={"t60": error}, floor={}),
        cost=Cost(
            ms_p50=0.001,
            ms_p99=2 * ms,
            ms_mean=ms,
            ms_miss=miss_ms or ms,
            ms_turn=ms_turn,
            storage_mb=1,
            memory_mb=1,
            host="here",
        ),
    )
    return Point(level, {"t60": error}, error + spread, missing, bound, predicts)


def names(points: list[Point]) -> list[str]:
    return [point.level.name for point in points]


def test_none_of_the_optimal_points_is_both_slower_and_worse_than_another() -> None:
    rng = np.random.default_rng(1)
    points = [point(f"p{i}", *rng.uniform(0.1, 2, 2), seed=i) for i in range(60)]
    best = pareto(points)
    times, errors = [p.cost.ms_mean for p in best], [p.audible_error for p in best]
    assert times == sorted(times)
    assert errors == sorted(errors, reverse=True)
    quickest = min(points, key=lambda p: p.cost.ms_mean)
    assert best[0] is quickest
    for other in set(names(points)) - set(names(best)):
        chosen = next(p for p in points if p.level.name == other)
        assert any(
            b.cost.ms_mean <= chosen.cost.ms_mean and b.audible_error <= chosen.audible_error + 0.03 for b in best
        )


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


@pytest.mark.parametrize(("error", "chosen"), [(0.305, "b"), (0.32, "c")])
def test_the_default_waits_for_no_difference_that_nobody_hears(error, chosen) -> None:
    best = [point("a", 1, 0.5), point("b", 2, error), point("c", 3, 0.3)]
    assert default_point(best, ms=8).level.name == chosen
    assert default_point([*best, point("slower", 9, 0.1)], ms=8).level.name == chosen
    assert default_point([*best, point("d", 3.2, 0.298)], ms=8).level.name == {"b": "b", "c": "d"}[chosen]


def test_of_two_alike_the_default_is_quicker_where_only_the_head_turned() -> None:
    points = [point("a", 2.0, 0.3, ms_turn=1.0), point("b", 2.1, 0.298, ms_turn=2.0)]
    assert default_point(points, ms=8).level.name == "a"
    assert default_point([points[0], point("c", 2.1, 0.298, ms_turn=1.1)], ms=8).level.name == "c"


def test_what_is_rarely_computed_is_no_quicker_for_it_when_it_is() -> None:
    """A deadline has to bear the pose that finds nothing kept."""
    best = pareto([point("a", 1, 0.5), point("reusing", 2, 0.4, miss_ms=9), point("c", 3, 0.3)])
    assert default_point(best, ms=8).level.name == "c"
    assert default_point(best[:2], ms=8).level.name == "a"


def test_where_nothing_is_in_time_the_default_is_what_a_deadline_bears_best() -> None:
    best = pareto([point("reusing", 0.1, 0.5, miss_ms=9), point("c", 3, 0.3), point("d", 5, 0.2)])
    assert default_point(best, ms=1).level.name == "c"


@pytest.mark.parametrize("default", range(0, 30, 5))
def test_a_few_are_offered_from_the_default_on_down_and_up_each_much_cheaper_or_dearer(default) -> None:
    times = np.geomspace(0.003, 30, 30)
    best = [point(f"p{number:02}", ms, 1 - 0.02 * number) for number, ms in enumerate(times)]
    first, *others = offered = offered_points(best, best, best[default], ms=100)
    assert first is best[default]
    costs = sorted(each.cost.ms_mean for each in offered)
    assert len(set(costs)) == len(offered)
    steps = np.diff(np.log(costs))
    # The cheapest is offered however near it is to the next.
    assert costs[0] == times[0]
    assert np.min(steps[1:], initial=np.inf) >= np.log(LEAST_COST_RATIO) - 1e-9
    # No room is left for another.
    assert np.max(steps) < 2 * np.log(LEAST_COST_RATIO)
    assert costs[-1] > times[-1] / LEAST_COST_RATIO
    assert others or len(best) == 1


def test_a_level_that_is_hardly_cheaper_than_another_is_not_offered_beside_it() -> None:
    best = [point("a", 1, 0.5), point("b", 1.05, 0.4), point("c", 3.2, 0.3)]
    assert names(offered_points(best, best, best[2], ms=5)) == ["c", "b"]
    best[1] = point("b", 1.2, 0.4)
    assert names(offered_points(best, best, best[2], ms=5)) == ["c", "a"]
    best[1] = point("b", 1.05, 0.4)
    assert names(offered_points(best, best, best[1], ms=5)) == ["b", "c"]


def test_the_default_knows_directions_where_there_are_any_however_quick_others_are() -> None:
    kept, whole = point("kept", 0.01, 0.4), point("whole", 2, 0.3)
    rough, fine = (point(name, ms, error, predicts="directions") for name, ms, error in (("o", 1, 0.6), ("p", 2, 0.5)))
    assert default_among([kept, whole, rough, fine], ms=2.5) is fine
    assert default_among([kept, whole, rough, fine], ms=1.5) is rough
    assert default_among([kept, whole], ms=2.5) is whole


def test_each_way_to_predict_a_response_is_offered() -> None:
    """Also where another is quicker and more accurate."""
    ears = [point("slow", 9, 0.9), point("quick", 3, 0.95)]
    directions = [point("a", 1, 0.5, predicts="directions")]
    points = [*ears, *directions]
    offered = offered_points(points, pareto(points), directions[0], ms=5)
    assert names(offered) == ["a", "quick"]
    assert names(offered_points(ears, pareto(ears), ears[1], ms=5)) == ["quick", "slow"]


def test_where_the_reference_lacks_values_too_there_is_a_default() -> None:
    points = [point("ears", 3, 0.5, missing=0.05), point("rough", 1, 0.6, missing=0.05, predicts="directions")]
    assert default_among(points, ms=2).level.name == "rough"
    assert names(offered_points(points, pareto(points, missing=0.05), points[1], ms=2)) == ["rough", "ears"]
