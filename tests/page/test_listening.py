"""Listening tests in a browser, by listeners whose answers are known and who use the keyboard alone."""

import contextlib
import csv
import json
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

from server.listening.analysis import analyse
from server.listening.answers import AnswerFile
from server.listening.design import REFERENCE
from server.listening.plan import ANTIPHASE, QUIET, ListenerPlan
from tests import visitor
from tests.listening.listeners import CODED, FIELD, RATED, choices, design_of, ratings, write_test
from tests.page.test_access import faint_texts
from tests.visitor import free_port

browser = visitor.browser
pytestmark = visitor.needs_browser

PLACES = 6
UNLIKE = 2
"""The place at which the planted preference is for the other method."""


@contextlib.contextmanager
def served(test):
    """The page of a test, from a process of its own."""
    port = free_port()
    program = "from server.cli.main import main; main()"
    command = [sys.executable, "-c", program, "listening-test", str(test.folder), "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        while True:
            assert process.poll() is None, "the server ended"
            with contextlib.suppress(urllib.error.URLError, ConnectionError, TimeoutError):
                urllib.request.urlopen(f"{url}/v1/test", timeout=5).close()
                break
            time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(timeout=60)


@pytest.fixture(scope="module")
def duel(tmp_path_factory):
    """A test by choice, and its address."""
    trials = choices(PLACES, anchors=4, hidden=1)
    test = write_test(tmp_path_factory.mktemp("duel") / "test", design_of(places=PLACES, trials=trials))
    with served(test) as url:
        yield test, url


@pytest.fixture
def page(browser, duel):
    with visited(browser, duel[1]) as page:
        yield page


@contextlib.contextmanager
def visited(browser, url, **options):
    """The page; fails if an error was left in the console, but for a server that was not reached or did not know a
    code."""
    context = browser.new_context(viewport={"width": 1000, "height": 850}, **options)
    complaints = []
    context.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    page = context.new_page()
    page.goto(url)
    page.wait_for_selector("#begin")
    yield page
    context.close()
    assert [each for each in complaints if "ERR_FAILED" not in each and "status of 404" not in each] == []


def tab_to(page, selector):
    """Presses Tab until an element has the focus."""
    for _ in range(30):
        if page.evaluate("selector => document.activeElement.matches(selector)", selector):
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"Tab does not reach {selector}")


def begin(page):
    """From the welcome to the first question."""
    tab_to(page, "#begin")
    page.keyboard.press("Enter")
    set_volume(page)


def set_volume(page):
    page.wait_for_selector(".play:enabled")
    tab_to(page, "#set")
    page.keyboard.press("Enter")
    page.wait_for_selector(".sound:enabled")


def plan_of(page, test):
    code = page.inner_text("#footnote code")
    return ListenerPlan.read(test.results / f"{code}.json")


def answered(page, test):
    plan = plan_of(page, test)
    return AnswerFile(test.results / f"{plan.code}.csv", plan).read()


def hear(page, keys):
    """Plays each sound to its end, or a second of it."""
    for key in keys:
        page.keyboard.press(key)
        page.wait_for_selector(f".sound.heard:has(kbd:text-is('{key.upper()}'))")


def go_on(page):
    """Sends the answer and waits for the next question, through what is told after practice."""
    trial = page.get_attribute("main", "data-trial")
    page.keyboard.press("Enter")
    moved = "trial => document.querySelector('main').dataset.trial !== trial"
    ended = "document.querySelector('main').dataset.view === 'end'"
    told = "!!document.querySelector('.told')?.textContent"
    page.wait_for_function(f"trial => ({moved})(trial) || {ended} || {told}", arg=trial)
    if page.locator(".told:not(:empty)").count():
        page.keyboard.press("Enter")
        page.wait_for_function(moved, arg=trial)
    if page.get_attribute("main", "data-view") != "end":
        page.wait_for_selector(".sound:enabled")


def choose(page, test, method_of):
    """Answers the question on the page with the method that the listener would choose."""
    number = int(page.get_attribute("main", "data-trial"))
    trial = plan_of(page, test).trials[number]
    method = method_of(trial)
    slot = next(slot for slot, each in trial.slots.items() if each == method)
    if trial.place is None:
        hear(page, "p")
        page.keyboard.press(slot)
    else:
        hear(page, "rab")
        page.keyboard.press("ArrowLeft" if slot == "a" else "ArrowRight")
    go_on(page)


def planted(trial):
    methods = set(trial.slots.values())
    if trial.place is None:
        return QUIET
    if methods == {FIELD, CODED}:
        return CODED if trial.place == UNLIKE else FIELD
    return REFERENCE


def to_the_end(page, test, method_of=planted):
    while page.get_attribute("main", "data-view") != "end":
        choose(page, test, method_of)


def test_a_listener_with_a_keyboard_goes_to_the_end_and_the_preference_is_found_again(page, duel):
    test, _ = duel
    begin(page)
    assert page.inner_text(".where") == "Headphones: 1 of 6"
    code = page.inner_text("#footnote code")
    to_the_end(page, test)
    assert page.inner_text("h2") == "Thank you"
    with (test.results / f"{code}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["part"] for row in rows} == {"screening-1", "practice", "test", "hidden-reference", "anchor"}
    assert all(int(row["plays"]) >= 1 for row in rows)
    results = analyse(test)
    assert code not in {each.listener for each in results.excluded}
    (found,) = [each for each in results.comparisons if each.part == "test"]
    assert (found.first, found.second) == (FIELD, CODED)
    assert (found.result.count, found.result.trials) == (PLACES - 1, PLACES)
    (anchors,) = [each for each in results.comparisons if each.part == "anchor"]
    assert anchors.result.share == 1.0


def test_a_listener_who_leaves_goes_on_with_the_code(browser, duel):
    test, url = duel
    with visited(browser, url) as page:
        begin(page)
        for _ in range(7):
            choose(page, test, planted)
        code, where = page.inner_text("#footnote code"), page.inner_text(".where")
        assert where == f"Question 1 of {len(test.design.trials) - 1}"
        page.reload()
        page.wait_for_selector("#resume:visible")
        tab_to(page, "#resume")
        page.keyboard.press("Enter")
        set_volume(page)
        assert (page.inner_text("#footnote code"), page.inner_text(".where")) == (code, where)
    with visited(browser, url) as page:
        page.click("summary")
        page.fill("#code", "nosuchcode")
        page.keyboard.press("Enter")
        page.wait_for_selector(".with-code .problem:not(:empty)")
        page.fill("#code", f" {code.upper()} ")
        page.keyboard.press("Enter")
        set_volume(page)
        assert page.inner_text(".where") == where


def test_answers_wait_for_a_network_that_fails_and_none_is_lost_or_stored_twice(page, duel):
    test, _ = duel
    begin(page)
    choose(page, test, planted)
    page.route("**/answer", lambda route: route.abort())
    hear(page, "p")
    trial = plan_of(page, test).trials[int(page.get_attribute("main", "data-trial"))]
    page.keyboard.press(next(slot for slot, each in trial.slots.items() if each == QUIET))
    page.keyboard.press("Enter")
    page.wait_for_selector(".notice:has-text('Nothing is lost')")
    assert page.get_attribute("#connection", "data-state") == "waiting"
    assert len(answered(page, test)) == 1
    page.unroute("**/answer")
    page.wait_for_function("document.querySelector('.where').textContent === 'Headphones: 3 of 6'")
    assert page.locator(".notice").count() == 0
    assert page.get_attribute("#connection", "data-state") == "live"
    assert [trial.chosen for trial in answered(page, test).values()] == [QUIET, QUIET]
    # The answer arrives, and the connection breaks before the page hears of it.
    page.route("**/answer", lambda route: (route.fetch(), route.abort()), times=1)
    page.wait_for_selector(".sound:enabled")
    choose(page, test, planted)
    assert page.inner_text(".where") == "Headphones: 4 of 6"
    assert len(answered(page, test)) == 3


@pytest.mark.long
def test_a_listener_at_loudspeakers_is_thanked_after_two_tries(page, duel):
    test, _ = duel
    begin(page)
    code = page.inner_text("#footnote code")
    for _ in range(6):
        choose(page, test, lambda _: ANTIPHASE)
    assert page.locator(".notice:has-text('try once more')").count() == 1
    to_the_end(page, test, lambda _: ANTIPHASE)
    assert page.inner_text("h2") == "Thank you for trying"
    (reason,) = [each.reason for each in analyse(test).excluded if each.listener == code]
    assert reason.startswith("no headphones")


def test_what_is_missing_is_said_and_nothing_is_sent(page, duel):
    test, _ = duel
    begin(page)
    page.keyboard.press("Enter")
    assert page.inner_text(".problem") == "Listen to Three tones first."
    hear(page, "p")
    page.keyboard.press("Enter")
    assert page.inner_text(".problem") == "Choose one. If you cannot tell, guess."
    assert answered(page, test) == {}


def test_controls_are_named_and_texts_stand_out(page, duel):
    test, _ = duel

    def require_contrast():
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme, reduced_motion="reduce")  # no colour is on its way
            assert faint_texts(page)[1] == {}

    require_contrast()
    begin(page)
    for _ in range(6):
        choose(page, test, planted)
    require_contrast()
    for name in ("Play Reference", "Play A", "Play B"):
        assert page.get_by_role("button", name=name, exact=True).count() == 1
    group = page.get_by_role("group", name="Nearer to the reference is")
    assert group.get_by_role("radio").count() == 2
    assert page.evaluate("document.activeElement.tagName") == "H2"
    page.set_viewport_size({"width": 360, "height": 700})
    assert page.evaluate("document.scrollingElement.scrollWidth") <= 360


@pytest.mark.long
def test_levels_are_rated_with_the_keyboard(browser, tmp_path):
    design = design_of("rating", places=1, screening=False, trials=ratings(1))
    test = write_test(tmp_path / "rating", design)
    steps = {name: number for number, name in enumerate(RATED)}
    with served(test) as url, visited(browser, url) as page:
        begin(page)
        while page.get_attribute("main", "data-view") != "end":
            trial = plan_of(page, test).trials[int(page.get_attribute("main", "data-trial"))]
            page.keyboard.press("Enter")
            assert page.inner_text(".problem").startswith("Listen to Reference, A")
            for slot, method in trial.slots.items():
                tab_to(page, f"li:has([data-slot='{slot}']) input")
                assert page.evaluate("document.activeElement.getAttribute('aria-valuetext')") == "not rated yet"
                page.keyboard.press("End" if method == REFERENCE else "Home")
                for _ in range(0 if method == REFERENCE else steps[method]):
                    page.keyboard.press("ArrowRight")
            hear(page, ["r", *trial.slots])
            go_on(page)
    (path,) = test.results.glob("*.csv")
    with path.open(newline="") as file:
        rated = {row["method"]: float(row["answer"]) for row in csv.DictReader(file) if row["answer"]}
    assert rated == {**steps, REFERENCE: 100}
    assert json.loads(analyse(test).model_dump_json())["counted"] == 1
