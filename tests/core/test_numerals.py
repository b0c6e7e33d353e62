import math
import re
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.core.numerals import DECIMAL, INTEGER, ZERO, parse_decimal, parse_integer, parse_schema_decimal

NO_DECIMALS = [
    "",
    " ",
    "-",
    ".",
    "1.2.3",
    "0_1",
    "1_0.5",
    "1e1_0",
    "١",
    "٣٫٥",
    "１",
    "1\u00a0",
    "\t1",
    "1\n",
    "−1",  # U+2212
    "nan",
    "NaN",
    "inf",
    "-Infinity",
    "1e999",
    "0x10",
    "1,5",
    "1d3",
    "1 2",
    "true",
    "9" * 41,
]


@pytest.mark.parametrize("text", NO_DECIMALS)
def test_whatever_else_python_takes_for_a_number_is_refused(text):
    with pytest.raises(ValueError, match=r"is (not a number|not finite|too long or too large)$"):
        parse_decimal(text)


@pytest.mark.parametrize("text", [*NO_DECIMALS, "1.0", "1e3", "1."])
def test_an_integer_has_digits_alone(text):
    with pytest.raises(ValueError, match="is not a whole number"):
        parse_integer(text)


@pytest.mark.parametrize(
    ("text", "number"),
    [("1", 1), ("-0.5", -0.5), ("+.25", 0.25), ("3.", 3), ("1e-3", 0.001), (" 2E+2 ", 200), ("007", 7)],
)
def test_decimals_are_what_people_write(text, number):
    assert parse_decimal(text) == number


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_float_is_read_as_python_writes_it(number):
    assert parse_decimal(repr(number)) == number


@given(st.integers(-(10**40) + 1, 10**40 - 1))
def test_every_integer_is_read_as_python_writes_it(number):
    assert parse_integer(str(number)) == number


@given(st.from_regex(re.compile(DECIMAL), fullmatch=True))
def test_what_the_grammar_takes_is_finite_and_what_it_says(text):
    number = parse_schema_decimal(text)
    assert math.isfinite(number)
    assert (number == 0) == (re.fullmatch(ZERO, text) is not None) == (Fraction(text) == 0)
    assert abs(Fraction(number) - Fraction(text)) <= abs(Fraction(text)) * Fraction(2) ** -52 + Fraction(5e-324)


@pytest.mark.parametrize("text", ["1e260", "-1e300", "1e-260", "5e-324"])
def test_numbers_beyond_the_grammar_of_schemas_are_read_from_files_alone(text):
    assert parse_decimal(text) == float(text)
    with pytest.raises(ValueError, match="is too large or too small"):
        parse_schema_decimal(text)


@given(st.from_regex(re.compile(INTEGER), fullmatch=True))
def test_integers_are_in_decimals(text):
    assert float(parse_integer(text)) == parse_decimal(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("one", "'one' is not a number"),
        ("0_1", "'0_1' is not a number"),
        ("-inf", "'-inf' is not finite"),
        ("NaN", "'NaN' is not finite"),
        ("1e999", "'1e999' is too long or too large"),
        ("0" * 41, f"'{'0' * 41}' is too long or too large"),
    ],
)
def test_the_reason_says_what_is_wrong(text, reason):
    with pytest.raises(ValueError) as refusal:
        parse_decimal(text)
    assert str(refusal.value) == reason


def test_the_text_at_fault_is_not_quoted_at_full_length():
    with pytest.raises(ValueError) as refusal:
        parse_decimal("x" * 10_000)
    assert len(str(refusal.value)) < 200
