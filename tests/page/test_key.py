"""The page of a server that asks for a key: the browser asks its user for it, and the page where that is not enough."""

import contextlib
import re

import numpy as np
import pytest
from axe_playwright_python.base import AXE_FILE_PATH

from server.api.api_keys import create_key, revoke_key
from tests import visitor
from tests.visitor import free_port, level_db, listen, serving, start

browser = visitor.browser
pytestmark = visitor.needs_browser


@pytest.fixture(scope="module")
def keys_file(tmp_path_factory):
    return tmp_path_factory.mktemp("keys") / "keys.json"


@pytest.fixture(scope="module")
def keys(keys_file):
    """Keys by their scopes, each with its entry."""
    scopes = ("listen render", "render", "metrics", "listen")
    return {each: create_key(keys_file, each, each.split(), None) for each in scopes}


@pytest.fixture(scope="module")
def server(keys_file, keys):
    assert keys  # before the server reads the file
    with serving(free_port(), settings={"NAFIR_KEYS_FILE": str(keys_file)}) as url:
        yield url


@contextlib.contextmanager
def visiting(browser, password):
    """A page of a user who gives the browser this password, and the addresses that it asks for."""
    context = browser.new_context(
        viewport={"width": 1280, "height": 800},
        http_credentials=None if password is None else {"username": "me", "password": password},
    )
    page = context.new_page()
    requested = []
    page.on("request", lambda request: requested.append(request.url))
    page.on("websocket", lambda socket: requested.append(socket.url))
    yield page, requested
    context.close()


def kept(page):
    return page.evaluate("[Object.values(sessionStorage), Object.values(localStorage), document.cookie, location.href]")


def give(page, key):
    page.fill("#key-field", key)
    page.keyboard.press("Enter")


def test_who_gives_the_browser_the_key_hears_sound_and_is_asked_by_nobody_else(browser, server, keys):
    with visiting(browser, keys["listen render"][0]) as (page, requested):
        refused = []
        page.on("response", lambda answer: refused.append(answer.url) if answer.status in {401, 403} else None)
        page.goto(server)
        page.evaluate("nafir.ready")
        start(page)
        assert np.all(level_db(listen(page)) > -60)
        assert not page.query_selector("#key")
        assert refused == []  # but for the page itself, whose refusal the browser answers
        assert kept(page) == [[], [], "", f"{server}/"]
        assert any(url.startswith("ws://") for url in requested)


@pytest.mark.parametrize("password", [None, "nafir_000000000000_wrong", "schlüssel"])
def test_who_gives_the_browser_no_key_or_a_wrong_one_sees_nothing(browser, server, password):
    with visiting(browser, password) as (page, requested):
        statuses = []
        page.on("response", lambda answer: statuses.append(answer.status))
        page.on("requestfailed", lambda request: statuses.append(request.failure))
        with contextlib.suppress(visitor.sync_api.Error):  # a browser whose user gives up shows an error of its own
            page.goto(f"{server}/", wait_until="commit", timeout=10_000)
        assert set(statuses) <= {401, "net::ERR_INVALID_AUTH_CREDENTIALS"}
        assert statuses
        assert set(requested) == {f"{server}/"}


@pytest.fixture
def elsewhere(keys_file, keys):
    """A server for a page whose streams go to another name of it, for which the browser has no key: as for a browser
    that sends none with a WebSocket."""
    assert keys
    port = free_port()
    settings = {"NAFIR_KEYS_FILE": str(keys_file), "NAFIR_ALLOWED_ORIGINS": f"http://127.0.0.1:{port}"}
    with serving(port, settings=settings) as url:
        yield url


def send_streams_to_localhost(route):
    answer = route.fetch()
    body = answer.text().replace(
        "new WebSocket(this.#url,", 'new WebSocket(this.#url.replace("127.0.0.1", "localhost"),'
    )
    route.fulfill(response=answer, body=body)


def test_a_browser_that_sends_no_key_with_a_stream_has_the_page_ask_for_it_and_again_when_it_ends(
    browser, elsewhere, keys, keys_file
):
    key, entry = create_key(keys_file, "", ["listen", "render"], None)
    with visiting(browser, keys["listen"][0]) as (page, requested):
        page.context.route("**/nafir/stream.js", send_streams_to_localhost)
        page.goto(elsewhere)
        page.evaluate("nafir.ready")
        assert not page.query_selector("#key")
        page.click("#play")
        page.wait_for_selector("#key[open]")
        assert page.evaluate("document.activeElement.id") == "key-field"
        assert "needs a key for the sound" in page.inner_text("#key-reason")
        page.evaluate(AXE_FILE_PATH.read_text())
        found = page.evaluate("axe.run('#key').then(({ violations }) => violations.map(({ id }) => id))")
        assert found == []

        give(page, "nafir_000000000000_wrong")
        page.wait_for_function("document.getElementById('key-reason').textContent.includes('no such key')")
        page.keyboard.press("Escape")
        assert page.is_visible("#key[open]")
        assert page.input_value("#key-field") == ""

        give(page, f"  {key} ")
        page.wait_for_function("nafir.state().connection === 'live' && nafir.state().poses.heard >= 0")
        assert not page.is_visible("#key")

        other, _ = create_key(keys_file, "", ["listen", "render"], None)
        revoke_key(keys_file, entry.id)
        page.wait_for_selector("#key[open]")
        assert re.search("revoked|no such key", page.inner_text("#key-reason"))
        give(page, other)
        page.wait_for_function("nafir.state().connection === 'live'")

        session, local, cookies, address = kept(page)
        assert other in session
        assert (local, cookies, address) == ([], "", f"{elsewhere}/")
        assert not [each for each in requested if "nafir_" in each]


@pytest.mark.parametrize("scope", ["metrics", "render"])
def test_who_gave_the_browser_a_key_for_something_else_can_give_the_page_another(browser, server, keys, scope):
    with visiting(browser, keys[scope][0]) as (page, _):
        page.goto(server)
        if scope == "render":
            page.evaluate("nafir.ready")
            page.click("#play")
        page.wait_for_selector("#key[open]")
        assert "scope listen" in page.inner_text("#key-reason")
        give(page, keys["listen"][0])
        if scope == "metrics":
            page.evaluate("nafir.ready")
            page.click("#play")
        page.wait_for_function("nafir.state().connection === 'live'")
