"""Names of files that a server offers: that of each is its stem, so no two may share one."""

from collections.abc import Iterable
from pathlib import Path


def named_by_stem(files: Iterable[Path]) -> dict[str, Path]:
    """Files by their stems; one that is given twice is one. Raises ValueError that names two files of one stem."""
    named: dict[str, Path] = {}
    for path in files:
        other = named.setdefault(path.stem, path)
        if other != path and other.resolve() != path.resolve():
            raise ValueError(f"{other} and {path} would both be called {path.stem!r}; rename one of them")
    return named
