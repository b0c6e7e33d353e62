"""The page of a level: its storeys, drawn as they are cut, and its doors, with a handle on each."""

import math
import urllib.parse

import pytest

from server.field.fields_by_level import FieldsByLevel
from tests import visitor
from tests.serving import serving
from tests.two_rooms import BEFORE, BEHIND, write_two_rooms
from tests.visitor import open_page

browser = visitor.browser
pytestmark = visitor.needs_browser


@pytest.fixture(scope="module")
def url(tmp_path_factory, hrtfs):
    folder = tmp_path_factory.mktemp("level") / "scene"
    levels = FieldsByLevel.load(write_two_rooms(folder, openness=0.0, has_upper_storey=True))
    with serving(levels, hrtfs) as address:
        yield f"http://{address}"


class Visit:
    """A page, with what it has asked for and what went wrong."""

    def __init__(self, browser, url):
        self.context = browser.new_context(viewport={"width": 1_280, "height": 900})
        self.asked, self.errors = [], []
        self.context.on("request", lambda request: self.asked.append(request.url))
        self.context.on("weberror", lambda error: self.errors.append(str(error.error)))
        self.page = open_page(self.context, url)

    def door(self):
        return self.page.locator("[data-door=between]")

    def openness(self):
        return int(self.door().get_attribute("aria-valuenow"))

    def maps(self):
        return [urllib.parse.parse_qs(urllib.parse.urlsplit(each).query) for each in self.asked if "/loudness" in each]


@pytest.fixture
def visit(browser, url):
    visit = Visit(browser, url)
    yield visit
    assert visit.errors == []
    visit.context.close()


def test_a_door_is_opened_and_shut_by_click_drag_and_keyboard(visit):
    page, door = visit.page, visit.door()
    assert page.locator("#door-hint").is_visible()
    assert (door.get_attribute("role"), door.get_attribute("aria-valuetext")) == ("slider", "shut")
    assert visit.maps()[-1]["door"] == ["between=0"]
    door.locator(".leaf").click(force=True)
    assert (visit.openness(), door.get_attribute("aria-valuetext")) == (100, "open")
    page.wait_for_function(
        "() => performance.getEntriesByType('resource').some(({name}) => name.includes('between%3D1'))"
    )
    before = page.evaluate("nafir.state().listener.position")
    door.focus()
    for key, openness in (("ArrowDown", 90), ("Home", 0), ("ArrowUp", 10), ("End", 100), ("Space", 0), ("Enter", 100)):
        page.keyboard.press(key)
        assert visit.openness() == openness
    assert page.evaluate("nafir.state().listener.position") == before
    # From open, where the leaf points west, half the way back to shut, where it points north.
    box = door.locator(".leaf").bounding_box()
    hinge = box["x"] + box["width"], box["y"] + box["height"]
    length = box["width"]
    page.mouse.move(hinge[0] - 0.8 * length, hinge[1] - 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(hinge[0] - 0.57 * length, hinge[1] - 0.57 * length, steps=5)
    page.mouse.up()
    assert visit.openness() == pytest.approx(50, abs=4)


def test_a_scene_without_doors_does_not_speak_of_them(browser, server):
    context = browser.new_context()
    assert not open_page(context, server).locator("#door-hint").is_visible()
    context.close()


def level_db(page):
    """Of the last second."""
    heard = page.evaluate("nafir.capture(1).then(({ left, right }) => [...left, ...right])")
    return 10 * math.log10(sum(sample * sample for sample in heard) / len(heard) + 1e-12)


def test_a_door_is_heard_and_goes_into_the_link(visit):
    page = visit.page
    page.click("#play")
    page.wait_for_function("nafir.state().connection === 'live'")
    place = "({ x: %g, y: %g, z: %g })"
    page.evaluate(f"nafir.setListener{place % BEFORE}")
    page.evaluate(f"nafir.setEmitter('A', {place % BEHIND})")
    levels = {}
    for key, openness in (("Home", 0), ("End", 1)):
        visit.door().focus()
        page.keyboard.press(key)
        page.wait_for_function(f"nafir.state().doors.between === {openness}")
        page.wait_for_timeout(2_500)
        levels[openness] = level_db(page)
    assert levels[1] > levels[0] + 12
    page.click("#share")
    page.wait_for_function("location.hash.includes('doors=between:1')")
    again = open_page(visit.context, page.url)
    assert again.locator("[data-door=between]").get_attribute("aria-valuenow") == "100"


def test_a_storey_is_drawn_and_gone_to(visit):
    page = visit.page
    choice = page.locator("#storey-choice")
    assert choice.locator("option").all_inner_texts() == ["Ground floor", "Floor 1"]
    assert any("/section?height_m=1.300" in each for each in visit.asked)
    height = page.evaluate("nafir.state().listener.position[2]")
    with page.expect_response(lambda response: "/section?height_m=4.300" in response.url) as drawn:
        choice.select_option("1")
    assert len(drawn.value.json()["lines"]) > 8
    assert page.evaluate("nafir.state().listener.position[2]") == pytest.approx(height + 3.0, abs=1e-3)
    assert not visit.door().is_visible()
    assert "elsewhere" in page.locator("[data-emitter=A]").get_attribute("class")
    page.wait_for_function(
        f"() => performance.getEntriesByType('resource').some(({{name}}) => name.includes('height_m={height + 3:g}'))"
    )
    choice.select_option("0")
    assert visit.door().is_visible()


def test_what_the_browser_cannot_render_is_not_offered(visit):
    assert visit.page.locator("#level-choice option[value=in-this-browser]").count() == 0
