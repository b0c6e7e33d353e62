import pytest

from server.bench.report import Goal


@pytest.mark.parametrize(
    ("value", "reached"), [(14.9, None), (15, "at_least"), (26.9, "at_least"), (27, "stretch"), (99, "stretch")]
)
def test_a_speed_reaches_a_goal_from_there_on(value, reached):
    assert Goal("speed", 15, 27).judge(value).reached == reached


@pytest.mark.parametrize(("value", "reached"), [(-119.9, None), (-120, "at_least"), (-126, "stretch")])
def test_a_level_reaches_a_goal_down_from_there(value, reached):
    assert Goal("error", -120, -126, is_at_most=True).judge(value).reached == reached


def test_a_goal_without_stretch_is_reached_and_no_more():
    assert Goal("speed", 15).judge(99).reached == "at_least"


def test_what_was_not_measured_reaches_nothing():
    judgement = Goal("speed", 15, 27).judge(None)
    assert (judgement.value, judgement.reached) == (None, None)
