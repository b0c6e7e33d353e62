"""A digest of the code that results depend on."""

import hashlib
from functools import cache
from pathlib import Path

import server
import training


@cache
def code_digest() -> str:
    """The digest of all modules of both packages."""
    digest = hashlib.sha256()
    for package in (server, training):
        for path in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()
