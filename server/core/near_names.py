"""Suggestions for misspelt names."""

from collections.abc import Iterable
from difflib import get_close_matches

_LONGEST = 64
"""Longer names are cut before they are compared, since the comparison takes quadratic time."""


def suggestion(name: str, known: Iterable[str], prefix: str = "") -> str:
    """The end of an error message: "; did you mean 'x'?", or all known names if none is similar. `prefix` is written
    before each name."""
    names = sorted(known)
    near = get_close_matches(name[:_LONGEST], names, n=1, cutoff=0.6)
    if near:
        return f"; did you mean {prefix + near[0]!r}?"
    return f"; there is {', '.join(prefix + each for each in names)}" if names else "; there are none"
