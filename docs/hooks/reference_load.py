"""Reference of the load policy's thresholds, and of the limits of admission."""

import dataclasses

from reference_text import code, number, sentence, table
from server.core.docstrings import attribute_docstrings
from server.streaming.headroom import LIMITS, Limits
from server.streaming.load_thresholds import THRESHOLDS, Thresholds


def load_thresholds() -> str:
    """Return a table of the thresholds, with their values and reasons."""
    return _numbers("threshold", THRESHOLDS)


def admission_limits() -> str:
    """Return a table of the limits, with their values and reasons."""
    return _numbers("limit", LIMITS)


def _numbers(title: str, numbers: Thresholds | Limits) -> str:
    reasons = attribute_docstrings(type(numbers))
    rows = [
        (code(each.name), _value(getattr(numbers, each.name)), sentence(reasons.get(each.name, "")))
        for each in dataclasses.fields(numbers)
    ]
    return table([title, "value", "unit and reason"], rows)


def _value(value: float | tuple[float, ...]) -> str:
    return ", ".join(_shown(each) for each in (value if isinstance(value, tuple) else (value,)))


def _shown(value: float) -> str:
    return f"{value:g}" if 0 < value < 1e-3 else number(round(value, 3))
