"""Where the scene knows directions, the page turns the sound: a turn is heard at once, and both times are shown."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from tests import visitor
from tests.directional_flat import write_directional
from tests.visitor import free_port, level_db, listen, open_page, serving, start

browser = visitor.browser
page = visitor.page
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[str]:
    """A server whose scene `flat` knows directions, at the page of that scene; it has the open field too."""
    folder = tmp_path_factory.mktemp("scenes") / "flat"
    write_directional(folder)
    with serving(free_port(), "--bundle", str(folder), scenes=("open-field",)) as url:
        yield f"{url}/?scene=flat"


def beside(page) -> None:
    """The source is a metre to the left of the listener."""
    page.evaluate("nafir.setEmitter('A', { x: 3.0, y: 2.5 })")
    page.evaluate("nafir.setListener({ x: 2.0, y: 2.5, yaw: -Math.PI / 2 })")


def test_a_turn_is_heard_sooner_than_a_step_and_both_times_are_shown(page):
    start(page)
    assert page.evaluate("nafir.state().output") == "ambisonics"
    page.wait_for_function("nafir.state().head === 'kemar'")
    listen(page)
    for step in range(20):
        page.evaluate(f"nafir.setListener({{ yaw: {0.1 * step} }})")
    state = page.evaluate("nafir.state()")
    turn, step = state["turnLatency"], state["latency"]
    assert 0 <= turn["heldMs"] < turn["totalMs"] < step["totalMs"]
    for figure in ("latency", "latency-turn"):
        page.wait_for_function("id => /^[0-9]+$/.test(document.getElementById(id).textContent)", arg=figure)
    assert page.inner_text("#turn").endswith("a turn of the head")
    assert page.inner_text("#latency-note").startswith("a step, 95% within ")
    assert page.inner_text("#latency-turn-held").endswith(" ms")


def test_turning_the_head_around_swaps_the_louder_ear(page):
    beside(page)
    start(page)
    page.wait_for_function("nafir.state().head === 'kemar'")
    page.wait_for_timeout(500)
    left, right = level_db(listen(page))
    assert left > right + 1
    page.evaluate("nafir.setListener({ yaw: Math.PI / 2 })")
    page.wait_for_timeout(500)
    left, right = level_db(listen(page))
    assert right > left + 1


def test_turns_need_no_server(page):
    """A turn that no message tells the server is heard all the same."""
    beside(page)
    start(page)
    page.wait_for_function("nafir.state().head === 'kemar'")
    page.evaluate("Worker.prototype.postMessage = () => {}")
    page.evaluate("void nafir.setListener({ yaw: Math.PI / 2 }).catch(() => {})")
    page.wait_for_timeout(500)
    left, right = level_db(listen(page))
    assert right > left + 1


def test_where_sound_is_turned_is_chosen_while_listening(page):
    beside(page)
    start(page)
    page.select_option("#turning", "server")
    page.wait_for_function("nafir.state().output === 'headphones' && nafir.state().poses.heard >= 0")
    page.locator("#turn").wait_for(state="hidden")
    page.wait_for_timeout(500)
    by_server = level_db(listen(page))
    assert by_server[0] > by_server[1] + 1
    page.select_option("#turning", "browser")
    page.wait_for_function("nafir.state().output === 'ambisonics' && nafir.state().poses.heard >= 0")
    page.locator("#turn").wait_for(state="visible")
    page.wait_for_timeout(500)
    np.testing.assert_allclose(level_db(listen(page)), by_server, atol=6)

    page.select_option("#output", "mono")
    page.wait_for_function("nafir.state().output === 'mono' && nafir.state().poses.heard >= 0")
    page.wait_for_selector("#turning:disabled")
    assert "One loudspeaker" in page.get_attribute("#turning", "title")
    page.wait_for_timeout(500)
    left, right = listen(page)
    np.testing.assert_array_equal(left, right)
    page.select_option("#output", "headphones")
    page.wait_for_function("nafir.state().output === 'ambisonics' && nafir.state().poses.heard >= 0")
    assert page.locator(".notice").count() == 0


def test_a_scene_that_knows_no_directions_is_turned_by_the_server(browser, server):
    context = browser.new_context()
    context.route(
        "**/v1/scenes/flat",
        lambda route: route.fulfill(json={**route.fetch().json(), "directional_levels": []}),
    )
    page = open_page(context, server)
    assert page.locator("#turning").is_disabled()
    assert page.input_value("#turning") == "server"
    assert "not from where sound arrives" in page.get_attribute("#turning", "title")
    start(page)
    assert page.evaluate("nafir.state().output") == "headphones"
    assert np.all(level_db(listen(page)) > -70)
    context.close()


def test_without_the_filters_of_the_head_the_server_turns(browser, server):
    context = browser.new_context()
    context.route(
        "**/decoder?*", lambda route: route.fulfill(status=503, json={"detail": "It is busy.", "code": "server_busy"})
    )
    page = open_page(context, server)
    start(page)
    page.wait_for_function("nafir.state().output === 'headphones' && nafir.state().poses.heard >= 0")
    assert "The sound is turned on the server: It is busy." in page.locator(".notice").inner_text()
    assert page.input_value("#turning") == "server"
    page.evaluate(f"nafir.setListener({{ yaw: {math.pi} }})")
    assert np.all(level_db(listen(page)) > -70)
    context.close()


def test_without_a_field_two_ears_are_heard_until_the_browser_is_chosen(browser, server):
    with visitor.visit(browser, server.replace("scene=flat", "scene=open-field")) as page:
        assert page.eval_on_selector("#turning", "menu => [menu.value, menu.disabled]") == ["server", False]
        start(page)
        assert page.evaluate("nafir.state().output") == "headphones"
        page.select_option("#turning", "browser")
        page.wait_for_function("nafir.state().output === 'ambisonics' && nafir.state().connection === 'live'")
