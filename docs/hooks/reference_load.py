"""Reference of the load policy's thresholds."""

import dataclasses

from reference_text import attribute_docstrings, code, number, sentence, table
from server.streaming.load_thresholds import THRESHOLDS, Thresholds


def load_thresholds() -> str:
    """Return a table of the thresholds, with their values and reasons."""
    reasons = attribute_docstrings(Thresholds)
    rows = [
        (code(each.name), _value(getattr(THRESHOLDS, each.name)), sentence(reasons.get(each.name, "")))
        for each in dataclasses.fields(Thresholds)
    ]
    return table(["threshold", "value", "unit and reason"], rows)


def _value(value: float | tuple[float, ...]) -> str:
    return ", ".join(number(round(each, 3)) for each in (value if isinstance(value, tuple) else (value,)))
