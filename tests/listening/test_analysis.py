"""A planted preference is found again, and answers that do not count are named with the reason."""

import io

import numpy as np
import pytest
from rich.console import Console

from server.core.errors import NafirError
from server.listening.analysis import PAPER, analyse
from server.listening.design import LOW_PASS, REFERENCE, Trial
from server.listening.figure import draw
from server.listening.plan import ANTIPHASE
from server.listening.report import report
from tests.listening.listeners import CODED, FIELD, JND, design_of, listen, write_test

PLANTED = 0.8


def prefers(rng, share=PLANTED, *, hears_anchors=True):
    """Chooses the field in this share of comparisons, and the truth wherever it is beside an anchor."""

    def choose(trial):
        methods = set(trial.slots.values())
        if methods == {FIELD, CODED}:
            return FIELD if rng.random() < share else CODED
        if trial.part == "anchor":
            return REFERENCE if hears_anchors else (methods - {REFERENCE}).pop()
        return REFERENCE if rng.random() < 0.5 else (methods - {REFERENCE}).pop()

    return choose


def text_of(results):
    written = io.StringIO()
    console = Console(width=200, file=written)
    for part in report(results):
        console.print(part)
    return written.getvalue()


@pytest.fixture(scope="module")
def choices(tmp_path_factory):
    """Twenty who listen, one at loudspeakers, one who guesses at anchors, one who breaks off."""
    test = write_test(tmp_path_factory.mktemp("choices") / "test", design_of(places=10))
    rng = np.random.default_rng(5)
    for number in range(20):
        listen(test, number, prefers(rng))
    listen(test, 20, prefers(rng), tone=lambda _: ANTIPHASE)
    listen(test, 21, prefers(rng, hears_anchors=False))
    listen(test, 22, prefers(rng), most=12)
    return analyse(test)


def test_a_planted_preference_is_recovered(choices):
    (found,) = [each for each in choices.comparisons if each.part == "test"]
    assert (found.first, found.second) == (FIELD, CODED)
    assert found.result.trials == 200
    assert found.result.wilson[0] <= PLANTED <= found.result.wilson[1]
    assert found.result.p < 0.001
    assert found.p_corrected == found.result.p


def test_no_preference_is_found_where_there_is_none(tmp_path):
    test = write_test(tmp_path / "test", design_of(places=10))
    rng = np.random.default_rng(6)
    for number in range(10):
        listen(test, number, prefers(rng, 0.5))
    (found,) = [each for each in analyse(test).comparisons if each.part == "test"]
    assert found.result.clopper_pearson[0] < 0.5 < found.result.clopper_pearson[1]


def test_who_does_not_count_is_named_with_the_reason(choices):
    assert (choices.begun, choices.counted) == (23, 20)
    assert {each.listener: each.reason for each in choices.excluded} == {
        "listener20": "no headphones: named the quiet tone 0 and 0 times of 6",
        "listener21": "anchors: chose the truth in 0 of 6",
        "listener22": "not finished: 5 of 20 questions",
    }
    assert choices.screening.model_dump() == {"first_try": 22, "second_try": 0, "failed": 1, "undecided": 0}
    assert "of listeners who guess, 10.9 % do" in " ".join(choices.rules)


def test_checks_are_reported(choices):
    by_part = {(each.part, each.first, each.second): each.result for each in choices.comparisons}
    assert by_part["anchor", REFERENCE, "wrong-place"].share == 1.0
    hidden = by_part["hidden-reference", FIELD, REFERENCE]
    assert hidden.trials == 40
    assert hidden.wilson[0] < 0.5 < hidden.wilson[1]


def test_the_paper_stands_beside_a_field_over_aac_nearest(choices):
    (found,) = [each for each in choices.comparisons if each.published]
    assert (found.first, found.second) == (FIELD, CODED)
    assert round(100 * PAPER.result.share, 2) == 82.38
    text = text_of(choices)
    assert "82.38 %" in text
    assert "21 listeners, 10 places" in text
    assert "listener21, anchors" in text


def test_a_field_is_counted_over_a_baseline_however_they_were_named(tmp_path):
    trials = (Trial(part="test", place=0, methods=(CODED, FIELD)),)
    test = write_test(tmp_path / "test", design_of(places=1, trials=trials))
    listen(test, 0, lambda _: FIELD)
    (found,) = analyse(test).comparisons
    assert (found.first, found.result.share) == (FIELD, 1.0)
    assert found.published is PAPER


def test_methods_are_ordered_by_what_they_won(choices):
    assert [each.method for each in choices.won] == [FIELD, CODED]
    assert choices.won[0].result.share == pytest.approx(1 - choices.won[1].result.share)


@pytest.fixture(scope="module")
def ratings(tmp_path_factory):
    test = write_test(tmp_path_factory.mktemp("ratings") / "test", design_of("rating", places=8))
    rng = np.random.default_rng(7)
    true = {REFERENCE: 97.0, LOW_PASS: 15.0, **{name: 90.0 - 30.0 * jnd for name, jnd in JND.items()}}

    def rate(_, method):
        return float(np.clip(true[method] + (3 if method == REFERENCE else 8) * rng.standard_normal(), 0, 100))

    for number in range(15):
        listen(test, number, rate=rate)
    listen(test, 15, rate=lambda *_: 50.0)
    listen(test, 16, rate=lambda *_: 100.0)
    return analyse(test), true


def test_median_ratings_are_recovered_beside_the_jnd_axis(ratings):
    results, true = ratings
    assert results.counted == 15
    for each in results.rated:
        assert each.result.ratings == 120
        assert each.result.median == pytest.approx(true[each.method], abs=4)
        assert each.result.interval[0] <= each.result.median <= each.result.interval[1]
        assert each.jnd == JND.get(each.method)
    assert [each.method for each in results.rated] == sorted(true, key=lambda name: -true[name])
    assert results.agreement.rho == pytest.approx(-1.0)
    assert (results.agreement.count, results.agreement.p) == (3, pytest.approx(1 / 3))


def test_people_who_do_not_hear_the_reference_or_the_anchor_do_not_count(ratings):
    reasons = {each.listener: each.reason for each in ratings[0].excluded}
    assert reasons == {
        "listener15": "hidden reference: rated below 90 in 8 of 8",
        "listener16": "lowest anchor: rated above 90 in 8 of 8",
    }


@pytest.mark.parametrize("kind", ["choices", "ratings"])
def test_results_are_drawn(kind, request, tmp_path):
    results = request.getfixturevalue(kind)
    results = results[0] if isinstance(results, tuple) else results
    draw(results, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_without_listeners_there_is_nothing_to_draw(tmp_path):
    results = analyse(write_test(tmp_path / "test", design_of()))
    assert results.comparisons == ()
    assert "nobody's answers count yet" in text_of(results)
    with pytest.raises(NafirError, match="--figure"):
        draw(results, tmp_path / "figure.png")
