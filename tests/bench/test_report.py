import math

import pytest
import typer

from server.bench.report import Goal, end_with, missed, print_judgements


@pytest.mark.parametrize(
    ("value", "reached"), [(14.9, None), (15, "goal"), (26.9, "goal"), (27, "stretch"), (99, "stretch")]
)
def test_a_speed_reaches_a_goal_from_there_on(value, reached):
    assert Goal("speed", 15, 27).judge(value).reached == reached


@pytest.mark.parametrize(("value", "reached"), [(-119.9, None), (-120, "goal"), (-126, "stretch")])
def test_a_level_reaches_a_goal_down_from_there(value, reached):
    assert Goal("error", -120, -126, is_at_most=True).judge(value).reached == reached


def test_a_goal_without_stretch_is_reached_and_no_more():
    assert Goal("speed", 15).judge(99).reached == "goal"


def test_what_was_not_measured_reaches_nothing():
    judgement = Goal("speed", 15, 27).judge(None)
    assert (judgement.value, judgement.reached) == (None, None)


@pytest.mark.parametrize("goal", [Goal("speed", 15, 27), Goal("error", -120, -126, is_at_most=True)])
def test_a_run_that_failed_reaches_nothing_whatever_its_value(goal):
    value = goal.stretch
    assert goal.judge(value).reached == "stretch"
    judgement = goal.judge(value, failure="TimeoutError")
    assert (judgement.value, judgement.reached, judgement.reason) == (value, None, "TimeoutError")


@pytest.mark.parametrize("goal", [Goal("speed", 15, 27), Goal("error", -120, -126, is_at_most=True)])
def test_what_is_not_a_number_reaches_nothing(goal):
    assert goal.judge(math.nan).reached is None


def test_goals_that_were_missed_are_told_and_those_that_were_skipped_are_not():
    speed = Goal("speed", 15)
    judgements = [speed.judge(15), speed.judge(14.5), speed.judge(None), speed.judge(99, failure="all late")]
    assert missed([*judgements, speed.skip("nobody asked")]) == [
        "speed: is 14.5, and may be no less than 15",
        "speed: could not be measured",
        "speed: all late",
    ]


def test_a_program_ends_with_code_1_where_something_was_missed_and_says_what(capsys):
    end_with([])
    with pytest.raises(typer.Exit) as ended:
        end_with(["speed: all late"])
    assert ended.value.exit_code == 1
    assert capsys.readouterr().err == "not reached: speed: all late\n"


def test_a_limit_is_printed_with_its_direction(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    print_judgements("Goals", [Goal("growth", 0.05, is_at_most=True).judge(0.2), Goal("speed", 15, 27).judge(20)])
    said = capsys.readouterr().out
    assert "at least" not in said
    growth, speed = (next(line for line in said.splitlines() if name in line) for name in ("growth", "speed"))
    assert "\u2264 0.05" in growth
    assert "no" in growth
    assert "\u2265 15" in speed
    assert "\u2265 27" in speed
