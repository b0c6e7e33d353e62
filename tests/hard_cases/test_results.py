"""The table of hard cases says what was measured, and a law that does not hold fails its case."""

import math

import pytest

from tests.hard_cases.results import Measurement, Measurements, markdown


@pytest.mark.parametrize(
    ("value", "at_least", "holds"),
    [
        (1.0, False, True),
        (1.1, False, False),
        (1.0, True, True),
        (0.9, True, False),
        (math.nan, False, False),
        (math.nan, True, False),
        (math.inf, False, False),
        (-math.inf, True, False),
    ],
)
def test_a_value_is_within_its_bound_or_not(value, at_least, holds):
    assert Measurement("peak", value, 1.0, "", at_least).holds == holds


def test_a_bound_without_end_is_no_bound():
    assert not Measurement("peak", 5.0, math.inf, "").holds


def test_measuring_fails_the_case_whose_law_is_broken_and_keeps_the_worst():
    measured = Measurements()
    measured("peak", 0.5, 1.0)
    measured("peak", 0.8, 1.0)
    measured("peak", 0.2, 1.0)
    assert measured.worst["peak"].value == 0.8
    with pytest.raises(AssertionError, match=r"peak: 2 dB is not at most 1 dB"):
        measured("peak", 2.0, 1.0, "dB")
    with pytest.raises(AssertionError):
        measured("peak", math.nan, 1.0)


def test_the_table_has_the_worst_of_cases_that_share_a_row():
    found = {
        "tests/hard_cases/test_gains.py::test_a_loud_gain[a]": [Measurement("error", -100.0, -90.0, "dB")],
        "tests/hard_cases/test_gains.py::test_a_loud_gain[b]": [Measurement("error", -95.0, -90.0, "dB")],
        "tests/hard_cases/test_poses.py::test_a_wall": [Measurement("length", 3.0, 2.0, "m", at_least=True)],
    }
    table = markdown(found)
    assert "| a loud gain (2) | error | at most -90 dB | -95 dB | 5 dB |" in table
    assert "| a wall | length | at least 2 m | 3 m | 1 m |" in table
    assert table.index("### Gains") < table.index("### Poses")
