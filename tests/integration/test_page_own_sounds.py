"""Sounds of the visitor's own on the page: a file, chosen or dropped, and the microphone."""

import base64
import io

import numpy as np
import pytest
import soundfile

from tests import visitor
from tests.visitor import CHROMIUM, CHROMIUM_ARGUMENTS, level_db, listen, open_page, start

page = visitor.page
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

RATE = 44_100
TONE_HZ = 700


@pytest.fixture(scope="module")
def browser():
    """With a microphone that beeps."""
    with visitor.sync_api.sync_playwright() as playwright:
        fake = ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*CHROMIUM_ARGUMENTS, *fake])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def tone() -> bytes:
    """A wav file of a tone of a whole number of periods, so that it loops without a click."""
    file = io.BytesIO()
    soundfile.write(file, np.sin(2 * np.pi * TONE_HZ / RATE * np.arange(RATE)) / 4, RATE, format="WAV")
    return file.getvalue()


def sounds(page) -> list[str]:
    return [each["clip"] for each in page.evaluate("nafir.state().emitters")]


def tonal_share(page, samples: np.ndarray) -> float:
    """The share of the power within 20 Hz of the tone."""
    power = np.abs(np.fft.rfft(samples[0] * np.hanning(samples.shape[1]))) ** 2
    frequency = np.fft.rfftfreq(samples.shape[1], 1 / page.evaluate("nafir.state().sampleRate"))
    return power[np.abs(frequency - TONE_HZ) < 20].sum() / power.sum()


def test_a_file_is_heard_as_live_sound_and_goes_with_its_source(page, tone):
    start(page)
    page.set_input_files("#file", {"name": "a tone.wav", "mimeType": "audio/wav", "buffer": tone})
    page.locator("[data-source=B]").wait_for()
    assert sounds(page)[1].startswith("own:")
    assert page.locator("[data-source=B] select option:checked").inner_text() == "a tone.wav"
    page.click("[data-source=A] .remove")
    page.wait_for_timeout(1_500)
    heard = listen(page)
    assert np.all(level_db(heard) > -50)
    assert tonal_share(page, heard) > 0.9

    page.click("#play")
    page.locator("#connection-text", has_text="Paused").wait_for()
    start(page)
    page.wait_for_timeout(1_500)
    assert tonal_share(page, listen(page)) > 0.9, "it plays again"

    clip = page.locator("[data-source=B] select option").first.get_attribute("value")
    page.select_option("[data-source=B] select", clip)
    page.wait_for_timeout(1_500)
    heard = listen(page)
    assert np.all(level_db(heard) > -60)
    assert tonal_share(page, heard) < 0.5
    assert page.locator(".notice").count() == 0


DROP = """([text, x, y]) => {
  const bytes = Uint8Array.from(atob(text), (each) => each.charCodeAt(0));
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([bytes], "dropped.wav", { type: "audio/wav" }));
  const box = document.getElementById("marks").getBoundingClientRect();
  const place = { clientX: box.x + x * box.width, clientY: box.y + y * box.height };
  const at = { ...place, dataTransfer, bubbles: true, cancelable: true };
  document.getElementById("marks").dispatchEvent(new DragEvent("dragover", at));
  const isMarked = document.getElementById("plan").classList.contains("receives");
  document.getElementById("marks").dispatchEvent(new DragEvent("drop", at));
  return isMarked;
}"""


def test_a_file_that_is_dropped_on_the_plan_plays_there(page, tone):
    assert page.evaluate(DROP, [base64.b64encode(tone).decode(), 0.2, 0.3])
    page.locator("[data-source=B]").wait_for()
    x, y, _ = page.evaluate("nafir.state().emitters")[1]["position"]
    assert x < 4
    assert y > 2.5
    page.click("#share")
    assert "source" in page.evaluate("location.hash")
    assert "own" not in page.evaluate("location.hash")


def test_what_is_no_sound_is_refused_by_name(page):
    page.set_input_files("#file", {"name": "letter.txt", "mimeType": "text/plain", "buffer": b"Dear Sir or Madam"})
    page.locator(".notice", has_text="letter.txt is no sound that this browser can read").wait_for()
    assert len(sounds(page)) == 1


def test_the_microphone_is_heard_and_given_back(page):
    page.evaluate(
        """() => {
          window.tracks = [];
          const devices = navigator.mediaDevices;
          const original = devices.getUserMedia.bind(devices);
          devices.getUserMedia = async (asked) => {
            const stream = await original(asked);
            window.tracks.push(...stream.getTracks());
            return stream;
          };
        }"""
    )
    page.click("#add-microphone")
    page.locator("[data-source=B]").wait_for()
    page.evaluate("nafir.setEmitter('B', { x: 3, y: 2.5 })")
    page.click("[data-source=A] .remove")
    start(page)
    page.wait_for_timeout(1_500)
    assert np.all(level_db(listen(page, seconds=3)) > -60)
    assert page.evaluate("window.tracks.filter((track) => track.readyState === 'live').length") == 1
    page.click("#play")
    page.locator("#connection-text", has_text="Paused").wait_for()
    assert page.evaluate("window.tracks.filter((track) => track.readyState === 'live').length") == 0


def test_a_visitor_who_refuses_the_microphone_is_told(browser, server):
    context = browser.new_context()
    context.add_init_script(
        "navigator.mediaDevices.getUserMedia = () => Promise.reject(new DOMException('no', 'NotAllowedError'))"
    )
    page = open_page(context, server)
    page.click("#add-microphone")
    page.locator(".notice", has_text="may not use the microphone").wait_for()
    assert len(sounds(page)) == 1
    context.close()
