"""A real server on a free port of the loopback interface."""

import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import uvicorn

from server.api.app import create_app
from server.api.serving import uvicorn_options
from server.api.settings import Settings
from server.assets.hrtfs import HrtfLibrary
from server.field.fields_by_level import FieldsByLevel

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


@contextmanager
def _serving(levels: FieldsByLevel, hrtfs: HrtfLibrary) -> Iterator[str]:
    app = create_app(settings := Settings(port=0), scenes={levels.bundle.id: levels}, hrtfs=hrtfs)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", **uvicorn_options(settings)))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.02)
        address = "{}:{}".format(*server.servers[0].sockets[0].getsockname())
        _wait_until_ready(address)
        yield address
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture(scope="session")
def serving() -> Callable[[FieldsByLevel, HrtfLibrary], AbstractContextManager[str]]:
    """Makes HOST:PORT of a server of a scene's levels, ready, with the options of `nafir serve`."""
    return _serving


@pytest.fixture(scope="module")
def served(bundle, hrtfs) -> Iterator[str]:
    """HOST:PORT of a server of the arithmetic scene, for tests that leave it as it was."""
    with _serving(FieldsByLevel.load(bundle), hrtfs) as address:
        yield address


@pytest.fixture
def served_anew(bundle, hrtfs) -> Iterator[str]:
    """The same, of a server for one test alone, with the environment of that test."""
    with _serving(FieldsByLevel.load(bundle), hrtfs) as address:
        yield address


def _wait_until_ready(address: str) -> None:
    """The first time ever, everything is compiled."""
    for _ in range(3_600):
        try:
            with urllib.request.urlopen(f"http://{address}/readyz", timeout=5):
                return
        except urllib.error.HTTPError as answer:
            answer.close()
            time.sleep(0.05)
    raise AssertionError("the server never became ready")
