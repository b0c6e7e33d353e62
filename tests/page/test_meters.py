"""What moves is drawn less often than it changes, and nothing is left out."""

import numpy as np
import pytest

from tests import visitor

browser = visitor.browser
page = visitor.page
one_page = visitor.one_page
pytestmark = visitor.needs_browser

REPORT = """async (drawings) => {
  const { Panel } = await import("./panel.js");
  const panel = new Panel(document);
  const counters = { underruns: 0, stretches: 0, late: 0, gaps: 0 };
  const none = { summary: () => null };
  const ledgers = { direct: none, reverberation: none, turn: none };
  return drawings.map((levels) => {
    for (const level of levels) {
      const heard = { rms: [level, level], peak: [level, level] };
      panel.report({ fillS: 0.05, targetS: 0.05, started: true, counters, ...heard }, ledgers);
    }
    return panel.draw();
  });
}"""


def test_what_was_loud_between_two_drawings_is_still_shown(one_page):
    """-6 dB for 15 ms. A meter falls by 1.2 dB with each report; its length is 0 at -60 dB and 1 at full scale."""
    lengths = one_page.evaluate(REPORT, [[0.0], [0.5, 0.0, 0.0]])
    assert lengths[0] == [0, 0]
    assert lengths[1] == pytest.approx([1 - (6.02 + 2 * 1.2) / 60] * 2, abs=1e-3)


DRAW_OFTEN = """async () => {
  const { inNextFrame } = await import("./frames.js");
  const drawn = [];
  let asked = 0;
  let newest = 0;
  const draw = () => drawn.push([performance.now(), (newest = asked)]);
  for (; asked < 300; asked++) {
    inNextFrame(draw);
    await new Promise((resolve) => setTimeout(resolve, 2));
  }
  inNextFrame(draw);
  while (newest < asked) await new Promise((resolve) => setTimeout(resolve, 2));
  return drawn;
}"""


def test_however_often_something_changes_it_is_drawn_thirty_times_a_second_and_as_it_is_in_the_end(one_page):
    drawn = np.array(one_page.evaluate(DRAW_OFTEN))
    assert len(drawn) > 3
    assert np.diff(drawn[:, 0]).min() > 29
    assert drawn[-1, 1] == 300


def test_nothing_on_the_page_moves_by_itself_while_it_plays(page):
    """An animation of a style sheet is a frame sixty times a second, in which nothing else has changed."""
    page.emulate_media(reduced_motion="no-preference")
    visitor.start(page)
    ripple = "getComputedStyle(document.querySelector('.ripple')).r"
    before = page.evaluate(ripple)
    page.wait_for_function(f"{ripple} !== '{before}'")
    assert page.evaluate("document.getAnimations().map((each) => each.animationName ?? each.transitionProperty)") == []
