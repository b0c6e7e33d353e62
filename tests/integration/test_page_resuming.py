"""A lost connection costs the page a gap: its stream goes on where it would be. One that is gone begins anew."""

import re
import urllib.request

import numpy as np
import pytest

from tests import visitor
from tests.visitor import free_port, level_db, listen, open_page, passing_on, serving, start

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

LONG = {"NAFIR_RESUME_S": "120"}  # a server may take long to start
IS_LIVE = "nafir.state().connection === 'live'"
IS_WAITING = "nafir.state().connection === 'waiting'"


def resumptions(url: str, outcome: str) -> int:
    with urllib.request.urlopen(f"{url}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    found = re.search(rf'nafir_stream_resumptions_total{{outcome="{outcome}"}} (\d+)', text)
    return int(found[1])


def test_a_stream_goes_on_with_what_was_changed_meanwhile(browser):
    port = free_port()
    context = browser.new_context()
    with serving(free_port(), settings=LONG) as server:
        with passing_on(port, server) as url:
            page = open_page(context, url)
            start(page)
        page.wait_for_function(IS_WAITING)
        page.click("#add-source")
        assert page.evaluate("nafir.state().emitters.length") == 2
        with passing_on(port, server):
            page.wait_for_function(IS_LIVE, timeout=visitor.WAIT_MS)
            assert resumptions(server, "resumed") == 1
            # The plan knows the source that came while there was no connection.
            page.wait_for_function("nafir.state().effects?.decisions.some(({ emitter }) => emitter === 'B')")
            page.evaluate("nafir.setListener({ yaw: 1 })")  # resolves when it is heard
            assert np.all(level_db(listen(page)) > -70)
            notices = page.locator(".notice p").all_inner_texts()
            assert [text for text in notices if not text.startswith("No loudness map")] == []
            page.click("#play")
            page.locator("#connection-text", has_text="Paused").wait_for()
            start(page)
            assert resumptions(server, "resumed") == 1, "after a pause there is nothing to resume"
            assert resumptions(server, "kept") == 1
            context.close()


def test_a_stream_of_a_server_that_was_started_anew_begins_anew(browser):
    port = free_port()
    context = browser.new_context()
    with serving(port, settings=LONG) as url:
        page = open_page(context, url)
        start(page)
    page.wait_for_function(IS_WAITING)
    with serving(port, settings=LONG) as url:
        page.wait_for_function(IS_LIVE, timeout=visitor.WAIT_MS)
        assert resumptions(url, "unknown") == 1
        page.evaluate("nafir.setListener({ yaw: 1 })")
        assert np.all(level_db(listen(page)) > -70)
        context.close()
