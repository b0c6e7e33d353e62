import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.core.durations import DurationHistogram


def histogram(durations_s):
    counted = DurationHistogram()
    for duration_s in durations_s:
        counted.add(duration_s)
    return counted


@given(st.lists(st.floats(2e-6, 50), min_size=1, max_size=200), st.sampled_from([0.01, 0.5, 0.99, 0.999, 1.0]))
def test_quantiles_are_those_of_the_durations_to_within_a_bin(durations_s, share):
    expected = np.quantile(durations_s, share, method="inverted_cdf")
    assert histogram(durations_s).quantiles_s(share) == [pytest.approx(expected, rel=0.0225)]


def test_before_the_first_there_is_nothing_to_tell():
    assert DurationHistogram().quantiles_s(0.5, 0.99) == [None, None]


@pytest.mark.parametrize(("duration_s", "told_s"), [(0.0, 1e-6), (-0.01, 1e-6), (1e9, 67.0)])
def test_what_is_off_the_scale_counts_as_its_end(duration_s, told_s):
    assert histogram([duration_s]).quantiles_s(0.5) == [pytest.approx(told_s, rel=0.03)]


def test_merging_is_counting_both():
    one, other = histogram([0.001] * 30), histogram([0.1] * 70)
    one.merge(other)
    assert one.count == 100
    assert one.quantiles_s(0.3, 0.31) == pytest.approx([0.001, 0.1], rel=0.03)


def test_a_sum_never_falls():
    counted = histogram([0.5])
    counted.add(-0.25)
    assert counted.total_s == 0.5
