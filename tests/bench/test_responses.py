"""What the bench says of responses until they are ready to be convolved."""

import pytest

from server.bench.field import measure_levels
from server.bench.responses import (
    AMBISONIC,
    BY_BUS,
    FIELD,
    MOVED,
    NETWORK,
    PARTITIONS,
    REFLECTIONS,
    TURNED,
    judge,
)
from server.field.fields_by_level import FieldsByLevel
from tests.directional_flat import write_directional


def test_a_field_of_directions_has_all_rows_and_what_costs_more_takes_longer(tmp_path):
    levels = FieldsByLevel.load(write_directional(tmp_path, tail="bands"))
    measured = measure_levels(levels, rounds=3, poses=8)
    ms_p50 = {row["name"]: row["ms_p50"] for row in measured["responses"]}
    assert set(ms_p50) == {MOVED, TURNED, BY_BUS, AMBISONIC, NETWORK, FIELD, REFLECTIONS, PARTITIONS}
    assert all(0 < row["ms_p50"] <= row["ms_p99"] for row in measured["responses"])
    assert ms_p50[BY_BUS] < 0.05 * ms_p50[TURNED]
    assert ms_p50[PARTITIONS] < ms_p50[TURNED] < ms_p50[MOVED]
    assert [each["measure"] for each in measured["summary"]] == [
        "ms_p50 of the default level",
        "ms_p50 of a moved pose",
        "ms_p50 of a head that only turned",
    ]
    assert not any(each["is_skipped"] for each in measured["summary"])


def test_a_field_of_ears_has_no_ambisonics_and_no_goal_for_turns(bundle):
    measured = measure_levels(FieldsByLevel.load(bundle), rounds=1, poses=2)
    assert [row["name"] for row in measured["responses"]] == [MOVED, TURNED, NETWORK, FIELD, PARTITIONS]
    assert [each["is_skipped"] for each in measured["summary"]] == [False, False, True]


@pytest.mark.parametrize(("instructions", "moved"), [("AVX2", "goal"), ("AVX-512", None)])
def test_goals_are_those_of_the_processor(instructions, moved):
    rows = [{"name": MOVED, "ms_p50": 0.2}, {"name": TURNED, "ms_p50": 0.06}]
    reached = [each.reached for each in judge(rows, knows_directions=True, instructions=instructions)]
    assert reached == [moved, None]
    assert all(each.is_skipped for each in judge([], knows_directions=False))
