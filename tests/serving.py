"""A real server on a free port of the loopback interface, in a thread of the tests' own process."""

import dataclasses
import math
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import uvicorn

from server.api.app import create_app
from server.api.serving import uvicorn_options
from server.api.settings import Settings
from server.assets.hrtfs import HrtfLibrary
from server.field.fields_by_level import FieldsByLevel
from server.streaming.load_thresholds import THRESHOLDS

_NEVER_S = 3600.0
"""After this time a server measures what nothing waits for, as what effects cost."""
_NEVER_LOADED = dataclasses.replace(THRESHOLDS, full_busy=math.inf, late=math.inf, tight=math.inf, patience_s=math.inf)
"""With these no load lowers the quality of a stream."""


@contextmanager
def serving(levels: FieldsByLevel, hrtfs: HrtfLibrary, *, steps_down: bool = True, **options: object) -> Iterator[str]:
    """Makes HOST:PORT of a server of a scene's levels, ready, with the options of `nafir serve`; `options` are
    settings. Of one that never `steps_down` samples can be compared, whatever else this machine does."""
    app = create_app(settings := Settings(port=0, **options), scenes={levels.bundle.id: levels}, hrtfs=hrtfs)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", **uvicorn_options(settings)))
    thread = threading.Thread(target=server.run)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("server.api.app._COSTS_AFTER_S", _NEVER_S)
        if not steps_down:
            patch.setattr("server.api.app.THRESHOLDS", _NEVER_LOADED)
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
