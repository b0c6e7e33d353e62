"""A check that JSON objects have no duplicate keys.

RFC 8259, section 4, leaves the meaning of a duplicate key open. Most parsers take the last value and some the first, so
two parsers can understand one text differently.
"""

import json
from typing import Any


class DoubledKeyError(ValueError):
    """A JSON object has the key `key` twice."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key} is there twice: give it once")
        self.key = key


def require_distinct_keys(text: str | bytes) -> None:
    """Raises DoubledKeyError for the first, innermost object with a duplicate key. `text` has to be valid JSON."""
    json.loads(text, object_pairs_hook=_distinct)


def _distinct(pairs: list[tuple[str, Any]]) -> None:
    seen: set[str] = set()
    for key, _ in pairs:
        if key in seen:
            raise DoubledKeyError(key if len(key) <= 80 else f"{key[:80]}...")
        seen.add(key)
