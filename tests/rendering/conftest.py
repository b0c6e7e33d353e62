import pytest

from server.rendering.hrtf import KEMAR, Hrtf


@pytest.fixture(scope="session")
def kemar() -> Hrtf:
    return Hrtf.read(KEMAR, 24_000)
