"""What a visitor may choose: how many sources there are, and whose head hears them."""

import re
import shutil

import h5py
import numpy as np
import pytest

from server.rendering.hrtf import KEMAR
from tests import visitor
from tests.visitor import free_port, level_db, listen, open_page, serving, start

browser = visitor.browser
page = visitor.page
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

MOST_SOURCES = 4


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A server of few sources and of two heads: KEMAR, and one whose far ear hears next to nothing."""
    lopsided = tmp_path_factory.mktemp("heads") / "lopsided.sofa"
    shutil.copy(KEMAR, lopsided)
    with h5py.File(lopsided, "r+") as file:
        to_left = np.sign(np.sin(np.radians(file["SourcePosition"][:, 0])))
        middle = file["Data.IR"][:].mean(axis=1)
        file["Data.IR"][:] = middle[:, None] * (1 + 0.9 * to_left[:, None] * np.array([1, -1]))[..., None]
    settings = {"NAFIR_MAX_EMITTERS": str(MOST_SOURCES)}
    scenes = ("apartment", "open-field")
    with serving(free_port(), "--hrtf", str(lopsided), scenes=scenes, settings=settings) as url:
        yield url


def sources(page) -> list[str]:
    return [each["id"] for each in page.evaluate("nafir.state().emitters")]


def test_sources_are_added_and_removed_up_to_what_the_server_plays(page):
    add, reason = page.locator("#add-source"), page.locator("#source-limit")
    start(page)
    for count in range(1, MOST_SOURCES):
        assert (add.get_attribute("aria-disabled"), reason.inner_text()) == ("false", "")
        add.click()
        assert page.locator("#sources li").count() == page.locator("#marks .emitter").count() == count + 1
    assert sources(page) == ["A", "B", "C", "D"]
    places = {tuple(each["position"]) for each in page.evaluate("nafir.state().emitters")}
    assert len(places) == MOST_SOURCES
    colours = page.eval_on_selector_all("#sources .badge", "all => all.map((e) => getComputedStyle(e).backgroundColor)")
    assert len(set(colours)) == MOST_SOURCES

    assert add.is_visible()
    assert add.get_attribute("aria-disabled") == "true"
    assert reason.inner_text() == "This server plays at most 4 sources at once."
    assert add.get_attribute("aria-describedby") == reason.get_attribute("id")
    add.click(force=True)
    assert len(sources(page)) == MOST_SOURCES

    page.click("[data-source=B] .remove")
    assert (add.get_attribute("aria-disabled"), reason.inner_text()) == ("false", "")
    add.click()
    assert sorted(sources(page)) == ["A", "B", "C", "D"]
    for one in "ABC":
        page.click(f"[data-source={one}] .remove")
    page.click("[data-source=D] .remove", force=True)
    assert sources(page) == ["D"], "the last source stays"
    page.wait_for_timeout(500)
    assert np.all(level_db(listen(page)) > -70)
    assert page.locator(".notice").count() == 0, "the server refused nothing"


def test_the_page_learns_that_a_server_plays_fewer_than_it_said(browser, server):
    context = browser.new_context()
    many = re.compile("/v1/scenes$")
    context.route(many, lambda route: route.fulfill(json={**route.fetch().json(), "max_emitters": 9}))
    page = open_page(context, server)
    for _ in range(MOST_SOURCES):
        page.click("#add-source")
    assert len(sources(page)) == MOST_SOURCES + 1
    start(page)
    page.locator(".notice", has_text="at most 4 emitters").wait_for()
    assert "at most 4 sources" in page.inner_text("#source-limit")
    context.close()


def interaural_db(page) -> float:
    left, right = level_db(listen(page, seconds=2))
    assert min(left, right) > -70
    return left - right


def test_another_head_is_chosen_while_listening_and_stays_chosen(browser, server):
    """In the open there is nothing but the direct sound, here from the left."""
    context = browser.new_context()
    page = open_page(context, f"{server}/?scene=open-field")
    page.wait_for_function("!document.getElementById('head').disabled")
    assert page.locator("#head option").all_inner_texts() == ["KEMAR", "lopsided"]
    page.select_option("#turning", "server")
    page.evaluate("nafir.setListener({ x: 0, y: 0, yaw: 0 })")
    page.evaluate("nafir.setEmitter('A', { x: 0, y: 3 })")
    start(page)
    assert page.evaluate("nafir.state().head") == page.input_value("#head") == "kemar"
    kemar_db = interaural_db(page)

    page.select_option("#head", "lopsided")
    page.wait_for_function("nafir.state().head === 'lopsided' && nafir.state().poses.heard >= 0")
    page.wait_for_timeout(500)
    assert interaural_db(page) == pytest.approx(20 * np.log10(1.9 / 0.1), abs=1)
    assert 1 < kemar_db < 18

    page.click("#play")
    page.wait_for_function("nafir.state().head === null")
    start(page)
    assert page.evaluate("nafir.state().head") == "lopsided"

    page.select_option("#output", "mono")
    assert page.locator("#head").is_disabled()
    assert "no head" in page.get_attribute("#head", "title")
    page.select_option("#output", "headphones")
    assert page.input_value("#head") == "lopsided"
    assert page.locator("#head").is_enabled()
    context.close()


def test_a_head_that_is_gone_gives_way_to_those_there_are(browser, server):
    context = browser.new_context()
    gone = {"default": "gone", "hrtfs": ["gone"]}
    context.route("**/v1/hrtfs", lambda route: route.fulfill(json=gone))
    page = open_page(context, server)
    page.wait_for_function("document.getElementById('head').value === 'gone'")
    context.unroute("**/v1/hrtfs")
    page.click("#play")
    page.locator(".notice", has_text="no HRTF 'gone'").first.wait_for()
    page.wait_for_function("document.getElementById('head').value === 'kemar'")
    start(page)
    assert page.evaluate("nafir.state().head") == "kemar"
    context.close()
