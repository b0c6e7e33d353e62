"""The page of a server that asks for a key."""

import re

import pytest
from axe_playwright_python.base import AXE_FILE_PATH

from server.api.api_keys import create_key, revoke_key
from tests import visitor
from tests.visitor import free_port, serving, start

browser = visitor.browser
pytestmark = visitor.needs_browser


@pytest.fixture(scope="module")
def keys_file(tmp_path_factory):
    return tmp_path_factory.mktemp("keys") / "keys.json"


@pytest.fixture(scope="module")
def first(keys_file):
    """A key and its entry."""
    return create_key(keys_file, "", ["listen", "render"], None)


@pytest.fixture(scope="module")
def server(keys_file, first):
    assert first  # before the server reads the file
    with serving(free_port(), settings={"NAFIR_KEYS_FILE": str(keys_file)}) as url:
        yield url


def give(page, key):
    page.fill("#key-field", key)
    page.keyboard.press("Enter")


def test_the_page_asks_for_a_key_keeps_it_for_the_tab_and_asks_again_when_it_ends(browser, server, keys_file, first):
    key, entry = first
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = context.new_page()
    requested = []
    page.on("request", lambda request: requested.append(request.url))
    page.on("websocket", lambda socket: requested.append(socket.url))
    page.goto(server)
    page.wait_for_selector("#key[open]")
    assert page.evaluate("document.activeElement.id") == "key-field"
    assert "needs a key" in page.inner_text("#key-reason")
    page.evaluate(AXE_FILE_PATH.read_text())
    found = page.evaluate("axe.run('#key').then(({ violations }) => violations.map(({ id }) => id))")
    assert found == []

    give(page, "nafir_000000000000_wrong")
    page.wait_for_function("document.getElementById('key-reason').textContent.includes('no such key')")
    page.keyboard.press("Escape")
    assert page.is_visible("#key[open]")
    assert page.input_value("#key-field") == ""

    give(page, f"  {key} ")
    page.wait_for_function("document.body.classList.contains('ready')")
    assert not page.is_visible("#key")
    start(page)

    other, _ = create_key(keys_file, "", ["listen", "render"], None)
    revoke_key(keys_file, entry.id)
    page.wait_for_selector("#key[open]")
    assert re.search("revoked|no such key", page.inner_text("#key-reason"))
    give(page, other)
    page.wait_for_function("nafir.state().connection === 'live'")

    kept = "[Object.values(sessionStorage), Object.values(localStorage), document.cookie, location.href]"
    session, local, cookies, address = page.evaluate(kept)
    assert other in session
    assert (local, cookies, address) == ([], "", f"{server}/")
    assert requested
    assert not [url for url in requested if "nafir_" in url]
    context.close()
