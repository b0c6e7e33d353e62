"""A real server on a free port of the loopback interface."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from server.assets.hrtfs import HrtfLibrary
from server.field.fields_by_level import FieldsByLevel
from tests import serving as servers

HERE = Path(__file__).parent
_LEFT_CLOSING = "ignore:unclosed transport <_SelectorSocketTransport closing:ResourceWarning"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Servers and browsers here are measured while they run: every test is `timed` that is not `untimed`. A loop that
    ends while a connection is being closed leaves its transport to the collector, which is no fault."""
    for item in items:
        if HERE in item.path.parents:
            if item.get_closest_marker("untimed") is None:
                item.add_marker(pytest.mark.timed)
            item.add_marker(pytest.mark.filterwarnings(_LEFT_CLOSING))


@pytest.fixture(scope="session")
def serving() -> Callable[[FieldsByLevel, HrtfLibrary], AbstractContextManager[str]]:
    """Makes HOST:PORT of a server of a scene's levels, ready, with the options of `nafir serve`."""
    return servers.serving


@pytest.fixture(scope="module")
def served(bundle, hrtfs) -> Iterator[str]:
    """HOST:PORT of a server of the arithmetic scene, for tests that leave it as it was."""
    with servers.serving(FieldsByLevel.load(bundle), hrtfs) as address:
        yield address


@pytest.fixture
def served_anew(bundle, hrtfs) -> Iterator[str]:
    """The same, of a server for one test alone, with the environment of that test."""
    with servers.serving(FieldsByLevel.load(bundle), hrtfs) as address:
        yield address
