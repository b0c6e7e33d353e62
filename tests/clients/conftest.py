"""A server of the arithmetic scene, for clients of every language."""

from collections.abc import Iterator

import pytest

from server.field.fields_by_level import FieldsByLevel
from tests.serving import serving


@pytest.fixture(scope="module")
def served(bundle, hrtfs) -> Iterator[str]:
    """HOST:PORT, for tests that leave the server as it was."""
    with serving(FieldsByLevel.load(bundle), hrtfs) as address:
        yield address
