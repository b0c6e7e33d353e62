"""The package for JavaScript when its server shuts down or dies. It goes on by a snapshot, and nothing that was
acknowledged is lost."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt
import pytest

from server.field.fields_by_level import FieldsByLevel
from tests import visitor
from tests.integration import losing
from tests.integration.lossy_proxy import LossyProxy
from tests.integration.snapshots import Snapshots
from tests.integration.test_javascript import RATE, connect, empty_page, heard_lately, listen
from tests.integration.test_resuming import serving_until_drained
from tests.serving import serving

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]

SECRET = "a secret of both servers"
TALKER = {"clip": losing.CLIP, "position": [6.0, 3.0, 1.5]}


@contextmanager
def visiting(browser, network: LossyProxy) -> Iterator:
    """A page with a stream in which a clip is heard."""
    context = browser.new_context()
    page = empty_page(context, f"http://{network.address}")
    connect(page, scene="flat")
    page.evaluate("(options) => void (window.talker = nafir.addEmitter(options))", TALKER)
    page.wait_for_function("nafir.latency.direct !== null")
    yield page
    context.close()


def session(page) -> str:
    return page.evaluate("nafir.welcome.session")


def resumed(page) -> dict:
    """What the next welcome says of a stream that goes on."""
    page.wait_for_function("nafir.welcome.resumed && nafir.state === 'live'")
    return page.evaluate("nafir.welcome.resumed")


def longest_silence(heard: npt.NDArray[np.float64]) -> losing.Gap:
    sounding = np.flatnonzero(np.abs(heard) > 1e-6)
    return losing.gap_around(heard, int(sounding[np.argmax(np.diff(sounding))]) + 1)


@pytest.mark.long
def test_a_server_that_shuts_down_hands_the_stream_to_another(browser, bundle, hrtfs):
    with (
        serving_until_drained(bundle, hrtfs) as (old, shut_down),
        serving_until_drained(bundle, hrtfs) as (new, _),
        LossyProxy(old).running() as network,
        visiting(browser, network) as page,
    ):
        page.wait_for_timeout(4_000)
        first = session(page)
        network.redirect(new)
        shut_down()
        assert resumed(page)["handled"] == 1
        page.wait_for_timeout(4_000)
        heard = heard_lately(page, 12.0)[0]
        assert session(page) == first
        assert page.evaluate("refusals") == []
    gap = longest_silence(heard)
    assert gap.seconds > 0.3
    losing.assert_no_click(heard, gap)
    losing.assert_same_clip_position(heard, gap, at_most_s=0.25)


def test_what_was_acknowledged_since_the_last_snapshot_is_said_again(browser, bundle, hrtfs, monkeypatch):
    """To a server that knows nothing but the snapshot, as after the first one died."""
    snapshots, levels = Snapshots(monkeypatch), FieldsByLevel.load(bundle)
    with (
        serving(levels, hrtfs, resume_secret=SECRET) as old,
        serving(levels, hrtfs, resume_secret=SECRET) as new,
        LossyProxy(old).running() as network,
        visiting(browser, network) as page,
    ):
        snapshots.end_with(1)  # message: the talker, and nothing that comes later
        page.evaluate("""async () => {
          window.second = await nafir.addListener({ position: [2.5, 2, 1.5] });
          const source = new OscillatorNode(context, { frequency: 1000 });
          window.tone = nafir.addEmitter({ source, position: [3.5, 2, 1.5] });
          source.start();
          talker.remove();
        }""")
        page.wait_for_function("second.latency.direct !== null")
        first = session(page)
        network.redirect(new)
        network.cut()
        told = resumed(page)
        assert told["handled"] == 1
        assert "listeners" not in told
        assert session(page) == first
        page.wait_for_function("second.latency.direct !== null")
        page.wait_for_timeout(500)
        for whose in ("nafir", "second"):
            page.evaluate(f"window.nafir = {whose}")
            heard = listen(page)[0]
            spectrum = np.abs(np.fft.rfft(heard * np.hanning(len(heard))))
            assert np.argmax(spectrum) * RATE / len(heard) == pytest.approx(1000, abs=3)
            assert visitor.level_db(heard) > -60
        page.evaluate("tone.remove()")
        page.wait_for_timeout(2_000)
        assert visitor.level_db(listen(page)).max() < -70  # the talker is gone, as was said after the snapshot
        assert page.evaluate("refusals") == []


def test_a_clip_that_plays_once_and_was_heard_is_not_played_by_another_server(browser, bundle, hrtfs, monkeypatch):
    """The snapshot is older than the clip, as that of a server which dies."""
    levels = FieldsByLevel.load(bundle)
    snapshots = Snapshots(monkeypatch)
    with (
        serving(levels, hrtfs, resume_secret=SECRET) as old,
        serving(levels, hrtfs, resume_secret=SECRET) as new,
        LossyProxy(old).running() as network,
        visiting(browser, network) as page,
    ):
        snapshots.end_with(1)  # message: the talker, and nothing that comes later
        page.evaluate("""() => {
          window.ends = [];
          nafir.addEventListener("ended", ({ detail }) => ends.push(detail));
          const shot = { clip: "trumpet", loop: false, position: [6, 3, 1.5] };
          nafir.addEmitter({ ...shot, id: "heard" });
          nafir.addEmitter({ ...shot, id: "stays", offsetS: 5 });
          nafir.addEmitter({ ...shot, id: "over", offsetS: 5, removeWhenEnded: true });
          nafir.addEmitter({ ...shot, id: "later", startAt: nafir.sampleClock + 1e9 });
          talker.gainDb = -70;
        }""")
        page.wait_for_function("ends.length >= 2")
        before = visitor.level_db(listen(page)[0])
        told = page.evaluate("ends")
        assert sorted(each["id"] for each in told) == ["over", "stays"]
        network.redirect(new)
        network.cut()
        assert resumed(page)["handled"] == 1
        page.wait_for_timeout(2_000)
        assert page.evaluate("ends")[2:] == [{"id": "heard", "removed": True}]
        assert page.evaluate("[...nafir.emitters.keys()].filter((id) => id !== talker.id)") == ["later"]
        after = visitor.level_db(listen(page)[0])
        assert page.evaluate("refusals") == []
    assert after < before - 20
