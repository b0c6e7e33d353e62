"""A visitor of the page: a real browser, a real server, and what then comes out of the loudspeakers.

Levels are in decibels relative to full scale. Modules that visit take the fixtures they need by name.
"""

import base64
import contextlib
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping

import numpy as np
import pytest

from server.scene.bundle import bundled_scenes

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

needs_browser = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
    pytest.mark.skipif(
        not any(folder.name == "apartment" for folder in bundled_scenes()), reason="the apartment is not bundled"
    ),
]

# Playwright's own list of features to do without gives way to this one. In each window, Chromium would load two pages
# for its address bar, which nobody sees and which take a fifth of the processor time of a visit.
_WITHOUT = (
    "WebUIOmniboxPopup",
    "WebUIOmniboxAimPopup",
    "HttpsUpgrades",
    "MediaRouter",
    "OptimizationHints",
    "PaintHolding",
)
CHROMIUM_ARGUMENTS = [
    "--no-sandbox",
    "--autoplay-policy=no-user-gesture-required",
    "--disable-dev-shm-usage",
    f"--disable-features={','.join(_WITHOUT)}",
]
LISTENING_S = 2.5
WAIT_MS = 120_000
"""Limit for what a page waits for: playwright's own 30 s are too few where others have the machine."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


_SERVE = """
from server.scene import bundle
bundled = [each for each in bundle.bundled_scenes() if each.name in {scenes}]
bundle.bundled_scenes = lambda: bundled
from server.api import app
app._COSTS_AFTER_S = {costs_after_s}
from server.cli.main import main
main()
"""


@contextlib.contextmanager
def serving(
    port: int,
    *options: str,
    scenes: tuple[str, ...] = ("apartment",),
    costs_after_s: float = 3600.0,
    settings: Mapping[str, str] | None = None,
) -> Iterator[str]:
    """A server of its own process, ready to stream; `settings` are environment variables.

    Of the bundled scenes it has `scenes`, each of which takes a second to load and another to measure. What nothing
    waits for, as what effects cost, it measures `costs_after_s`: usually never.
    """
    program = _SERVE.format(scenes=scenes, costs_after_s=costs_after_s)
    command = [sys.executable, "-c", program, "serve", "--port", str(port), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, **(settings or {})})
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 180  # the first time ever, everything is compiled
        while True:
            assert process.poll() is None, "the server ended before it was ready"
            assert time.monotonic() < deadline, "the server was not ready within three minutes"
            # A server that compiles may be slow to answer, too.
            with contextlib.suppress(urllib.error.URLError, ConnectionError, TimeoutError):
                urllib.request.urlopen(f"{url}/readyz", timeout=5).close()
                break
            time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(timeout=20)


@contextlib.contextmanager
def passing_on(port: int, url: str) -> Iterator[str]:
    """A way to a server, at a port of its own. At the end it refuses connections, and those there are break."""
    _, _, address = url.rpartition("/")
    host, _, number = address.partition(":")
    ends: list[socket.socket] = []
    threads: list[threading.Thread] = []

    def begin(work, *given) -> None:
        threads.append(threading.Thread(target=work, args=given))
        threads[-1].start()

    def pass_on(source: socket.socket, to: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65_536):
                to.sendall(data)
        with contextlib.suppress(OSError):
            to.shutdown(socket.SHUT_WR)

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                ends.append(client)
                server = socket.create_connection((host, int(number)))
                ends.append(server)
                begin(pass_on, client, server)
                begin(pass_on, server, client)

    listener = socket.create_server(("127.0.0.1", port))
    begin(accept)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        threads[0].join()
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join()
        for end in ends:
            end.close()


def launch(playwright):
    """A browser whose pages wait for `WAIT_MS`, unless they say how long."""
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=CHROMIUM_ARGUMENTS)
    new_context = browser.new_context

    def new_patient_context(**options):
        context = new_context(**options)
        context.set_default_timeout(WAIT_MS)
        return context

    browser.new_context = new_patient_context
    return browser


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = launch(playwright)
        yield browser
        browser.close()


_COARSE_MAPS = """{
  const fetched = window.fetch;
  window.fetch = (asked, ...options) => {
    if (asked instanceof URL && asked.pathname.endsWith("/loudness") && !asked.pathname.includes("/open-field/"))
      asked.searchParams.set("spacing_m", "1");
    return fetched(asked, ...options);
  };
}"""
"""The usual map takes a dozen seconds of a core, as often as a page is opened. `test_page_scenes.py` asks for it. An
open field has a coarser one."""


def open_page(context, url: str):
    """With coarse maps of loudness, and without ripples about sources."""
    page = context.new_page()
    page.emulate_media(reduced_motion="reduce")
    page.add_init_script(_COARSE_MAPS)
    page.goto(url)
    page.evaluate("nafir.ready")
    return page


@contextlib.contextmanager
def visit(browser, url: str) -> Iterator:
    """The page, loaded; fails if an error was left in the console."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    complaints: list[str] = []
    context.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    yield open_page(context, url)
    context.close()
    assert complaints == []


@pytest.fixture
def page(browser, server):
    """The page, loaded for one test, which fails if it leaves an error in the console."""
    with visit(browser, server) as page:
        yield page


@pytest.fixture(scope="module")
def one_page(browser, server):
    """The page, loaded once for tests that only use its modules."""
    with visit(browser, server) as page:
        yield page


def start(page) -> None:
    page.click("#play")
    page.wait_for_function("nafir.state().connection === 'live' && nafir.state().poses.heard >= 0")


_CAPTURE = """seconds => nafir.capture(seconds).then(({ left, right }) => [left, right].map((ear) => {
  const bytes = new Uint8Array(ear.buffer, ear.byteOffset, ear.byteLength);
  let text = "";
  for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192));
  return btoa(text);
}))"""
"""As base64: playwright passes an array number by number, which takes seconds."""


def listen(page, *, seconds: float = LISTENING_S) -> np.ndarray:
    """(2, n): what is played in the seconds after all that was posed so far is heard."""
    posed = page.evaluate("nafir.state().poses.posed")
    page.wait_for_function("posed => nafir.state().poses.answered >= posed", arg=posed)
    page.wait_for_timeout(1000 * seconds)
    ears = [np.frombuffer(base64.b64decode(ear), np.float32) for ear in page.evaluate(_CAPTURE, seconds)]
    return np.asarray(ears, np.float64)


def level_db(samples: np.ndarray) -> np.ndarray:
    """(2,) RMS of each ear."""
    return 10 * np.log10(np.mean(samples**2, axis=-1) + 1e-20)
