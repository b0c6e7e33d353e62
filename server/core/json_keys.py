"""Objects in JSON name each key once.

RFC 8259, 4, leaves open what a key means that is there twice, and readers differ: most take the last value, some the
first, so two of them can understand one text differently.
"""

import json
from typing import Any


class DoubledKeyError(ValueError):
    """An object that names a `key` twice."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key} is there twice: give it once")
        self.key = key


def require_distinct_keys(text: str | bytes) -> None:
    """Of a text that is known to be JSON. Raises DoubledKeyError for the innermost, first object with a key twice."""
    json.loads(text, object_pairs_hook=_distinct)


def _distinct(pairs: list[tuple[str, Any]]) -> None:
    seen: set[str] = set()
    for key, _ in pairs:
        if key in seen:
            raise DoubledKeyError(key if len(key) <= 80 else f"{key[:80]}...")
        seen.add(key)
