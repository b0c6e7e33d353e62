"""What listeners are asked is drawn at random, evenly, and again the same."""

import itertools
from collections import Counter

import pytest

from server.listening.design import REFERENCE
from server.listening.plan import ANTIPHASE, PLAIN, QUIET, SCREENINGS, ListenerPlan, new_code
from tests.listening.listeners import CODED, FIELD, RATED, design_of

LISTENERS = 40


def plans(design, count=LISTENERS):
    return [ListenerPlan.draw(design, f"listener{number:02d}", number) for number in range(count)]


def test_a_plan_is_drawn_again_the_same_and_another_listener_has_another():
    design = design_of()
    first, again = (ListenerPlan.draw(design, "abcdefghjk", 3) for _ in range(2))
    assert first == again
    others = [ListenerPlan.draw(design, "abcdefghjm", 3), ListenerPlan.draw(design, "abcdefghjk", 4)]
    others.append(ListenerPlan.draw(design.model_copy(update={"seed": 8}), "abcdefghjk", 3))
    assert all(other.trials != first.trials for other in others)


def test_a_plan_comes_back_from_its_file(tmp_path):
    plan = ListenerPlan.draw(design_of(), "abcdefghjk", 0)
    plan.write(tmp_path / "plan.json")
    assert ListenerPlan.read(tmp_path / "plan.json") == plan


@pytest.mark.parametrize("places", [4, 5])
def test_each_method_is_a_as_often_as_b(places):
    drawn = plans(design_of(places=places))
    for plan in drawn:
        test = [trial.slots["a"] for trial in plan.trials if trial.part == "test"]
        assert abs(2 * test.count(FIELD) - places) <= places % 2
    sides = Counter(trial.slots["a"] for plan in drawn for trial in plan.trials if trial.part == "test")
    assert sides[FIELD] == sides[CODED]
    checks = Counter(
        trial.slots["a"] == REFERENCE for plan in drawn for trial in plan.trials if trial.part in {"anchor", "practice"}
    )
    assert checks[True] == checks[False]


def test_which_place_has_a_method_on_which_side_is_even_over_listeners():
    drawn = plans(design_of(), 400)
    for place in range(4):
        first = [
            trial.slots["a"] == FIELD
            for plan in drawn
            for trial in plan.trials
            if (trial.part, trial.place) == ("test", place)
        ]
        # Four standard deviations of 400 tosses.
        assert abs(sum(first) - 200) < 40


def test_every_trial_of_the_design_is_asked_once_after_practice():
    design = design_of()
    for plan in plans(design, 5):
        parts = [trial.part for trial in plan.trials]
        assert parts[:12] == ["screening-1"] * 6 + ["screening-2"] * 6
        assert parts[12] == "practice"
        asked = Counter((trial.part, trial.place, frozenset(trial.slots.values())) for trial in plan.trials[12:])
        assert asked == Counter((trial.part, trial.place, frozenset(trial.methods)) for trial in design.trials)


def test_the_order_of_questions_differs_and_mixes_checks_among_them():
    orders = {tuple(trial.part for trial in plan.trials[13:]) for plan in plans(design_of())}
    assert len(orders) > LISTENERS / 2


def test_tones_come_in_all_six_orders_at_each_try():
    for plan in plans(design_of(), 5):
        for part in SCREENINGS:
            orders = [tuple(trial.slots[slot] for slot in "123") for trial in plan.trials if trial.part == part]
            assert sorted(orders) == sorted(itertools.permutations((QUIET, ANTIPHASE, PLAIN)))
    assert all(trial.place is not None for trial in ListenerPlan.draw(design_of(screening=False), "x", 0).trials)


def test_rated_sounds_are_in_slots_at_random():
    design = design_of("rating", places=3)
    drawn = plans(design, 300)
    firsts = Counter(trial.slots["a"] for plan in drawn for trial in plan.trials if trial.part == "test")
    assert set(firsts) == set(RATED)
    assert max(firsts.values()) < 1.35 * min(firsts.values())
    rated = [trial for plan in drawn for trial in plan.trials if trial.place is not None]
    assert all(set(trial.slots.values()) == set(RATED) for trial in rated)


def test_codes_differ():
    assert len({new_code() for _ in range(1000)}) == 1000
