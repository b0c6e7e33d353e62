"""Names of the files that a server offers: the stem of each. No two files may have the same stem."""

from collections.abc import Iterable
from pathlib import Path


def named_by_stem(files: Iterable[Path]) -> dict[str, Path]:
    """Files by their stems. The same file may be given twice. Raises ValueError, which names both, for two files with
    the same stem."""
    named: dict[str, Path] = {}
    for path in files:
        other = named.setdefault(path.stem, path)
        if other != path and other.resolve() != path.resolve():
            raise ValueError(f"{other} and {path} would both be called {path.stem!r}; rename one of them")
    return named
