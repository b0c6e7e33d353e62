"""Intervals against scipy and against their definitions."""

import math

import numpy as np
import pytest
import scipy.special
import scipy.stats

from server.listening.statistics import RankAgreement, Share, Spread, holm

Z = 1.959963984540054


def wilson(count, trials):
    share = count / trials
    middle = (share + Z**2 / (2 * trials)) / (1 + Z**2 / trials)
    half = Z / (1 + Z**2 / trials) * math.sqrt(share * (1 - share) / trials + Z**2 / (4 * trials**2))
    return middle - half, middle + half


def clopper_pearson(count, trials):
    low = 0.0 if count == 0 else scipy.special.betaincinv(count, trials - count + 1, 0.025)
    high = 1.0 if count == trials else scipy.special.betaincinv(count + 1, trials - count, 0.975)
    return low, high


@pytest.mark.parametrize(("count", "trials"), [(0, 10), (1, 10), (5, 10), (9, 10), (10, 10), (173, 210)])
def test_binomial_intervals_are_those_of_their_definitions(count, trials):
    share = Share.of([(count, trials)])
    assert share.share == count / trials
    assert share.wilson == pytest.approx(wilson(count, trials), abs=1e-9)
    assert share.clopper_pearson == pytest.approx(clopper_pearson(count, trials), abs=1e-9)
    tail = scipy.stats.binom.cdf(min(count, trials - count), trials, 0.5)
    assert share.p == pytest.approx(min(1.0, 2 * tail))
    assert share.over_listeners is None


def test_wilson_covers_the_true_share_as_often_as_it_says():
    rng = np.random.default_rng(1)
    for true in (0.5, 0.8):
        counts = rng.binomial(60, true, 1000)
        intervals = {count: Share.of([(int(count), 60)]).wilson for count in np.unique(counts)}
        covered = np.mean([intervals[count][0] <= true <= intervals[count][1] for count in counts])
        assert 0.92 < covered < 0.98


def test_intervals_over_listeners_are_wider_where_listeners_differ():
    alike, unlike = [(7, 10)] * 10, [(10, 10)] * 5 + [(4, 10)] * 5
    same, different = Share.of(alike), Share.of(unlike)
    assert same.over_listeners == pytest.approx((0.7, 0.7))
    low, high = different.over_listeners
    assert low < different.wilson[0]
    assert high > different.wilson[1]


def test_the_interval_over_listeners_is_scipys_bootstrap():
    rng = np.random.default_rng(2)
    ratings = rng.normal(60, 15, 25)
    spread = Spread.of([[rating] for rating in ratings])
    theirs = scipy.stats.bootstrap(
        (ratings,), np.median, n_resamples=8000, method="percentile", rng=np.random.default_rng(3)
    ).confidence_interval
    assert spread.median == np.median(ratings)
    assert spread.interval == pytest.approx((theirs.low, theirs.high), abs=2.0)
    assert spread.quartiles == pytest.approx(tuple(np.percentile(ratings, (25, 75))))


def test_holm_is_its_definition():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []


def test_agreement_of_ranks_needs_three_different_methods():
    found = RankAgreement.of([1, 2, 3, 4], [90, 80, 40, 10])
    assert found.rho == pytest.approx(-1.0)
    assert found.p == pytest.approx(2 / 24)  # two of the 24 orders of four
    assert RankAgreement.of([1, 2], [2, 1]) is None
    assert RankAgreement.of([1, 1, 1], [3, 2, 1]) is None
