"""The pages that show the HTTP interface, in a browser: whole, without a complaint, and without a foreign host."""

import urllib.parse

import pytest

from server.api.api_keys import create_key
from tests import visitor
from tests.visitor import browser, free_port, serving

pytestmark = visitor.needs_browser
__all__ = ["browser"]


@pytest.mark.parametrize(("path", "shown"), [("docs", ".opblock"), ("redoc", "#interface h1")])
def test_the_interface_is_shown_without_a_foreign_host(browser, server, path, shown):
    context = browser.new_context()
    complaints, asked = [], set()
    context.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    context.on("response", lambda response: asked.add(urllib.parse.urlsplit(response.url).netloc))
    page = context.new_page()
    page.goto(f"{server}/{path}")
    page.wait_for_selector(shown)
    assert page.get_by_text("/v1/scenes/{scene}/impulse-responses").count() > 0
    context.close()
    assert asked <= {urllib.parse.urlsplit(server).netloc, ""}
    assert [each for each in complaints if "cdn.redoc.ly" not in each] == []


@pytest.mark.parametrize("gives_the_page_another", [False, True])
def test_a_server_with_keys_shows_it_once_it_has_one_and_tries_out_with_it(browser, tmp_path, gives_the_page_another):
    """The browser asks its user; a key for something else opens the page, which then asks for another."""
    keys = {scope: create_key(tmp_path / "keys.json", "", [scope], None)[0] for scope in ("listen", "metrics")}
    password = keys["metrics" if gives_the_page_another else "listen"]
    context = browser.new_context(http_credentials={"username": "me", "password": password})
    page = context.new_page()
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    settings = {"NAFIR_KEYS_FILE": str(tmp_path / "keys.json")}
    with serving(free_port(), scenes=("open-field",), settings=settings) as url:
        page.goto(f"{url}/docs")
        if gives_the_page_another:
            page.wait_for_selector("#key[open]")
            assert page.locator(".opblock").count() == 0
            page.fill("#key-field", keys["listen"])
            page.keyboard.press("Enter")
        page.wait_for_selector(".opblock")
        page.locator("#operations-v1-get_scenes_v1_scenes_get, [id*='scenes_v1_scenes_get']").first.click()
        page.get_by_role("button", name="Try it out").first.click()
        with page.expect_response(f"{url}/v1/scenes") as answer:
            page.get_by_role("button", name="Execute").click()
        assert answer.value.status == 200
        sent = answer.value.request.all_headers()["authorization"]
        assert sent.startswith("Bearer " if gives_the_page_another else "Basic ")
        page.goto(f"{url}/redoc")
        page.wait_for_selector("#interface h1")
        assert not page.query_selector("#key")
    context.close()
    assert asked
    assert not [each for each in asked if "nafir_" in each]
