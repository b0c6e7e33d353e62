"""What somebody may have meant who wrote a name that there is not."""

from collections.abc import Iterable
from difflib import get_close_matches

_LONGEST = 64
"""Comparing names takes quadratic time."""


def suggestion(name: str, known: Iterable[str], prefix: str = "") -> str:
    """For the end of a message: "; did you mean 'x'?" or, where nothing is near, what there is. `prefix` is what all
    the names begin with, and is written before them."""
    names = sorted(known)
    near = get_close_matches(name[:_LONGEST], names, n=1, cutoff=0.6)
    if near:
        return f"; did you mean {prefix + near[0]!r}?"
    return f"; there is {', '.join(prefix + each for each in names)}" if names else "; there are none"
