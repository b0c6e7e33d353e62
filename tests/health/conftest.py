from collections.abc import Callable

import pytest

from server.scene.bundle import Bundle
from tests.damaged_field import write_ill_in_the_east


@pytest.fixture
def beyond(bundle, tmp_path) -> Callable[[float, object], Bundle]:
    """Has something added to levels where the listener is farther east than so many metres."""
    return lambda east_m, added: write_ill_in_the_east(bundle, tmp_path / "damaged", east_m, added=added)
