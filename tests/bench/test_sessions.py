"""The search for the most sessions, against servers of known capacity; the real one is in tests/integration."""

import asyncio

import pytest

from server.bench.sessions import find_most, judge


@pytest.mark.parametrize("capacity", [0, 1, 3, 4, 5, 17, 23, 40, 199, 511, 512, 10_000])
def test_the_most_is_found_to_within_five_percent(capacity):
    tried = []

    async def passes(sessions):
        tried.append(sessions)
        return sessions <= capacity

    found = asyncio.run(find_most(passes, most=512))
    reachable = min(capacity, 512)
    assert found <= reachable
    assert reachable - found < max(1, found / 20)
    assert len(tried) <= 16
    assert len(set(tried)) == len(tried)


def test_the_goals_are_for_sixteen_emitters():
    cases = [
        {"emitters": 1, "sessions": 90, "pose_to_audio_ms": {"p99": 2.0}},
        {"emitters": 16, "sessions": 21, "pose_to_audio_ms": {"p99": 15.5}},
    ]
    assert [judgement.reached for judgement in judge(cases)] == ["at_least", None]
    assert [judgement.value for judgement in judge(cases[:1])] == [None, None]


def test_a_case_in_which_nothing_worked_reaches_no_goal():
    assert [judgement.reached for judgement in judge([{"emitters": 16, "sessions": 0, "trials": []}])] == [None, None]
