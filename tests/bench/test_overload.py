"""What of a crowd that asks at once counts as a failure."""

import pytest

from server.bench.overload import failures

WELL = {
    "asked": 60,
    "admitted": 20,
    "admitted_later": 12,
    "refused": 40,
    "unanswered": 0,
    "answer_s": 0.4,
    "late_share": 0.0,
    "steps_down": 0,
    "streams": 32,
    "memory_growth": 0.01,
}


def test_a_crowd_that_was_served_or_told_in_time_has_no_failure():
    assert failures(WELL) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"admitted": 0, "admitted_later": 0, "streams": 0}, "nobody"),
        ({"unanswered": 2}, "2 were neither"),
        ({"answer_s": 1.1}, "1.1 s"),
        ({"late_share": 0.002}, "0.20%"),
        ({"steps_down": 3}, "3 times"),
        ({"streams": 30}, "2 streams"),
        ({"memory_growth": 0.2}, "20.0%"),
    ],
)
def test_each_failure_is_told_by_itself(change, said):
    (failure,) = failures(WELL | change)
    assert said in failure
