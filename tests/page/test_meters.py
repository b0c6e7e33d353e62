"""The meters of both ears are drawn less often than sound is reported, and leave nothing out."""

import pytest

from tests import visitor

browser = visitor.browser
one_page = visitor.one_page
pytestmark = visitor.needs_browser

REPORT = """async (levels) => {
  const { Panel } = await import("./panel.js");
  const panel = new Panel(document);
  const counters = { underruns: 0, stretches: 0, late: 0, gaps: 0 };
  const report = (level) =>
    panel.report({ fillS: 0.05, targetS: 0.05, started: true, counters, rms: [level, level], peak: [level, level] });
  const now = performance.now.bind(performance);
  let at = now() + 1000;
  performance.now = () => at;
  try {
    return levels.map((level) => {
      at += 15;
      return report(level);
    });
  } finally {
    performance.now = now;
  }
}"""


def test_what_was_loud_between_two_drawings_is_still_shown(one_page):
    """-6 dB for 15 ms. A meter falls by 1.2 dB with each report; its length is 0 at -60 dB and 1 at full scale."""
    lengths = one_page.evaluate(REPORT, [0.0, 0.5, 0.0, 0.0, 0.0])
    assert [length is not None for length in lengths] == [True, False, False, True, False]
    assert lengths[0] == [0, 0]
    assert lengths[3] == pytest.approx([1 - (6.02 + 2 * 1.2) / 60] * 2, abs=1e-3)
