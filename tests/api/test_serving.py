"""What a server prints once it serves, and what it tells systemd."""

import asyncio
import contextlib
import socket
import threading
import time

import pytest
import uvicorn

from server.api import serving
from server.api.process_peers import ProcessPeers
from server.runtime.drain import Drain
from server.runtime.service_notices import ServiceNotices


@pytest.mark.parametrize(("cores", "processes"), [(1, None), (3, None), (4, 2), (16, 8), (17, 8)])
def test_where_one_process_leaves_cores_idle_it_says_what_uses_them(monkeypatch, cores, processes):
    monkeypatch.setattr(serving, "usable_cores", lambda: cores)
    first, *hints = serving.announcement(["flat"], "http://here").splitlines()
    assert first == "[bold]Nafir[/] serves flat at [link]http://here[/]"
    told = [] if processes is None else [f"One process fills about two of the {cores} cores: --processes {processes}"]
    assert [hint.removesuffix(" uses them all") for hint in hints] == told


def test_several_processes_say_how_many_they_are(monkeypatch):
    monkeypatch.setattr(serving, "usable_cores", lambda: 16)
    text = serving.announcement(["flat"], "http://here", peers=ProcessPeers(0, (1, 2, 3)))
    assert text == "[bold]Nafir[/] serves flat at [link]http://here[/] with 3 processes"


class Notices(ServiceNotices):
    """Keeps what it would tell."""

    def __init__(self):
        super().__init__("nowhere", 0.05)
        self.told = []

    def _send(self, notice):
        self.told.append(notice)


def until(condition):
    until_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.01)


def test_the_event_loop_itself_gives_the_signs_of_life():
    held, may_go_on = threading.Event(), threading.Event()

    async def app(_, receive, send):
        with contextlib.suppress(asyncio.CancelledError):
            while (message := await receive())["type"] != "lifespan.shutdown":
                await send({"type": f"{message['type']}.complete"})
        await send({"type": "lifespan.shutdown.complete"})

    def hold_up():
        held.set()
        may_go_on.wait(20)

    notices = Notices()
    server = serving.Server(uvicorn.Config(app, port=0, log_config=None), Drain(1.0), notices=notices)
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            until(lambda: notices.told.count("WATCHDOG=1") > 2)
            assert "READY=1" in notices.told[:2]
            server._loop.call_soon_threadsafe(hold_up)
            held.wait(20)
            before = len(notices.told)
            time.sleep(0.3)
            assert len(notices.told) == before
            may_go_on.set()
            until(lambda: len(notices.told) > before)
        finally:
            may_go_on.set()
            server.should_exit = True
            thread.join()
