"""Every bundled scene is opened, played and left; no part that fails takes the page, or the way out of it, with it."""

import re

import pytest

from server.scene.bundle import bundled_scenes
from tests import visitor
from tests.visitor import level_db, listen, start

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

SCENES = tuple(folder.name for folder in bundled_scenes())


@pytest.fixture(scope="module")
def server():
    """A server of all of them."""
    with visitor.serving(visitor.free_port(), scenes=SCENES, costs_after_s=5.0) as url:
        yield url


@pytest.fixture
def context(browser):
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    yield context
    context.close()


def open_scene(context, server, scene):
    return visitor.open_page(context, f"{server}/?scene={scene}")


def test_every_bundled_scene_is_opened_played_and_left_by_its_menu(context, server):
    complaints: list[str] = []
    context.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    page = context.new_page()  # with the usual map
    page.goto(f"{server}/?scene={SCENES[0]}")
    page.evaluate("nafir.ready")
    for scene, following in zip(SCENES, (*SCENES[1:], SCENES[0]), strict=True):
        assert page.input_value("#scene-choice") == scene
        start(page)
        page.wait_for_function("nafir.state().level !== null && nafir.state().effects !== null")
        page.wait_for_timeout(500)
        for ear_db in level_db(listen(page, seconds=1.5)):
            assert -70 < ear_db < 0, scene
        assert page.locator("#level").inner_text() != "–"
        assert page.locator(".notice").all_inner_texts() == [], scene
        with page.expect_navigation():
            page.select_option("#scene-choice", following)
        page.evaluate("nafir.ready")
    assert page.input_value("#scene-choice") == SCENES[0]
    assert complaints == []


BROKEN = {
    "an error": {"status": 500, "body": "Internal Server Error"},
    "a document of another kind": {"json": {"unexpected": True}},
    "no JSON": {"body": "<html>", "content_type": "text/html"},
}


FEW = {("frontier", "an error"), ("loudness", "a document of another kind"), ("clips", "no JSON")}


@pytest.mark.parametrize(
    ("part", "answer"),
    [
        pytest.param(part, answer, id=f"{part}-{name}", marks=() if (part, name) in FEW else pytest.mark.long)
        for part in ("frontier", "loudness", "clips")
        for name, answer in BROKEN.items()
    ],
)
def test_a_part_that_fails_leaves_the_rest_as_it_is(context, server, part, answer):
    context.route(re.compile(rf"/v1/.*{part}"), lambda route: route.fulfill(**answer))
    page = open_scene(context, server, SCENES[0])
    assert page.locator("#scene-choice").is_visible()
    assert page.locator("#marks .listener").is_visible()
    page.click("#play")
    page.wait_for_function("nafir.state().connection === 'live'")
    assert page.locator("#connection-text").inner_text() == "Live"


def test_clips_and_frontier_appear_once_the_server_answers(context, server):
    failing = {"is": True}

    def fail_at_first(route):
        if failing["is"]:
            route.fulfill(status=503, json={"detail": "not now"})
        else:
            route.continue_()

    context.route(re.compile("/v1/(clips|.*frontier)"), fail_at_first)
    page = open_scene(context, server, SCENES[0])
    page.wait_for_function("document.getElementById('level-note').textContent.includes('not now')")
    failing["is"] = False
    page.wait_for_function("nafir.state().emitters.length === 1")
    page.wait_for_function("!document.getElementById('level-choice').disabled")


def test_a_scene_that_cannot_be_had_leaves_the_menu_that_leads_out(context, server):
    broken, sound = SCENES[:2]
    context.route(f"**/v1/scenes/{broken}", lambda route: route.fulfill(status=500, body=""))
    page = context.new_page()
    page.goto(f"{server}/?scene={broken}")
    page.locator("#scene-choice").wait_for()
    with page.expect_navigation():
        page.select_option("#scene-choice", sound)
    page.evaluate("nafir.ready")
    start(page)
