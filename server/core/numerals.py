"""One grammar for numbers in text: URLs, options, CSV, lists of points, environment variables.

Python's `float` and `int` accept more than people mean by a number: `0_1` is 1, Arabic digits count, `nan` and
`infinity` are numbers. Here a number has ASCII digits and optionally a sign, a point and an exponent. It is always
finite. Blanks around it are allowed.
"""

import math
import re
from typing import Final

_EXPONENT: Final = r"([eE][+-]?([01]?[0-9]{1,2}|2[0-5][0-9]))?"
DECIMAL: Final = rf"[+-]?([0-9]{{1,40}}(\.[0-9]{{0,40}})?|\.[0-9]{{1,40}}){_EXPONENT}"
"""A decimal number as a regular expression for JSON Schema: what `parse_schema_decimal` reads. It matches only numbers
that are finite in double precision, and of those only zeros are zero there, whatever their up to forty digits are."""
ZERO: Final = rf"[+-]?(0{{1,40}}(\.0{{0,40}})?|\.0{{1,40}}){_EXPONENT}"
"""Those of `DECIMAL` that are zero."""
INTEGER: Final = r"[+-]?[0-9]{1,40}"

_SCHEMA_DECIMAL: Final = re.compile(DECIMAL)
_DECIMAL: Final = re.compile(r"[+-]?([0-9]{1,40}(\.[0-9]{0,40})?|\.[0-9]{1,40})([eE][+-]?[0-9]{1,3})?")
_INTEGER: Final = re.compile(INTEGER)
_NOT_FINITE: Final = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE | re.ASCII)
_UNBOUNDED: Final = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


def parse_decimal(text: str) -> float:
    """Read a finite number. Raises ValueError with a reason that quotes the text."""
    number = text.strip(" ")
    if _DECIMAL.fullmatch(number) is None or math.isinf(float(number)):
        raise ValueError(f"{_quoted(text)} is {_fault(number)}")
    return float(number)


def parse_schema_decimal(text: str) -> float:
    """Read a number of the grammar `DECIMAL`: `parse_decimal` also takes the finite ones beyond its exponents. Raises
    ValueError, as `parse_decimal` does."""
    number = parse_decimal(text)
    if _SCHEMA_DECIMAL.fullmatch(text.strip(" ")) is None:
        raise ValueError(f"{_quoted(text)} is too large or too small")
    return number


def parse_integer(text: str) -> int:
    """Read a whole number. Raises ValueError with a reason that quotes the text."""
    number = text.strip(" ")
    if _INTEGER.fullmatch(number) is None:
        raise ValueError(f"{_quoted(text)} is not a whole number")
    return int(number)


def as_whole(value: object) -> object:
    """The integer that a JSON number such as 1.0 is by JSON Schema; encoders of Lua and C# write integers so. Anything
    else is returned as it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _fault(number: str) -> str:
    if _NOT_FINITE.fullmatch(number):
        return "not finite"
    return "too long or too large" if _UNBOUNDED.fullmatch(number) else "not a number"


def _quoted(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:80]}...")
