"""The page plays at the rate of the sound card, where the server has it: what a scene at 24 kHz lets through above
12 kHz is heard, whoever renders it."""

import io
from collections.abc import Iterator

import numpy as np
import pytest
import soundfile

from tests import visitor
from tests.visitor import LISTENING_S, free_port, listen, open_page, serving, start, visit

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

BANDS_HZ = [(500, 2_000), (2_000, 8_000), (13_000, 19_000)]
"""The last is above that of the scene."""


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> Iterator[str]:
    """A server of the apartment with white noise as a clip."""
    file = tmp_path_factory.mktemp("clips") / "noise.wav"
    # A turn of it is as long as what is listened to, so that its spectrum is the same wherever that begins.
    noise = 0.02 * np.random.default_rng(3).standard_normal(round(LISTENING_S * 48_000))
    soundfile.write(file, noise, 48_000)
    with serving(free_port(), "--clip", str(file)) as url:
        yield url


def opened(browser, url: str, query: str = ""):
    """The page with the noise as its only source, a metre and a half ahead in the same room."""
    page = open_page(browser.new_context(viewport={"width": 1280, "height": 900}), f"{url}/{query}")
    page.select_option("[data-source=A] select", "noise")
    page.evaluate("nafir.setListener({ x: 2.0, y: 2.5, yaw: 0.3 })")
    page.evaluate("nafir.setEmitter('A', { x: 3.5, y: 2.7 })")
    return page


def card_hz(page) -> int:
    return page.evaluate("new AudioContext().sampleRate")


def without_a_gap(page) -> np.ndarray:
    """(2, n): what is played in some seconds in which the machine has kept up."""
    for _ in range(20):
        gaps = [page.inner_text(f"#{name}") for name in ("dropouts", "skipped")]
        samples = listen(page)
        if gaps == [page.inner_text(f"#{name}") for name in ("dropouts", "skipped")]:
            return samples
    raise AssertionError("there are gaps all the time")


def band_levels_db(page) -> np.ndarray:
    """(ear, band) of what is played, in the bands that its rate has."""
    samples = without_a_gap(page)
    rate = page.evaluate("nafir.state().sampleRate")
    power = np.abs(np.fft.rfft(samples)) ** 2 / samples.shape[1]
    hz = np.fft.rfftfreq(samples.shape[1], 1 / rate)
    bands = [power[:, (hz > low) & (hz < high)].mean(axis=1) for low, high in BANDS_HZ if high < rate / 2]
    return 10 * np.log10(np.stack(bands, axis=1) + 1e-20)


def heard_at(page, level: str) -> None:
    page.select_option("#level-choice", level)
    page.wait_for_function("level => level === 'auto' || nafir.state().level === level", arg=level)
    page.wait_for_function("nafir.state().latency !== null && nafir.state().reverberationLatency !== null")
    page.wait_for_function("nafir.state().head !== null")
    page.wait_for_timeout(1_500)


def test_what_is_above_the_band_of_a_scene_is_heard(browser, noisy):
    page = opened(browser, noisy)
    start(page)
    heard_at(page, "auto")
    assert page.evaluate("nafir.state().sampleRate") == card_hz(page) > 40_000
    full = band_levels_db(page)
    # A head hears less of it up there, and of the room only the direct sound and the first reflections are there.
    assert np.all(full[:, 2] > full[:, 1] - 25)
    page.context.close()


@pytest.mark.parametrize("query", ["?rate=48000", "?rate=24000"])
def test_each_level_is_heard_alike(browser, noisy, query):
    rate = int(query[-5:])
    page = opened(browser, noisy, query)
    start(page)
    found = {}
    for level in ("directional-bands", "in-this-browser", "directional-bands"):
        heard_at(page, level)
        assert page.evaluate("nafir.state().sampleRate") == rate
        assert page.evaluate("nafir.state().output") == "ambisonics"
        found.setdefault(level, []).append(band_levels_db(page))
    server, again = found["directional-bands"]
    np.testing.assert_allclose(server, again, atol=0.5)
    np.testing.assert_allclose(found["in-this-browser"][0], server, atol=0.7)
    page.context.close()


def test_a_link_may_ask_for_a_rate(browser, noisy):
    with visit(browser, f"{noisy}/?scene=apartment&rate=96000") as page:
        page.click("#share")
        page.locator(".notice", has_text="link to what you hear").wait_for()
        assert page.evaluate("location.search") == "?scene=apartment&rate=96000"
        start(page)
        assert page.evaluate("nafir.state().sampleRate") == 96_000
    with visit(browser, f"{noisy}/?rate=quick") as page:
        said = "not played at a rate of “quick”, but at 24000, 44100, 48000, 96000 Hz"
        page.locator(".notice", has_text=said).wait_for()
        page.click("#share")
        page.locator(".notice", has_text="link to what you hear").wait_for()
        assert page.evaluate("location.search") == "?scene=apartment"


CHOOSE = """async (cases) => {
  const { rateFor } = await import(new URL("player.js", document.baseURI));
  return cases.map(([cardHz, scene]) => rateFor(cardHz, scene));
}"""


def test_the_rate_is_that_of_the_sound_card_if_streams_have_it(browser, noisy):
    flat = {"sample_rate": 24_000, "sample_rates": [24_000, 44_100, 48_000, 96_000]}
    old = {"sample_rate": 24_000}
    cases = [(44_100, flat), (48_000, flat), (24_000, flat), (96_000, flat), (192_000, flat), (16_000, flat)]
    with visit(browser, noisy) as page:
        chosen = page.evaluate(CHOOSE, [*cases, (48_000, old), (44_100, old)])
    assert chosen == [44_100, 48_000, 24_000, 48_000, 48_000, 48_000, 24_000, 24_000]


def test_a_server_without_other_rates_is_heard_at_the_scenes_own(browser, noisy):
    def without_rates(route) -> None:
        scene = route.fetch().json()
        del scene["sample_rates"]
        route.fulfill(json=scene)

    context = browser.new_context()
    context.route("**/v1/scenes/apartment", without_rates)
    page = open_page(context, noisy)
    start(page)
    assert page.evaluate("nafir.state().sampleRate") == 24_000
    page.evaluate("nafir.setListener({ yaw: 1 })")
    assert np.all(visitor.level_db(listen(page)) > -70)
    context.close()


def test_a_file_of_the_visitor_is_decoded_for_the_rate(browser, noisy):
    """A buffer of another rate would be played by linear interpolation, which mirrors a high tone."""
    file, tone_hz, rate = io.BytesIO(), 15_000, 48_000
    soundfile.write(file, np.sin(2 * np.pi * tone_hz / rate * np.arange(rate)) / 8, rate, format="WAV")
    page = opened(browser, noisy, "?rate=44100")
    page.set_input_files("#file", {"name": "high.wav", "mimeType": "audio/wav", "buffer": file.getvalue()})
    page.locator("[data-source=B]").wait_for()
    page.evaluate("nafir.setEmitter('B', { x: 3.0, y: 2.6 })")
    page.click("[data-source=A] .remove")
    start(page)
    page.wait_for_timeout(2_000)
    [samples, _] = listen(page, seconds=1)
    spectrum = np.abs(np.fft.rfft(samples * np.kaiser(samples.size, 14)))
    hz = np.fft.rfftfreq(samples.size, 1 / 44_100)
    loudest = np.argmax(spectrum)
    mirrored = np.abs(hz - (44_100 - (rate - tone_hz))) < 200
    assert hz[loudest] == pytest.approx(tone_hz, abs=20)
    assert spectrum[mirrored].max() < 0.02 * spectrum[loudest]
    page.context.close()
