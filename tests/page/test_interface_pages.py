"""The pages that show the HTTP interface, in a browser: whole, without a complaint, and without a foreign host."""

import urllib.parse

import pytest

from tests import visitor
from tests.visitor import browser

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
