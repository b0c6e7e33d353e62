"""The page in a real browser against a real server: what a visitor does, and what then comes out of the loudspeakers.

Levels are in decibels relative to full scale; angles in radians.
"""

import contextlib
import math
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest

from server.scene.bundle import BUNDLED, Bundle, bundled_scenes, write_bundle
from server.scene.manifest import Cost, FrontierPoint

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on the PATH (Debian: apt-get install chromium)"),
    pytest.mark.skipif(
        not any(folder.name == "apartment" for folder in bundled_scenes()), reason="the apartment is not bundled"
    ),
]

CHROMIUM_ARGUMENTS = ["--no-sandbox", "--autoplay-policy=no-user-gesture-required", "--disable-dev-shm-usage"]
LISTENING_S = 2.5


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def serving(port: int, *options: str) -> Iterator[str]:
    """A server of its own process, ready to stream."""
    command = [sys.executable, "-c", "from server.cli import main; main()", "serve", "--port", str(port), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 180  # the first time ever, everything is compiled
        while True:
            assert process.poll() is None, "the server ended before it was ready"
            assert time.monotonic() < deadline, "the server was not ready within three minutes"
            with contextlib.suppress(urllib.error.URLError, ConnectionError):
                urllib.request.urlopen(f"{url}/readyz", timeout=5).close()
                break
            time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(timeout=20)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with serving(free_port()) as url:
        yield url


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=CHROMIUM_ARGUMENTS)
        yield browser
        browser.close()


def open_page(context, url: str):
    page = context.new_page()
    page.goto(url)
    page.evaluate("nafir.ready")
    return page


@pytest.fixture
def page(browser, server):
    """The page, loaded; fails a test that leaves an error in the console."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    complaints: list[str] = []
    context.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    context.on("weberror", lambda error: complaints.append(str(error.error)))
    yield open_page(context, server)
    context.close()
    assert complaints == []


def start(page) -> None:
    page.click("#play")
    page.wait_for_function("nafir.state().connection === 'live' && nafir.state().poses.heard >= 0", timeout=20_000)


def listen(page, *, seconds: float = LISTENING_S) -> np.ndarray:
    """(2, n): what is played in the seconds to come."""
    page.wait_for_timeout(1000 * seconds)
    ears = page.evaluate(
        "seconds => nafir.capture(seconds).then(({ left, right }) => [left, right].map((ear) => Array.from(ear)))",
        seconds,
    )
    return np.asarray(ears, np.float64)


def level_db(samples: np.ndarray) -> np.ndarray:
    """(2,) RMS of each ear."""
    return 10 * np.log10(np.mean(samples**2, axis=-1) + 1e-20)


def test_sound_arrives_and_its_latency_is_measured(page):
    start(page)
    heard = listen(page)
    assert heard.shape == (2, LISTENING_S * 24_000)
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

    with page.expect_response(lambda response: "/loudness" in response.url) as mapped:
        drag("[data-emitter=A] .disc", 30, 30)
    assert mapped.value.ok

    yaw = page.evaluate("nafir.state().listener.yaw")
    page.keyboard.down("ArrowLeft")
    page.wait_for_timeout(200)
    page.keyboard.up("ArrowLeft")
    assert 0.05 < page.evaluate("nafir.state().listener.yaw") - yaw < 1.5
    position = page.evaluate("nafir.state().listener.position")
    page.keyboard.down("KeyS")
    page.wait_for_timeout(200)
    page.keyboard.up("KeyS")
    assert 0.05 < math.dist(page.evaluate("nafir.state().listener.position"), position) < 1


def test_nobody_walks_through_walls(page):
    page.evaluate("nafir.setListener({ x: 3.0, y: 1.0, yaw: 0 })")
    page.keyboard.down("Shift")
    page.keyboard.down("KeyW")
    page.wait_for_timeout(900)
    page.keyboard.up("KeyW")
    page.keyboard.up("Shift")
    x, y, _ = page.evaluate("nafir.state().listener.position")
    assert 3.3 < x < 4.0
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


def test_a_lost_connection_is_taken_up_again(browser):
    port = free_port()
    context = browser.new_context()
    with serving(port) as url:
        page = open_page(context, url)
        start(page)
    page.wait_for_function("nafir.state().connection === 'waiting'")
    with serving(port):
        page.wait_for_function("nafir.state().connection === 'live'", timeout=20_000)
        page.evaluate("nafir.setListener({ yaw: 1 })")
        assert np.all(level_db(listen(page)) > -70)
        context.close()


@pytest.mark.parametrize("width", [360, 820, 1280])
def test_nothing_is_cut_off(browser, server, width):
    context = browser.new_context(viewport={"width": width, "height": 800})
    page = open_page(context, server)
    assert page.evaluate("document.scrollingElement.scrollWidth") <= width
    cut_off = page.evaluate(
        """() => [...document.querySelectorAll("h1, h2, #scene-name, button, dt, dd, .hint, figcaption, output")]
            .filter((node) => node.offsetParent && node.scrollWidth > node.clientWidth + 1 && node.clientWidth > 0)
            .map((node) => node.textContent.trim())"""
    )
    assert cut_off == []
    assert re.fullmatch(r".+ · Nafir", page.title())
    context.close()


# What the player's buffer promises, on a simulated clock: blocks of 256 come in, quanta of 128 go out, at 24 kHz.
SIMULATE = """async ({ seconds, skew, delays }) => {
  const { JitterBuffer } = await import(new URL("jitterbuffer.js", document.baseURI));
  const rate = 24_000;
  const buffer = new JitterBuffer({ sampleRate: rate });
  const tone = (n) => 0.5 * Math.sin((2 * Math.PI * 220 * n) / rate);
  const played = [];
  const heard = [];
  const fills = [];
  const underruns = [];
  let sent = 0;
  for (let now = 0; now < seconds * rate; now += 128) {
    // The sender's clock runs `skew` fast; a block leaves when it is whole and comes in order after its delay.
    for (;;) {
      const delay = delays.length ? delays[(sent / 256) % delays.length] : 0;
      if ((sent + 256) / (1 + skew) + delay * rate > now) break;
      const left = Float32Array.from({ length: 256 }, (_, i) => tone(sent + i));
      buffer.push({ left, right: left.map((value) => -value), sampleClock: sent, poseId: sent / 256, late: false });
      sent += 256;
    }
    const left = new Float32Array(128);
    const right = new Float32Array(128);
    for (const { poseId, offset } of buffer.pull(left, right)) heard.push([poseId, played.length + offset]);
    played.push(...left);
    fills.push(buffer.fill / rate);
    underruns.push(buffer.counters.underruns);
  }
  let steepest = 0;
  for (let i = 1; i < played.length; i++) steepest = Math.max(steepest, Math.abs(played[i] - played[i - 1]));
  return { played: played.slice(0, 3 * rate), heard, fills, underruns, steepest, counters: buffer.counters };
}"""


def tone(samples: np.ndarray) -> np.ndarray:
    return 0.5 * np.sin(2 * np.pi * 220 * samples / 24_000)


STEEPEST_TONE = 0.5 * 2 * math.pi * 220 / 24_000


def test_on_a_steady_network_the_buffer_plays_every_sample_unchanged(page):
    run = page.evaluate(SIMULATE, {"seconds": 30, "skew": 0, "delays": []})
    assert run["counters"]["underruns"] == run["counters"]["splices"] == 0
    # Pose n is heard with the first sample of block n, and so says where in the tone the output is.
    pose, at = run["heard"][-1]
    delay = at - 256 * pose
    assert 0.05 < delay / 24_000 < 0.1
    assert all(at - 256 * pose == delay for pose, at in run["heard"][1:])
    played = np.asarray(run["played"])
    first = np.flatnonzero(played)[0] + 64  # past the fade-in
    np.testing.assert_allclose(played[first:], tone(np.arange(first, len(played)) - delay), atol=1e-7)


@pytest.mark.parametrize("skew", [1e-3, -1e-3])
def test_clock_drift_is_absorbed_without_dropouts_or_clicks(page, skew):
    run = page.evaluate(SIMULATE, {"seconds": 50, "skew": skew, "delays": []})
    assert run["counters"]["underruns"] == run["counters"]["gaps"] == run["counters"]["overflows"] == 0
    assert run["counters"]["splices"] > 0
    assert max(run["fills"][-2000:]) < 0.1
    assert run["steepest"] < 1.5 * STEEPEST_TONE


def test_after_a_few_dropouts_the_buffer_outgrows_the_jitter(page):
    delays = [0.0] * 40 + [0.11] + [0.0] * 52
    run = page.evaluate(SIMULATE, {"seconds": 40, "skew": 0, "delays": delays})
    assert run["underruns"][-1] == run["underruns"][len(run["underruns"]) // 4] <= 5
    assert run["steepest"] < 1.5 * STEEPEST_TONE


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
    measured = FrontierPoint(level=level("near", 0.9, 1.05), architecture="factorised")
    manifest = apartment.manifest.model_copy(update={"levels": levels, "frontier": (measured,)})
    files = {name: (apartment.folder / name).read_bytes() for name in manifest.files}
    folder = tmp_path_factory.mktemp("scenes") / "apartment"
    write_bundle(folder, manifest, files)
    with serving(free_port(), "--bundle", str(folder)) as url:
        yield url


@pytest.mark.parametrize("width", [1280, 390])
def test_the_frontier_is_shown_and_levels_are_chosen_while_listening(browser, several_levels, width):
    context = browser.new_context(viewport={"width": width, "height": 800})
    page = open_page(context, several_levels)
    marks = page.locator("#frontier .level")
    assert [mark.get_attribute("data-level") for mark in marks.all()] == ["quick", "standard", "fine"]
    boxes = [mark.locator(".dot").bounding_box() for mark in marks.all()]
    assert boxes[0]["x"] < boxes[1]["x"] < boxes[2]["x"], "costlier is further right"
    assert boxes[0]["y"] < boxes[1]["y"] < boxes[2]["y"], "more accurate is lower"
    assert page.locator("#frontier .heard").count() == 0
    (measured,) = page.locator("#frontier .measured").all()
    assert measured.get_attribute("data-level") == "near"
    assert boxes[0]["x"] < measured.locator(".dot").bounding_box()["x"] < boxes[1]["x"]
    options = page.locator("#level-choice option").all_inner_texts()
    assert [option.split(",")[0] for option in options] == ["Automatic", "fine", "standard", "quick"]

    start(page)
    page.wait_for_function("nafir.state().level !== null")
    page.select_option("#level-choice", "quick")
    page.wait_for_function("nafir.state().level === 'quick'")
    assert page.inner_text("#level") == "quick"
    assert page.locator("#frontier .heard").get_attribute("data-level") == "quick"
    assert re.search(r"^\d\d:\d\d:\d\d ?quick.*: as you chose$", page.inner_text("#level-changes"), re.MULTILINE)
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


@pytest.mark.parametrize("width", [1280, 390])
def test_what_is_rendered_is_shown_with_reasons_and_can_be_switched(browser, server, width):
    context = browser.new_context(viewport={"width": width, "height": 900})
    page = open_page(context, server)
    assert page.locator("#effects .effect").count() == 0
    start(page)
    page.wait_for_function("nafir.state().effects !== null")
    rows = page.locator("#effects .effect")
    names = {row.get_attribute("data-effect") for row in rows.all()}
    assert {"direct_path", "late_reverberation", "hrtf", "propagation_delay"} <= names
    assert all(row.locator(".reason").inner_text() for row in rows.all())

    late = page.locator("#effects [data-effect=late_reverberation]")
    assert late.locator("input").is_checked()
    late.locator("input").click()
    page.wait_for_function(
        "nafir.state().effects.decisions.some((d) => d.name === 'late_reverberation' && !d.called_for && d.overridden)"
    )
    assert not late.locator("input").is_checked()
    late.locator(".undo").click()
    page.wait_for_function(
        "nafir.state().effects.decisions.every((d) => d.name !== 'late_reverberation' || d.called_for)"
    )
    assert late.locator(".undo").is_hidden()

    # One loudspeaker: both channels alike, and no head.
    page.select_option("#output", "mono")
    page.wait_for_function("nafir.state().effects.decisions.some((d) => d.name === 'hrtf' && !d.called_for)")
    # Responses for one ear come when there is time for them, and what was heard through the head before rings out.
    for _ in range(40):
        heard = listen(page, seconds=0.5)
        if np.abs(heard[0] - heard[1]).max() < 1e-3:
            break
    else:
        pytest.fail("two ears still hear two things")
    assert np.all(level_db(heard) > -70)
    box, rail = page.locator("#effects").bounding_box(), page.locator("#rendered").bounding_box()
    assert rail["x"] <= box["x"]
    assert box["x"] + box["width"] <= rail["x"] + rail["width"]
    context.close()
