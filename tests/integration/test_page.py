"""The page in a real browser against a real server: what a visitor does, and what then comes out of the loudspeakers.

Levels are in decibels relative to full scale; angles in radians.
"""

import math

import numpy as np
import pytest

from tests import visitor
from tests.visitor import LISTENING_S, free_port, level_db, listen, open_page, passing_on, start

browser = visitor.browser
page = visitor.page
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

WALKED = """([x, y]) => {
  const [nowX, nowY] = nafir.state().listener.position;
  return Math.hypot(nowX - x, nowY - y) > 0.05;
}"""


def test_sound_arrives_and_its_latency_is_measured(page):
    start(page)
    heard = listen(page)
    assert heard.shape == (2, LISTENING_S * page.evaluate("nafir.state().sampleRate"))
    assert np.all(level_db(heard) > -70)
    assert np.all(np.abs(heard) < 4)

    page.evaluate("nafir.setListener({ yaw: 0.5 })")
    page.wait_for_function("/^[0-9]+$/.test(document.getElementById('latency').textContent)")
    latency = page.evaluate("nafir.state().latency")
    assert 10 < latency["totalMs"] < 1000
    parts = [latency[part] for part in ("serverMs", "bufferMs", "outputMs")]
    assert min(parts) >= 0
    assert sum(parts) == pytest.approx(latency["totalMs"], abs=0.1)
    # What follows the direct sound waits for the field besides.
    page.wait_for_function("/^[0-9]+ ms$/.test(document.getElementById('latency-reverberation').textContent)")
    assert page.evaluate("nafir.state().reverberationLatency.totalMs") >= latency["totalMs"] - 20


def test_turning_the_head_around_swaps_the_louder_ear(page):
    page.evaluate("nafir.setEmitter('A', { x: 3.2, y: 2.5 })")
    page.evaluate("nafir.setListener({ x: 2.0, y: 2.5, yaw: -Math.PI / 2 })")
    start(page)
    page.wait_for_timeout(500)
    left, right = level_db(listen(page))
    assert left > right + 1
    page.evaluate("nafir.setListener({ yaw: Math.PI / 2 })")
    page.wait_for_timeout(500)
    left, right = level_db(listen(page))
    assert right > left + 1


def play_trumpet(page) -> float:
    """How long a turn of its clip takes: over a whole one, the level is the room's and not that of the passage."""
    page.select_option("[data-source=A] select", "trumpet")
    clips = page.evaluate("fetch('v1/clips').then((response) => response.json())")["clips"]
    return next(clip["duration_s"] for clip in clips if clip["name"] == "trumpet")


def test_walking_away_makes_it_quieter(page):
    turn_s = play_trumpet(page)
    page.evaluate("nafir.setEmitter('A', { x: 1.2, y: 3.8 })")
    page.evaluate("nafir.setListener({ x: 2.0, y: 3.2, yaw: 2.5 })")
    start(page)
    page.wait_for_timeout(500)
    near = level_db(listen(page, seconds=turn_s)).mean()
    page.evaluate("nafir.setListener({ x: 7.2, y: 0.8 })")
    page.wait_for_timeout(500)
    far = level_db(listen(page, seconds=turn_s)).mean()
    assert far < near - 5


def test_the_gain_of_a_source_is_heard(page):
    turn_s = play_trumpet(page)
    page.evaluate("nafir.setEmitter('A', { x: 2.2, y: 2.8 })")
    start(page)
    page.wait_for_timeout(500)
    before = level_db(listen(page, seconds=turn_s)).mean()
    page.fill("[data-source=A] .gain", "-20")
    page.wait_for_timeout(500)
    after = level_db(listen(page, seconds=turn_s)).mean()
    assert after == pytest.approx(before - 20, abs=4)


def test_pause_ends_the_stream_and_play_takes_it_up_again(page):
    start(page)
    page.click("#play")
    page.wait_for_function("document.getElementById('connection-text').textContent === 'Paused'")
    assert page.inner_text("#play") == "Play"
    start(page)
    assert np.all(level_db(listen(page)) > -70)


def test_dragging_and_keys_move_what_they_should(page):
    def centre(selector: str) -> tuple[float, float]:
        box = page.locator(selector).bounding_box()
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def drag(selector: str, dx: float, dy: float) -> None:
        x, y = centre(selector)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + dx / 2, y + dy / 2)
        page.mouse.move(x + dx, y + dy)
        page.mouse.up()

    before = page.evaluate("nafir.state()")
    drag(".face", -60, 40)
    after = page.evaluate("nafir.state()")
    dx, dy = np.subtract(after["listener"]["position"], before["listener"]["position"])[:2]
    assert dx < -0.2
    assert dy < -0.2  # down the screen is south
    assert after["listener"]["yaw"] == before["listener"]["yaw"]

    x, y = centre(".face")
    handle_x, handle_y = centre(".knob")
    drag(".knob", x - handle_x, y - 80 - handle_y)
    assert page.evaluate("nafir.state().listener.yaw") == pytest.approx(math.pi / 2, abs=0.15)

    # Behind everything else.
    with page.expect_response(lambda response: "/loudness" in response.url, timeout=120_000) as mapped:
        drag("[data-emitter=A] .disc", 30, 30)
    assert mapped.value.ok

    # Keys move for as long as they are held.
    yaw = page.evaluate("nafir.state().listener.yaw")
    page.keyboard.down("ArrowLeft")
    page.wait_for_function("yaw => nafir.state().listener.yaw - yaw > 0.05", arg=yaw)
    page.keyboard.up("ArrowLeft")
    (x, y, _), turned = page.evaluate("[nafir.state().listener.position, nafir.state().listener.yaw]")
    page.keyboard.down("KeyS")
    page.wait_for_function(WALKED, arg=[x, y])
    page.keyboard.up("KeyS")
    walked = page.evaluate("nafir.state().listener")
    page.wait_for_timeout(100)
    assert page.evaluate("nafir.state().listener") == walked
    assert walked["yaw"] == turned


def test_nobody_walks_through_walls(page):
    page.evaluate("nafir.setListener({ x: 3.0, y: 1.0, yaw: 0 })")
    page.keyboard.down("Shift")
    page.keyboard.down("KeyW")
    page.wait_for_function("nafir.state().listener.position[0] > 3.3")
    page.wait_for_timeout(500)
    page.keyboard.up("KeyW")
    page.keyboard.up("Shift")
    x, y, _ = page.evaluate("nafir.state().listener.position")
    assert x < 4.0
    assert y == pytest.approx(1.0)


def test_a_second_source_is_heard_too(page):
    start(page)
    page.click("#add-source")
    assert len(page.evaluate("nafir.state().emitters")) == 2
    assert page.locator("#sources li").count() == 2
    page.click("[data-source=A] .remove")
    page.evaluate("nafir.setListener({ yaw: 1 })")
    page.wait_for_timeout(500)
    assert np.all(level_db(listen(page)) > -70)


def test_an_error_of_the_server_is_shown_and_the_stream_goes_on(browser, server):
    context = browser.new_context()
    context.route(
        "**/v1/clips", lambda route: route.fulfill(json={"clips": [{"name": "no-such-clip", "title": "None"}]})
    )
    page = open_page(context, server)
    page.click("#play")
    notice = page.locator(".notice")
    notice.wait_for()
    assert "no-such-clip" in notice.inner_text()
    assert page.evaluate("nafir.state().connection") == "live"
    notice.get_by_role("button").click()
    assert notice.count() == 0
    context.close()


def test_a_lost_connection_is_taken_up_again(browser, server):
    port = free_port()
    context = browser.new_context()
    with passing_on(port, server) as url:
        page = open_page(context, url)
        start(page)
        page.wait_for_function("nafir.state().effects !== null")
        page.wait_for_function("document.getElementById('buffer').textContent !== '–'")
        assert set(page.locator("#effects .reason").all_inner_texts()) != {"–"}
    page.wait_for_function("nafir.state().connection === 'waiting'")
    for figure in ("latency", "latency-reverberation", "part-server", "buffer", "field-cost", "level", "effects-cost"):
        assert page.inner_text(f"#{figure}") == "–", figure
    assert page.locator(".meter output").all_inner_texts() == ["–", "–"]
    assert set(page.locator("#effects .reason").all_inner_texts()) == {"–"}
    assert "".join(page.locator("#effects .cost").all_inner_texts()) == ""
    with passing_on(port, server):
        page.wait_for_function("nafir.state().connection === 'live'")
        page.evaluate("nafir.setListener({ yaw: 1 })")
        assert np.all(level_db(listen(page)) > -70)
        context.close()
