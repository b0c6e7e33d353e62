"""The page of a place of which no walls are known, in a real browser against a real server."""

import pytest

from tests import visitor

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]


@pytest.fixture(scope="module")
def page(browser, measured_bundle):
    with visitor.serving(visitor.free_port(), "--bundle", str(measured_bundle.folder), scenes=()) as url:
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        complaints: list[str] = []
        context.on("weberror", lambda error: complaints.append(str(error.error)))
        yield visitor.open_page(context, f"{url}/?scene=measured")
        context.close()
        assert complaints == []


def test_one_walks_as_far_as_the_bounds_and_is_heard_there(page):
    """There are no walls to keep a distance from, and single precision rounds no pose out of bounds."""
    assert page.inner_text("#scene-size") == "2 × 1.2 × 0.2 m"
    page.evaluate("nafir.setListener({ x: 0.4, y: -5.0 })")
    visitor.start(page)
    position = page.evaluate("nafir.state().listener.position")
    assert position[1] == pytest.approx(-0.2, abs=1e-3)
    page.evaluate("nafir.setListener({ x: -5.0, y: 5.0 })")
    assert (visitor.level_db(visitor.listen(page)) > -70).all()
    assert page.locator(".notice").count() == 0


def test_the_direct_sound_comes_from_its_side(page):
    page.evaluate("nafir.setListener({ x: 0.4, y: 0.4, yaw: -Math.PI / 2 })")
    page.evaluate("nafir.setEmitter('A', { x: 1.5, y: 0.4 })")
    page.wait_for_timeout(500)
    left, right = visitor.level_db(visitor.listen(page))
    assert left > right + 1
