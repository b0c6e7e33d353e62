"""A frontier becomes the table of its page: levels worth their time first, then those of directions, then the floor."""

from benchmarks.quality_levels import result_of
from benchmarks.record import Host, Result


def point(name: str, ms: float, error: float, **changes):
    times = {"ms_mean": ms, "ms_p50": ms, "ms_p99": 2 * ms, "ms_miss": ms, "ms_turn": None, "block_us": 17.96}
    kind = {"is_pareto_optimal": True, "is_offered": False, "is_bound": False, "predicts": "ears"}
    return {
        "name": name,
        **times,
        "audible_error_jnd": error,
        "steps_jnd": {"c50": 0.5, "t60": 1.26},
        **kind,
        **changes,
    }


POINTS = [
    point("near", 0.04449, 1.2, steps_jnd={}),
    point("ears-slow", 1.0, 0.9, is_pareto_optimal=False),
    point("bus1", 1.0, 0.64, is_pareto_optimal=False, predicts="directions"),
    point("bands", 123.0, 0.5187, is_offered=True, predicts="directions"),
    point("true-phase", 1.0, 0.1, is_bound=True),
]


def test_levels_stand_in_their_order_with_what_they_are() -> None:
    floor = {"errors_jnd": {"t60": 0.5, "c50": 0.75}}
    frontier = {"scene": "apartment", "default": "bands", "floor": floor, "points": POINTS}
    host = Host(processor="P", instruction_set="AVX2", cores=1)
    result = result_of(frontier, host=host, command="c", commit="0123abc", facts={"Data": "d"})
    assert Result.model_validate_json(result.model_dump_json()).tables["levels"].column("mean ms")[1] == 120
    assert result.facts == {"Data": "d", "Levels": "4 were measured; 2 of them are Pareto-optimal"}
    assert result.tables["levels"].markdown().splitlines()[2:] == [
        "| `near` | 0.044 | 0.044 | 0.089 | 0.044 | | 18 | 1.200 | |",
        "| `bands` (o, default) | 120 | 120 | 250 | 120 | | 18 | 0.519 | 1.3 |",
        "| `bus1` (not optimal) | 1.0 | 1.0 | 2.0 | 1.0 | | 18 | 0.640 | 1.3 |",
        "| floor | | | | | | | 0.625 | |",
    ]
