"""Quality levels on the page: the frontier is a picture to choose from while one listens."""

import re
import time
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest

from server.api.api_keys import create_key
from server.scene.bundle import BUNDLED, Bundle, write_bundle
from server.scene.manifest import Cost, FrontierPoint
from tests import visitor
from tests.visitor import free_port, level_db, listen, open_page, passing_on, serving, start

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]


@pytest.fixture(scope="module")
def several_levels(tmp_path_factory) -> Iterator[str]:
    """A server of the apartment at three quality levels, with figures as if they had been measured."""
    apartment = Bundle.load(BUNDLED / "apartment")
    (standard, *_) = apartment.manifest.levels

    def level(name: str, ms: float, worse: float, **changes):
        assert standard.accuracy is not None
        errors = {metric: worse * error for metric, error in standard.accuracy.errors.items()}
        cost = Cost(ms_p50=ms, ms_p99=2 * ms, storage_mb=1.0, memory_mb=1.0, host="elsewhere")
        accuracy = standard.accuracy.model_copy(update={"errors": errors})
        return standard.model_copy(update={"name": name, "accuracy": accuracy, "cost": cost, **changes})

    levels = (level("standard", 1.0, 1.0), level("fine", 40.0, 0.9), level("quick", 0.1, 1.5, ir_rate_hz=20.0))
    near = FrontierPoint(level=level("near", 0.9, 1.05), architecture="factorised")
    bus = FrontierPoint(level=level("bus", 1.4, 1.3, bus=1), architecture="directional")
    manifest = apartment.manifest.model_copy(update={"levels": levels, "frontier": (near, bus)})
    files = {name: (apartment.folder / name).read_bytes() for name in manifest.files}
    folder = tmp_path_factory.mktemp("scenes") / "apartment"
    write_bundle(folder, manifest, files)
    with serving(free_port(), "--bundle", str(folder), scenes=(), costs_after_s=5.0) as url:
        yield url


@pytest.mark.parametrize("width", [1280, pytest.param(390, marks=pytest.mark.long)])
def test_the_frontier_is_shown_and_levels_are_chosen_while_listening(browser, several_levels, width):
    context = browser.new_context(viewport={"width": width, "height": 800})
    page = open_page(context, several_levels)
    marks = page.locator("#frontier .level")
    marks.first.wait_for(state="attached")
    assert [mark.get_attribute("data-level") for mark in marks.all()] == ["quick", "standard", "fine"]
    boxes = [mark.locator(".dot").bounding_box() for mark in marks.all()]
    assert boxes[0]["x"] < boxes[1]["x"] < boxes[2]["x"], "costlier is further right"
    assert boxes[0]["y"] < boxes[1]["y"] < boxes[2]["y"], "more accurate is lower"
    assert page.locator("#frontier .heard").count() == 0
    near, bus = page.locator("#frontier .measured").all()
    assert [near.get_attribute("data-level"), bus.get_attribute("data-level")] == ["near", "bus"]
    assert boxes[0]["x"] < near.locator(".dot").bounding_box()["x"] < boxes[1]["x"]
    options = page.locator("#level-choice option").all()
    plain = ["Automatic", "In this browser", "Full, fine", "Full, standard", "At most 20 responses a second"]
    shown = [option.inner_text() for option in options]
    assert [re.sub(", [^ ]+ ms$", "", text) for text in shown] == plain
    assert [option.get_attribute("title") for option in options] == [None, None, "fine", "standard", "quick"]
    titles = page.locator("#frontier title").all_text_contents()
    assert any(title.startswith("At most 20 responses a second (quick): error") for title in titles)

    start(page)
    page.wait_for_function("nafir.state().level !== null")
    # A busy server may be at that level already, or leave it: then nothing changes, or other messages take its place.
    changes = page.locator("#level-changes li", has_text="as you chose")
    for _ in range(5):
        page.select_option("#level-choice", "fine")
        page.wait_for_function("nafir.state().level === 'fine'")
        page.select_option("#level-choice", "quick")
        page.wait_for_function("nafir.state().level === 'quick'")
        change = changes.filter(has_text="At most 20")
        if change.count():
            break
    assert page.inner_text("#level") == "At most 20 responses a second"
    assert page.get_attribute("#level", "title") == "quick"
    assert page.locator("#frontier .heard").get_attribute("data-level") == "quick"
    assert re.fullmatch(r"\d\d:\d\d:\d\d ?At most 20 responses a second.*: as you chose", change.first.inner_text())
    assert change.first.get_attribute("title") == "quick"
    page.locator("#frontier [data-level=fine] .touch").click()
    page.wait_for_function("nafir.state().level === 'fine'")
    assert page.input_value("#level-choice") == "fine"
    assert np.all(level_db(listen(page)) > -70)
    chart, rail = page.locator("#frontier").bounding_box(), page.locator("#quality").bounding_box()
    assert rail["x"] <= chart["x"]
    assert chart["x"] + chart["width"] <= rail["x"] + rail["width"]

    # A stream that begins anew begins with what was chosen.
    page.click("#play")
    page.wait_for_function("nafir.state().level === null")
    start(page)
    page.wait_for_function("nafir.state().level === 'fine'")
    context.close()


FOLLOW_CONNECTION = """() => {
  const shown = document.getElementById("connection");
  window.followed = [shown.dataset.state];
  new MutationObserver(() => shown.dataset.state !== followed.at(-1) && followed.push(shown.dataset.state))
    .observe(shown, { attributes: true });
}"""


def test_a_scene_is_rendered_in_the_browser_as_one_more_level(browser, several_levels):
    def wait_for_streams(wanted: int) -> None:  # those of pages that have gone end in their time
        for _ in range(100):
            metrics = urllib.request.urlopen(f"{several_levels}/metrics", timeout=10).read().decode()
            counts = re.findall(r"^nafir_streams\{.*\} ([0-9.]+)$", metrics, re.MULTILINE)
            if sum(map(float, counts)) == wanted:
                return
            time.sleep(0.1)
        raise AssertionError(counts)

    context = browser.new_context(viewport={"width": 1280, "height": 900})
    complaints: list[str] = []
    context.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    page = open_page(context, several_levels)
    start(page)
    page.select_option("#turning", "server")
    page.wait_for_function("nafir.state().output === 'headphones' && nafir.state().latency !== null")
    page.wait_for_function("nafir.state().connection === 'live'")
    page.evaluate(FOLLOW_CONNECTION)
    page.select_option("#level-choice", "in-this-browser")
    page.wait_for_function("nafir.state().level === 'in-this-browser'")
    page.wait_for_function("nafir.state().latency !== null")
    # The server was heard until the browser's own stream was there, which was rendered in time from its beginning.
    assert page.evaluate("followed") == ["live"]
    assert page.evaluate("nafir.state().playing")
    assert page.inner_text("#level") == "In this browser"
    page.wait_for_function("document.getElementById('field-cost').textContent.endsWith(' ms')")
    # It errs as much as a bus of first order, at its own cost.
    here, bus = (page.locator(f"#frontier [data-level={name}]") for name in ("in-this-browser", "bus"))
    assert "heard" in here.get_attribute("class")
    assert here.locator(".dot").get_attribute("cy") == bus.locator(".dot").get_attribute("cy")
    error = re.match(r".*: (error [0-9.]+ JND)", bus.locator("title").text_content())[1]
    assert re.fullmatch(
        rf"In this browser: {error}, [0-9.]+ ms a response, measured here", here.locator("title").text_content()
    )
    assert re.fullmatch(r"[0-9.]+\sms\shere", page.inner_text("#level-note"))
    assert page.inner_text("#part-server-name") == "This browser"
    turning = page.locator("#turning")
    assert turning.input_value() == "browser"
    assert turning.is_disabled()
    assert turning.get_attribute("title") == "What is rendered in this browser is turned in it."
    assert level_db(listen(page)).max() > -60
    # A step is heard, without the server.
    page.evaluate("nafir.setListener({ x: 2.6 })")
    state = page.evaluate("nafir.state()")
    assert (state["connection"], state["output"], state["effects"]) == ("live", "ambisonics", None)
    wait_for_streams(0)

    page.select_option("#level-choice", "standard")
    page.wait_for_function("nafir.state().level === 'standard'")
    assert page.evaluate("followed") == ["live"]
    assert turning.is_enabled()
    assert turning.input_value() == "server"
    assert page.inner_text("#part-server-name") == "Server and network"
    assert page.locator("#frontier .in-browser.heard").count() == 0
    here.locator(".touch").click()
    page.wait_for_function("nafir.state().level === 'in-this-browser'")
    page.select_option("#level-choice", "standard")
    page.wait_for_function("nafir.state().level === 'standard'")
    wait_for_streams(1)
    assert level_db(listen(page)).max() > -60
    assert complaints == []
    context.close()


def test_a_change_to_the_server_says_what_it_waits_for(browser, several_levels, bundle, tmp_path):
    """A server that is away, then one that asks for a key and lacks the level, and then the first again."""
    port, keys = free_port(), tmp_path / "keys.json"
    key, _ = create_key(keys, "", ["listen", "render"], None)
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    notice = "[...document.querySelectorAll('.notice p')].some((each) => each.textContent.includes('%s'))"
    with passing_on(port, several_levels) as url:
        page = open_page(context, url)
        start(page)
        page.select_option("#level-choice", "in-this-browser")
        page.wait_for_function("nafir.state().level === 'in-this-browser'")

    page.select_option("#level-choice", "standard")
    page.wait_for_function(notice % "cannot be reached. Trying again. What you hear goes on")
    assert page.evaluate("nafir.state().connection") == "live"
    page.select_option("#level-choice", "in-this-browser")
    page.wait_for_function(f"!{notice % 'cannot be reached'}")

    other = serving(free_port(), "--bundle", str(bundle.folder), settings={"NAFIR_KEYS_FILE": str(keys)})
    with other as url, passing_on(port, url):
        page.select_option("#level-choice", "standard")
        page.wait_for_selector("#key[open]")
        page.fill("#key-field", key)
        page.keyboard.press("Enter")
        page.wait_for_function(notice % "is none of auto")
        page.wait_for_function("document.getElementById('level-choice').value === 'in-this-browser'")
        state = page.evaluate("nafir.state()")
        assert (state["connection"], state["playing"], state["level"]) == ("live", True, "in-this-browser")

    page.select_option("#level-choice", "standard")
    page.wait_for_function(notice % "cannot be reached")
    with passing_on(port, several_levels):
        page.wait_for_function("nafir.state().level === 'standard'")
        assert not page.evaluate(notice % "goes on")
        context.close()
