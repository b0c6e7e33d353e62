"""Tones come first and decide who goes on; then practice, then questions."""

import pytest

from server.listening.answers import AnswerFile
from server.listening.plan import ANTIPHASE, PLAIN, QUIET
from server.listening.progress import has_headphones, progress
from tests.listening.listeners import FIELD, design_of, listen, write_test

RIGHT = {FIELD, "reference"}


@pytest.fixture
def test(tmp_path):
    return write_test(tmp_path / "test", design_of(places=2))


def standing(test, number, tone, most):
    plan = listen(test, number, lambda trial: min(RIGHT & set(trial.slots.values())), tone=tone, most=most)
    answered = AnswerFile(test.results / f"{plan.code}.csv", plan).read()
    return progress(plan, answered, test.design.rules), has_headphones(plan, answered, test.design.rules)


def wrong(times):
    """Hears the quiet tone but for so many times at the beginning, when it names that of opposite phase."""
    left = iter([ANTIPHASE] * times)
    return lambda _: next(left, QUIET)


@pytest.mark.parametrize(
    ("errors", "answers", "stage", "trial", "told"),
    [
        (0, 0, "screening", 0, None),
        (0, 5, "screening", 5, True),
        (0, 6, "practice", 12, True),
        (1, 6, "practice", 12, True),
        (2, 6, "screening", 6, None),
        (7, 12, "practice", 12, True),
        (8, 12, "no-headphones", None, False),
        (12, 12, "no-headphones", None, False),
    ],
)
def test_five_of_six_tones_at_one_of_two_tries_open_the_test(test, errors, answers, stage, trial, told):
    at, is_told = standing(test, 0, wrong(errors), answers)
    assert (at.stage, at.trial, is_told) == (stage, trial, told)


def test_a_try_is_asked_to_its_end_and_counted(test):
    at, _ = standing(test, 0, wrong(6), 8)
    assert (at.stage, at.done, at.total, at.tries) == ("screening", 2, 6, 2)


def test_practice_and_questions_follow_and_end(test):
    questions = len(test.design.trials) - 1
    at, _ = standing(test, 0, wrong(0), 7)
    assert (at.stage, at.done, at.total) == ("test", 0, questions)
    at, _ = standing(test, 1, wrong(0), 6 + 1 + questions - 1)
    assert (at.stage, at.done) == ("test", questions - 1)
    at, _ = standing(test, 2, wrong(0), 6 + 1 + questions)
    assert (at.stage, at.trial) == ("done", None)


def test_without_screening_practice_is_first(tmp_path):
    test = write_test(tmp_path / "open", design_of(places=2, screening=False))
    at, told = standing(test, 0, lambda _: PLAIN, 0)
    assert (at.stage, at.trial, told) == ("practice", 0, True)
