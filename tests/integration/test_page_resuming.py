"""A lost connection, or a server that starts anew, costs the page a gap: its stream goes on where it would be. One that
nobody knows any more begins anew."""

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
            page.wait_for_function(IS_LIVE)
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


@pytest.mark.parametrize(
    ("secret", "outcome"),
    [
        ({"NAFIR_RESUME_SECRET": "a secret of both", "NAFIR_SNAPSHOT_LIFETIME_S": "900"}, "resumed_from_snapshot"),
        pytest.param({}, "unknown", marks=pytest.mark.long, id="without a secret"),
    ],
)
def test_a_stream_of_a_server_that_was_started_anew_goes_on_if_there_is_a_secret(browser, secret, outcome):
    port = free_port()
    context = browser.new_context()
    with serving(port, settings={**LONG, **secret}) as url:
        page = open_page(context, url)
        start(page)
    page.wait_for_function(IS_WAITING)
    page.click("#add-source")
    with serving(port, settings={**LONG, **secret}) as url:
        page.wait_for_function(IS_LIVE)
        assert resumptions(url, outcome) == 1
        page.wait_for_function("nafir.state().effects?.decisions.some(({ emitter }) => emitter === 'B')")
        page.evaluate("nafir.setListener({ yaw: 1 })")
        assert np.all(level_db(listen(page)) > -70)
        notices = page.locator(".notice p").all_inner_texts()
        passing = "No loudness map", "the server is still warming up"
        assert [text for text in notices if not text.startswith(passing)] == []
        context.close()
