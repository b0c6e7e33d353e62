"""The package for JavaScript in a real browser, on a real server: as an AudioNode, in three.js and in React."""

import base64
import functools
import http.server
import shutil
import subprocess
import threading
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import soundfile

from server.field.fields_by_level import FieldsByLevel
from server.protocol.codecs import libopus
from server.streaming.doors import FollowedDoors
from tests import visitor
from tests.serving import serving
from tests.two_rooms import write_two_rooms

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

PACKAGE = Path(__file__).parents[2] / "client_examples" / "javascript"
needs_packages = pytest.mark.skipif(
    not (PACKAGE / "node_modules").exists(), reason="run npm install in client_examples/javascript"
)

RATE = 48_000

_CAPTURE = """async (seconds) => {
  const { left, right } = await nafir.capture(seconds);
  return [left, right].map((ear) => {
    const bytes = new Uint8Array(ear.buffer);
    let text = "";
    for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192));
    return btoa(text);
  });
}"""
_LOSSES = "[nafir.statistics.gaps, nafir.statistics.underruns]"


def listen(page, seconds: float = 1.0) -> np.ndarray:
    """(2, n) what is heard in the seconds to come. If blocks are missing then, as where other tests take the processor,
    what is heard after them."""
    for _ in range(10):
        before = page.evaluate(_LOSSES)
        page.wait_for_timeout(1000 * seconds)
        heard = heard_lately(page, seconds)
        if page.evaluate(_LOSSES) == before:
            break
    return heard


def heard_lately(page, seconds: float) -> np.ndarray:
    """(2, n) what was heard in the last seconds."""
    return np.array(
        [np.frombuffer(base64.b64decode(ear), np.float32) for ear in page.evaluate(_CAPTURE, seconds)], np.float64
    )


def empty_page(context, server: str):
    """A page of the server's own without anything in it, with the package as its users import it."""
    page = context.new_page()
    page.goto(f"{server}/icon.svg")
    page.evaluate("import('/nafir/index.js').then((module) => (window.package = module))")
    return page


@pytest.fixture
def page(browser, server) -> Iterator:
    context = browser.new_context()
    yield empty_page(context, server)
    context.close()


_CONNECT = """async (options) => {
  window.context = new AudioContext({ sampleRate: 48000 });
  window.nafir = await package.connect(context, location.origin, options);
  nafir.output.connect(context.destination);
  window.refusals = [];
  nafir.addEventListener("refused", ({ detail }) => refusals.push(detail.code));
}"""


def connect(page, **options) -> None:
    page.evaluate(_CONNECT, {"scene": "apartment", **options})


def test_an_emitter_is_heard_where_it_is(page):
    connect(page, listener={"position": [2.5, 2.0, 1.5], "yaw": 0})
    page.evaluate("window.radio = nafir.addEmitter({ clip: 'woman-reading', position: [2.5, 3.0, 1.5] })")
    page.wait_for_function("nafir.latency.direct !== null")
    on_the_left = visitor.level_db(listen(page, 2.0))
    page.evaluate("radio.position = [2.5, 1.0, 1.5]")
    page.wait_for_timeout(500)
    on_the_right = visitor.level_db(listen(page, 2.0))
    assert on_the_left.max() > -60
    assert on_the_left[0] - on_the_left[1] > 1.5
    assert on_the_right[1] - on_the_right[0] > 1.5
    assert page.evaluate("nafir.welcome.sample_rate") == RATE
    assert page.evaluate("refusals") == []
    # So many are in the four seconds of which the levels are.
    assert page.evaluate("nafir.statistics.blocks * nafir.welcome.block_size") > 4 * RATE

    page.evaluate("radio.gainDb = -40")
    page.wait_for_timeout(1500)
    assert visitor.level_db(listen(page)).max() < on_the_right.max() - 20
    page.evaluate("radio.remove()")
    assert page.evaluate("nafir.emitters.size") == 0


def test_each_listener_has_an_output_and_hears_from_its_own_place(page):
    connect(page, listeners=2, listener={"position": [2.5, 2.0, 1.5], "yaw": 0})
    page.evaluate("""async () => {
      window.second = await nafir.addListener({ position: [2.5, 4.0, 1.5], yaw: 0 });
      second.output.connect(context.destination);
      nafir.addEmitter({ clip: "woman-reading", position: [2.5, 3.0, 1.5] });
    }""")
    page.wait_for_function("nafir.latency.direct !== null && second.latency.direct !== null")
    assert page.evaluate("nafir.welcome.max_listeners") == 8
    on_the_left = visitor.level_db(listen(page, 2.0))
    page.evaluate("[window.first, window.nafir] = [nafir, second]")
    on_the_right = visitor.level_db(listen(page, 2.0))
    assert on_the_left[0] - on_the_left[1] > 1.5
    assert on_the_right[1] - on_the_right[0] > 1.5

    page.evaluate("second.yaw = Math.PI")
    page.wait_for_timeout(500)
    turned = visitor.level_db(listen(page, 2.0))
    assert turned[0] - turned[1] > 1.5
    refused = page.evaluate("""async () => {
      const add = (options) => first.addListener(options).catch(({ name, code, listener }) => [name, code, listener]);
      const outside = await add({ id: "outside", position: [99, 0, 0] });
      return [outside, await add({ id: second.id }), await add({ id: "headless", head: "nobody" })];
    }""")
    assert refused == [
        ["RefusedError", "position_out_of_bounds", "outside"],
        ["RefusedError", "duplicate_listener", "listener-2"],
        ["RefusedError", "unknown_hrtf", "headless"],
    ]
    impossible = page.evaluate("""async () => {
      const said = ({ name, message }) => `${name}: ${message.split(":")[0]}`;
      const ids = ["", 2, "x".repeat(65), "\\ud800"].map((id) => ({ id }));
      const poses = [{ position: [NaN, 1, 1] }, { position: [1, 1] }, { orientation: [0, 0, 0, 0] }, { yaw: Infinity }];
      return Promise.all([...ids, ...poses].map((options) => first.addListener(options).catch(said)));
    }""")
    assert impossible == ["RangeError: id"] * 4 + ["RangeError: position"] * 2 + [
        "RangeError: orientation",
        "RangeError: yaw",
    ]
    page.evaluate("second.remove()")
    page.evaluate("window.nafir = first")
    assert page.evaluate("nafir.listeners.size") == 0
    assert visitor.level_db(listen(page)).max() > -60


def test_listeners_of_an_ambisonic_stream_turn_by_themselves(page):
    connect(page, order=1, listener={"position": [2.5, 2.0, 1.5], "yaw": 0})
    page.evaluate("""async () => {
      window.second = await nafir.addListener({ position: [2.5, 2.0, 1.5], yaw: Math.PI });
      second.output.connect(context.destination);
      nafir.addEmitter({ clip: "woman-reading", position: [2.5, 3.0, 1.5] });
    }""")
    page.wait_for_function("second.latency.direct !== null")
    ahead = visitor.level_db(listen(page, 2.0))
    page.evaluate("window.nafir = second")
    behind = visitor.level_db(listen(page, 2.0))
    assert ahead[0] - ahead[1] > 2
    assert behind[1] - behind[0] > 2


def test_a_connection_that_is_made_again_has_its_listeners_where_they_are_by_then(browser, server):
    port, context = visitor.free_port(), browser.new_context()
    with visitor.passing_on(port, server) as url:
        page = empty_page(context, url)
        connect(page, listener={"position": [2.5, 2.0, 1.5], "yaw": 0})
        page.evaluate("""async () => {
          window.second = await nafir.addListener({ position: [2.5, 4.0, 1.5], yaw: 0 });
          second.output.connect(context.destination);
          nafir.addEmitter({ clip: "woman-reading", position: [2.5, 3.0, 1.5] });
        }""")
        page.wait_for_function("second.latency.direct !== null")
    page.wait_for_function("nafir.state === 'waiting'")
    for whose in ("nafir", "second"):  # what there was left has been played
        page.wait_for_function(f"{whose}.statistics.underruns > 0")
    page.evaluate("second.position = [2.5, 2.0, 1.5]")
    page.evaluate("() => void nafir.addListener({ id: 'late' }).then((late) => (window.late = late))")
    with visitor.passing_on(port, server):
        page.wait_for_function("window.late && nafir.state === 'live'")
        page.evaluate("[window.first, window.nafir] = [nafir, second]")
        page.wait_for_timeout(1000)
        left, right = visitor.level_db(listen(page, 2.0))
        assert left > -60
        assert left - right > 1.5
        assert page.evaluate("[...first.listeners.keys()]") == ["listener-2", "late"]
        assert page.evaluate("refusals") == []
        context.close()


@pytest.mark.long
def test_a_file_that_is_uploaded_is_played_once_from_a_clock_on_and_its_end_is_told(browser, bundle, hrtfs, tmp_path):
    soundfile.write(tmp_path / "tone.wav", 0.5 * np.sin(2 * np.pi * 1000 * np.arange(RATE) / RATE), RATE)
    given = list((tmp_path / "tone.wav").read_bytes())
    with serving(FieldsByLevel.load(bundle), hrtfs, clips_folder=tmp_path / "clips") as address:
        context = browser.new_context()
        page = empty_page(context, f"http://{address}")
        connect(page, scene="flat", listener={"position": [2.5, 2.0, 1.5]})
        page.wait_for_function("nafir.sampleClock > 0")
        ended = page.evaluate(
            """async (bytes) => {
              window.tone = await nafir.upload(new Blob([new Uint8Array(bytes)]), { title: "A tone" });
              const begins = nafir.sampleClock + 24_000;
              const once = { loop: false, removeWhenEnded: true, startAt: begins, offsetS: 0.5 };
              const emitter = nafir.addEmitter({ clip: tone, position: [3, 2, 1.5], ...once });
              const told = await new Promise((resolve) => nafir.addEventListener("ended", resolve, { once: true }));
              const afterS = (nafir.sampleClock - begins) / 48_000;
              return { ...told.detail, hasEnded: emitter.hasEnded, afterS, size: nafir.emitters.size };
            }""",
            given,
        )
        heard = heard_lately(page, 3.0)[0]
        again = page.evaluate("""async () => {
          const loop = nafir.addEmitter({ clip: tone, position: [3, 2, 1.5], loopStartS: 0.25, loopEndS: 0.75 });
          loop.setGain(-20, { rampS: 0.1 });
          loop.stop({ fadeS: 0.2 });
          const { detail } = await new Promise((resolve) => nafir.addEventListener("ended", resolve, { once: true }));
          await nafir.deleteClip(tone);
          const refused = await nafir.deleteClip(tone).catch(({ name, code }) => `${name} ${code}`);
          return { ...detail, refused, refusals };
        }""")
        context.close()
    assert (ended["removed"], ended["hasEnded"], ended["size"]) == (True, True, 0)
    assert ended["afterS"] > 0.4  # half a second of it is played
    spectrum = np.abs(np.fft.rfft(heard * np.hanning(len(heard))))
    assert np.argmax(spectrum) * RATE / len(heard) == pytest.approx(1000, abs=3)
    assert (again["removed"], again["refused"], again["refusals"]) == (False, "Error unknown_clip", [])


def test_the_sound_of_a_node_is_heard_from_its_place(page):
    connect(page, encoding="s16", listener={"position": [2.5, 2.0, 1.5], "yaw": 0})
    page.evaluate("""() => {
      const oscillator = new OscillatorNode(context, { frequency: 1000 });
      const gain = new GainNode(context, { gain: 0.5 });
      window.tone = nafir.addEmitter({ source: oscillator.connect(gain), position: [3.5, 2.0, 1.5], jitterMs: 250 });
      oscillator.start();
    }""")
    page.wait_for_function("nafir.latency.direct !== null")
    page.wait_for_timeout(1000)
    heard = listen(page)[0]
    spectrum = np.abs(np.fft.rfft(heard * np.hanning(len(heard))))
    loudest = np.argmax(spectrum) * RATE / len(heard)
    assert loudest == pytest.approx(1000, abs=3)
    assert visitor.level_db(heard) > -50
    page.evaluate("tone.remove()")
    page.wait_for_timeout(2000)
    assert visitor.level_db(listen(page)).max() < -70
    assert page.evaluate("refusals") == []


def test_a_head_that_turns_in_the_browser_hears_the_other_side(page):
    connect(page, order=1, listener={"position": [2.5, 2.0, 1.5], "yaw": 0})
    page.evaluate("nafir.addEmitter({ clip: 'woman-reading', position: [2.5, 3.0, 1.5] })")
    page.wait_for_function("nafir.latency.direct !== null")
    before = visitor.level_db(listen(page, 2.0))
    page.evaluate("nafir.listener.yaw = Math.PI")
    page.wait_for_timeout(300)
    after = visitor.level_db(listen(page, 2.0))
    assert page.evaluate("nafir.welcome.order") == 1
    assert before[0] - before[1] > 2
    assert after[1] - after[0] > 2


def test_a_stream_in_opus_is_heard_and_falls_back_where_it_cannot_be(page):
    connect(page, encoding="opus", opus={"bitrate": 160_000}, listener={"position": [2.5, 2.0, 1.5], "yaw": 0})
    assert page.evaluate("nafir.welcome.encoding") == ("opus" if libopus.is_available() else "s16")
    page.evaluate("nafir.addEmitter({ clip: 'woman-reading', position: [2.5, 3.0, 1.5] })")
    page.wait_for_function("nafir.latency.direct !== null")
    left, right = visitor.level_db(listen(page, 2.0))
    assert left > -60
    assert left - right > 1.5
    page.evaluate("nafir.close()")
    other = """async () => {
      const context = new AudioContext({ sampleRate: 44100 });
      const nafir = await package.connect(context, location.origin, { scene: "apartment", encoding: "opus" });
      nafir.close();
      return nafir.welcome.encoding;
    }"""
    assert page.evaluate(other) == "s16"


def test_a_refused_stream_says_why(page):
    failed = """async (options) => {
      const context = new AudioContext({ sampleRate: 48000 });
      try {
        await package.connect(context, location.origin, options);
      } catch (error) {
        return [error.constructor.name, error.code];
      } finally {
        await context.close();
      }
    }"""
    start = {"position": [1, 1, 1.5]}
    assert page.evaluate(failed, {"scene": "nowhere"}) == ["RequestError", "unknown_scene"]
    refused = ["RefusedError", "unknown_scene"]
    assert page.evaluate(failed, {"scene": "nowhere", "listener": start}) == refused
    assert page.evaluate(failed, {"scene": "apartment", "level": "none"}) == ["RefusedError", "unknown_level"]


def test_a_closed_stream_leaves_nothing_behind(page, server):
    def streams() -> float:
        with urllib.request.urlopen(f"{server}/metrics") as answer:
            lines = answer.read().decode().splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith("nafir_streams{"))

    before = streams()
    connect(page)
    assert streams() == before + 1
    page.evaluate("nafir.addEmitter({ position: [3, 3, 1.5] })")
    page.evaluate("nafir.close()")
    assert page.evaluate("nafir.state") == "closed"
    for _ in range(50):
        if streams() == before and not page.workers:
            break
        page.wait_for_timeout(100)
    assert streams() == before
    assert page.workers == []


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture(scope="module")
def examples() -> Iterator[tuple[str, str]]:
    """Addresses of the examples' folder and of a server that lets them in, as the README starts both."""
    # The package as npm installs it.
    subprocess.run([shutil.which("node"), "prepare.mjs"], cwd=PACKAGE, check=True)
    handler = functools.partial(_Quiet, directory=str(PACKAGE))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as files:
        thread = threading.Thread(target=files.serve_forever)
        thread.start()
        origin = f"http://127.0.0.1:{files.server_port}"
        with visitor.serving(visitor.free_port(), settings={"NAFIR_ALLOWED_ORIGINS": origin}) as server:
            yield origin, server
        files.shutdown()
        thread.join()


@pytest.fixture
def visitor_of(browser, examples) -> Iterator:
    """Opens an example; fails if it leaves an error in the console."""
    context = browser.new_context()
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))

    def open_example(name: str, **asked: str):
        origin, server = examples
        page.goto(f"{origin}/{name}?{urllib.parse.urlencode({'server': server, **asked})}")
        return page

    yield open_example
    context.close()
    assert [each for each in complaints if "favicon" not in each and "404" not in each] == []


@needs_packages
def test_the_example_of_three_js_hears_what_it_shows(visitor_of):
    page = visitor_of("three.html")
    page.click("#start")
    page.wait_for_function("document.getElementById('state').textContent === 'live'")
    page.evaluate("window.nafir = example.nafir")
    page.wait_for_function("nafir.latency.direct !== null")
    assert visitor.level_db(listen(page, 2.0)).max() > -60
    before = page.evaluate("nafir.listener.position")
    page.keyboard.down("ArrowUp")
    page.wait_for_timeout(500)
    page.keyboard.up("ArrowUp")
    page.wait_for_timeout(200)
    there, here = page.evaluate("[example.camera.position.toArray(), nafir.listener.position]")
    assert np.linalg.norm(np.subtract(here, before)) > 0.2
    np.testing.assert_allclose([there[0], -there[2], there[1]], here, atol=1e-9)
    [ball, cube] = page.evaluate("[...nafir.emitters.values()].map(({ position }) => position)")
    assert np.linalg.norm(np.subtract(ball, cube)) < 1.2


def bundle_react() -> None:
    command = ["react.jsx", "--bundle", "--format=esm", "--jsx=automatic", "--outfile=react.bundle.js"]
    subprocess.run(
        [PACKAGE / "node_modules" / ".bin" / "esbuild", *command], cwd=PACKAGE, check=True, capture_output=True
    )


@needs_packages
def test_the_example_of_react_adds_and_removes_what_it_renders(visitor_of):
    bundle_react()
    page = visitor_of("react.html")
    page.click("#start")
    page.wait_for_function("document.getElementById('state').textContent === 'live'")
    page.wait_for_function("window.nafir?.latency.direct")
    places = "[...nafir.emitters.values()].map(({ position }) => position[0])"
    assert page.evaluate(places) == [6]
    page.fill("#x", "3")
    assert page.evaluate(places) == [3]
    page.uncheck("#playing")
    assert page.evaluate(places) == []
    page.check("#playing")
    assert page.evaluate(places) == [3]
    page.wait_for_timeout(1000)
    assert visitor.level_db(listen(page, 2.0)).max() > -60
    page.click("#start")
    page.wait_for_function("document.getElementById('state').textContent === 'closed'")
    page.wait_for_timeout(200)
    assert page.workers == []


@needs_packages
def test_a_component_of_react_listens_as_long_as_it_is_there(visitor_of):
    bundle_react()
    page = visitor_of("react.html")
    page.click("#start")
    page.wait_for_function("document.getElementById('state').textContent === 'live'")
    for x in ("3", "4"):
        page.check("#watched")
        page.wait_for_function("window.spectator")
        page.fill("#x", x)
        assert page.evaluate("spectator.position") == [float(x), 2, 1.5]
        page.wait_for_function("spectator.latency.direct")
        page.uncheck("#watched")
        assert page.evaluate("nafir.listeners.size") == 0
    # One that is taken away before it is there leaves its id to the next.
    page.evaluate("for (let i = 0; i < 3; i++) document.getElementById('watched').click()")
    page.wait_for_function("window.spectator")
    assert page.inner_text("#spectator") == "Another listener at 4 m"
    page.evaluate("spectator.remove()")


@needs_packages
def test_a_component_of_react_opens_doors(visitor_of, examples, tmp_path, hrtfs, monkeypatch):
    bundle_react()
    moved = []
    set_door = FollowedDoors.set
    monkeypatch.setattr(FollowedDoors, "set", lambda self, *door: (moved.append(door), set_door(self, *door)))
    levels = FieldsByLevel.load(write_two_rooms(tmp_path / "scene", openness=0.0))
    with serving(levels, hrtfs, allowed_origins=(examples[0],)) as address:
        page = visitor_of("react.html", server=f"http://{address}", scene=levels.bundle.id)
        page.click("#start")
        page.wait_for_function("document.getElementById('state').textContent === 'live'")
        page.get_by_label("between").fill("0.5")
        for _ in range(100):
            if ("between", 0.5) in moved:
                break
            page.wait_for_timeout(50)
        assert moved[-1] == ("between", 0.5)
        page.click("#start")
        page.wait_for_function("document.getElementById('state').textContent === 'closed'")


RATES = pytest.mark.parametrize("rate", [24_000, 48_000], ids=["own", "48"])


def connect_at(rate: int) -> str:
    return _CONNECT.replace("48000", str(rate))


@RATES
def test_a_scene_is_rendered_in_the_browser(page, server, rate):
    asked = []
    page.on("request", lambda request: asked.append(request.url.removeprefix(server)))
    options = {"scene": "apartment", "rendered": "here", "listener": {"position": [2.5, 2.0, 1.5]}}
    page.evaluate(connect_at(rate), options)
    page.evaluate("window.radio = nafir.addEmitter({ clip: 'woman-reading', position: [2.5, 3.0, 1.5] })")
    page.wait_for_function("nafir.latency.reverberation !== null")
    on_the_left = visitor.level_db(listen(page, 2.0))
    page.evaluate("radio.position = [2.5, 1.0, 1.5]")
    page.wait_for_timeout(1000)
    on_the_right = visitor.level_db(listen(page, 2.0))
    assert on_the_left.max() > -60
    assert on_the_left[0] - on_the_left[1] > 1.5
    assert on_the_right[1] - on_the_right[0] > 1.5
    assert page.evaluate("refusals") == []
    assert page.evaluate("nafir.welcome.level") == "directional-bands"
    assert page.evaluate("nafir.welcome.sample_rate") == rate
    page.evaluate("radio.remove()")
    page.wait_for_timeout(1500)
    assert visitor.level_db(listen(page)).max() < -100
    assert not any("/v1/stream" in url for url in asked)
    assert any("/v1/clips/woman-reading/audio" in url for url in asked)
    page.evaluate("nafir.close()")


@RATES
def test_a_browser_renders_what_the_server_does(page, rate):
    """The level of noise at both ears, of one source at two places in turn, within half a decibel."""
    heard = {}
    for rendered in ("server", "here"):
        options = {"scene": "apartment", "order": 1, "rendered": rendered, "listener": {"position": [2.5, 2.0, 1.5]}}
        page.evaluate(connect_at(rate), options)
        page.evaluate("""() => {
          const { sampleRate } = context;
          const buffer = new AudioBuffer({ length: sampleRate, sampleRate });
          const samples = buffer.getChannelData(0);
          for (let i = 0, seed = 1; i < samples.length; i++) {
            seed = (1103515245 * seed + 12345) % 2 ** 31;
            samples[i] = 0.2 * (seed / 2 ** 30 - 1);
          }
          const source = new AudioBufferSourceNode(context, { buffer, loop: true });
          window.noise = nafir.addEmitter({ source, position: [3.5, 3.0, 1.5], jitterMs: 250 });
          source.start();
        }""")
        page.wait_for_function("nafir.latency.reverberation !== null")
        page.wait_for_timeout(1000)
        near = visitor.level_db(listen(page, 2.0))
        page.evaluate("noise.position = [6.5, 1.0, 1.5]")  # in the other room
        page.wait_for_timeout(1500)
        heard[rendered] = np.stack([near, visitor.level_db(listen(page, 2.0))])
        page.evaluate("nafir.close(); context.close()")
    np.testing.assert_allclose(heard["here"], heard["server"], atol=0.5)


def test_a_scene_that_a_browser_cannot_render_is_refused_in_words(page):
    said = page.evaluate("""async () => {
      const context = new AudioContext({ sampleRate: 48000 });
      const connect = (options) => package.connect(context, location.origin, options).catch((error) => error.message);
      return connect({ scene: "apartment", rendered: "here", level: "factorised-r16-100cm-120deg" });
    }""")
    assert "does not know from where sound arrives" in said
