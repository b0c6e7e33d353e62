"""A situation is shared as a link, two ways of hearing it are compared by one key, and a phone turns the listener."""

import math

import numpy as np
import pytest

from tests import visitor
from tests.visitor import level_db, listen, open_page, start, visit

browser = visitor.browser
page = visitor.page
one_page = visitor.one_page
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]


IS_DRY = """() => {
  const reflected = ["early_reflections", "late_reverberation"];
  return nafir.state().effects.decisions.every(({ name, called_for: isOn }) => !isOn || !reflected.includes(name));
}"""


def situation(page) -> dict:
    said = page.evaluate("nafir.state()")
    choices = {name: page.input_value(f"#{name}") for name in ("level-choice", "output", "turning")}
    return {
        "listener": [*said["listener"]["position"], said["listener"]["yaw"]],
        "sources": [(each["clip"], each["gainDb"], *each["position"]) for each in said["emitters"]],
        **choices,
    }


def test_a_link_brings_others_into_the_same_situation(browser, page):
    page.wait_for_function("!document.getElementById('level-choice').disabled")
    page.evaluate("nafir.setListener({ x: 6.5, y: 2.5, yaw: -2 })")
    page.click("#add-source")
    page.evaluate("nafir.setEmitter('B', { x: 1.5, y: 1.25, z: 1.2 })")
    page.evaluate("document.querySelector('[data-source=B] .gain').value = -7")
    page.dispatch_event("[data-source=B] .gain", "input")
    level = page.evaluate("document.querySelector('#level-choice option:last-child').value")
    page.select_option("#level-choice", level)
    page.select_option("#output", "mono")
    page.click("#share")
    page.locator(".notice", has_text="link to what you hear").wait_for()
    assert page.evaluate("location.hash.length") > 20

    with visit(browser, page.url) as other:
        other.wait_for_function("!document.getElementById('level-choice').disabled")
        came, left = situation(other), situation(page)
        np.testing.assert_allclose(came["listener"], left["listener"], atol=2e-3)
        for theirs, ours in zip(came["sources"], left["sources"], strict=True):
            assert theirs[0] == ours[0]
            np.testing.assert_allclose(theirs[1:], ours[1:], atol=2e-3)
        assert {k: came[k] for k in ("level-choice", "output")} == {"level-choice": level, "output": "mono"}
        start(other)
        assert other.evaluate("nafir.state().level") == level


def test_what_a_link_says_wrong_is_left_out_and_told(browser, server):
    wrong = "#listener=2.2,x,1&source=moomin,1,1,1&source=half&level=best&turning=sideways&output=quadraphony"
    with visit(browser, f"{server}/?scene=apartment{wrong}") as page:
        page.locator(".notice", has_text="has no clip “moomin”").wait_for()
        said = situation(page)
        assert len(said["sources"]) == 1
        assert (said["level-choice"] or "auto", said["output"]) == ("auto", "headphones")


def test_a_link_survives_any_name_and_number(one_page):
    came, link = one_page.evaluate("""async () => {
      const { linkTo, readSituation } = await import("./situation.js");
      const said = {
        scene: "a flat&more", listener: { position: [-1.25, 0, 1e-9], yaw: Math.PI },
        sources: [
          { clip: "a,b:c%20 +&=#ü", position: [1, 2, 3], gainDb: -3 },
          { clip: "plain", position: [0.5, 0, 1], gainDb: 0 },
        ],
        level: "naf+r16", output: "mono", head: "my head", turning: "server", effects: { hrtf: false, occlusion: true },
      };
      const link = linkTo("http://host/page?scene=old#x", said);
      return [readSituation(new URL(link).hash), link];
    }""")
    assert came["sources"] == [
        {"clip": "a,b:c%20 +&=#ü", "position": [1, 2, 3], "gainDb": -3},
        {"clip": "plain", "position": [0.5, 0, 1], "gainDb": 0},
    ]
    assert came["listener"]["position"] == [-1.25, 0, 0]
    assert came["listener"]["yaw"] == pytest.approx(math.pi)
    assert (came["level"], came["output"], came["head"], came["turning"]) == ("naf+r16", "mono", "my head", "server")
    assert came["effects"] == {"hrtf": False, "occlusion": True}
    assert link.startswith("http://host/page?scene=a+flat%26more#listener=-1.25,0,0,180&source=")


def test_one_key_switches_between_a_level_and_the_direct_sound_alone(page):
    page.wait_for_function("!document.getElementById('compare-switch').disabled")
    page.evaluate("nafir.setListener({ x: 1, y: 1 })")
    page.evaluate("nafir.setEmitter('A', { x: 6.5, y: 4.5 })")  # behind walls, where nearly all is reflected
    start(page)
    page.wait_for_function("nafir.state().effects !== null")
    page.keyboard.press("x")
    assert page.inner_text("#compare-heard") == "You hear A."
    page.wait_for_function("nafir.state().level === document.getElementById('compare-a').value")
    page.wait_for_timeout(500)
    wet_db = level_db(listen(page))
    page.keyboard.press("x")
    assert page.inner_text("#compare-heard") == "You hear B."
    is_dry = f"({IS_DRY})()"
    page.wait_for_function(is_dry)
    page.wait_for_timeout(500)
    dry_db = level_db(listen(page))
    assert np.all(dry_db < wet_db - 6)
    # Two levels as well: a side that is heard changes at once, and the key goes to and fro.
    levels = [each.get_attribute("value") for each in page.locator("#compare-b option").all()]
    cheapest, best = levels[-2], page.input_value("#compare-a")
    page.select_option("#compare-b", cheapest)
    page.wait_for_function(f"nafir.state().level === '{cheapest}'")
    page.keyboard.press("x")
    page.wait_for_function(f"nafir.state().level === '{best}'")
    page.keyboard.press("x")
    page.wait_for_function(f"nafir.state().level === '{cheapest}'")
    page.click("#compare-stop")
    page.wait_for_function(f"!({is_dry})")
    assert page.inner_text("#compare-heard") == ""
    assert not page.locator("#compare-stop").is_visible()


@pytest.mark.parametrize(
    ("angles", "heading_deg"),
    [
        ((0, 0, 0), 90),  # flat, its top to the north
        ((90, 0, 0), 180),
        ((0, 90, 0), 90),  # upright, its back to the north
        ((90, 90, 0), 180),
        ((0, 45, 0), 90),
        ((0, 0, -90), 90 - 45),  # on its side: the top to the north, the back to the east
        ((-30, 60, 0), 60),
    ],
)
def test_the_heading_of_a_phone_is_where_its_top_and_its_back_point(one_page, angles, heading_deg):
    alpha, beta, gamma = angles
    heading = one_page.evaluate(
        "async (angles) => (await import('./phone.js')).headingOf(angles)",
        {"alpha": alpha, "beta": beta, "gamma": gamma},
    )
    assert math.degrees(heading) == pytest.approx(heading_deg, abs=1e-6)


def test_the_listener_turns_as_the_phone_does(browser, server):
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page = open_page(context, server)
    sensors = context.new_cdp_session(page)

    def hold(alpha: float) -> None:
        sensors.send("DeviceOrientation.setDeviceOrientationOverride", {"alpha": alpha, "beta": 40, "gamma": 0})

    hold(10)
    page.evaluate("nafir.setListener({ yaw: 1 })")
    page.click("#phone")
    page.locator("#phone[aria-pressed=true]").wait_for()
    page.wait_for_timeout(300)
    hold(40)
    page.wait_for_function(f"Math.abs(nafir.state().listener.yaw - {1 + math.radians(30)}) < 0.01")
    page.click("#phone")
    hold(100)
    page.wait_for_timeout(300)
    assert page.evaluate("nafir.state().listener.yaw") == pytest.approx(1 + math.radians(30), abs=0.01)
    context.close()


def test_a_computer_is_not_offered_to_be_turned(page):
    assert not page.locator("#phone").is_visible()
