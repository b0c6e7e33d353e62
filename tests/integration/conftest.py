"""A real server on a free port of the loopback interface."""

import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
import uvicorn

from server.app import create_app
from server.cli import server_options
from server.field.levels import Levels
from server.settings import Settings


@pytest.fixture
def served(bundle, hrtfs) -> Iterator[str]:
    """HOST:PORT of a server of the arithmetic scene, ready, with the options of `nafir serve`."""
    settings = Settings(port=0)
    app = create_app(settings, scenes={bundle.id: Levels.load(bundle)}, hrtfs=hrtfs)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", **server_options(settings)))
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
