"""What a visitor sees of the page, on narrow screens and wide ones."""

import re

import pytest

from tests import visitor
from tests.visitor import open_page

browser = visitor.browser
pytestmark = visitor.needs_browser


@pytest.mark.parametrize("width", [360, 820, 1280])
def test_nothing_is_cut_off(browser, server, width):
    context = browser.new_context(viewport={"width": width, "height": 800})
    page = open_page(context, server)
    assert page.evaluate("document.scrollingElement.scrollWidth") <= width
    cut_off = page.evaluate(
        """() => [...document.querySelectorAll("h1, h2, #scene-name, button, dt, dd, .hint, figcaption, output")]
            .filter((node) => node.offsetParent && node.scrollWidth > node.clientWidth + 1 && node.clientWidth > 0)
            .map((node) => node.textContent.trim())"""
    )
    assert cut_off == []
    # Whatever the connection says, the menu ends before it.
    page.evaluate("document.getElementById('connection-text').textContent = 'Waiting for the server'")
    assert page.locator("#scene-choice").is_visible()
    end = page.evaluate("document.getElementById('scene-choice').getBoundingClientRect().right")
    row = page.evaluate("document.querySelector('.scene').getBoundingClientRect().right")
    assert end <= row + 0.5
    assert page.evaluate("document.scrollingElement.scrollWidth") <= width
    assert re.fullmatch(r".+ · Nafir", page.title())
    context.close()
