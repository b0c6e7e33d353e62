"""One stream takes another's place in the worklet without a gap, rendered offline: blocks of 256 at 24 kHz, of constant
sound, so that a gap or a click is a number."""

import base64

import numpy as np
import pytest

from tests import visitor

browser = visitor.browser
one_page = visitor.one_page
pytestmark = visitor.needs_browser

RATE = 24_000
BLOCK = 256
BEFORE, AFTER = 0.25, 0.5
STEP_BLOCKS = 4

PLAY = """async ({ rate, block, stepBlocks, steps, switchAt, orders, values, lead }) => {
  const { Output } = await import(new URL("nafir/output.js", document.baseURI));
  const context = new OfflineAudioContext(2, steps * stepBlocks * block, rate);
  const output = await Output.in(context);
  output.node.connect(context.destination);
  const reports = [];
  const heard = [];
  output.addEventListener("report", ({ detail }) => reports.push(detail.counters));
  output.addEventListener("heard", ({ detail }) => heard.push(detail.poseId));
  const filter = (gain) => [gain, ...new Array(15).fill(0)];
  // W alone, as it is, to both ears.
  const filters = [0, 1].map(() => [0, 1, 2, 3].map((channel) => filter(channel === 0 ? 1 : 0)));
  output.listenWith({ filters, delaySamples: 0 });
  const streams = [0, 1].map((number) => {
    const channels = orders[number] === null ? 2 : 4;
    let port = null;
    let sent = 0;
    const feed = (count) => {
      for (let i = 0; i < count; i++, sent++) {
        const other = orders[number] === null ? values[number] : 0;
        const fill = (_, channel) => new Float32Array(block).fill(channel === 0 ? values[number] : other);
        const samples = Array.from({ length: channels }, fill);
        const counted = { sampleClock: sent * block, poseId: sent, frames: block, flags: 0, late: false };
        port.postMessage({ channels: samples, ...counted });
      }
    };
    const begin = () => {
      const ends = new MessageChannel();
      port = ends.port1;
      port.postMessage({ restart: true, order: orders[number] });
      return ends.port2;
    };
    return { begin, feed };
  });
  const settled = () => new Promise((resolve) => setTimeout(resolve, 15));
  const obey = async (step) => {
    if (step === 0) output.take(streams[0].begin());
    if (step === switchAt) {
      const waiting = streams[1].begin();
      streams[1].feed(lead);
      output.take(waiting);
    }
    streams[step < switchAt ? 0 : 1].feed(stepBlocks);
    await settled();
    if (step > 0) context.resume();
  };
  for (let step = 1; step < steps; step++) context.suspend((step * stepBlocks * block) / rate).then(() => obey(step));
  await obey(0);
  const rendered = await context.startRendering();
  await settled();
  const bytes = new Uint8Array(rendered.getChannelData(0).buffer);
  let text = "";
  for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192));
  return { left: btoa(text), counters: reports.at(-1), heard };
}"""


def played(page, *, orders, lead, switch_at=20, steps=40):
    parameters = {"rate": RATE, "block": BLOCK, "stepBlocks": STEP_BLOCKS, "steps": steps, "switchAt": switch_at}
    run = page.evaluate(PLAY, parameters | {"orders": orders, "values": [BEFORE, AFTER], "lead": lead})
    return np.frombuffer(base64.b64decode(run["left"]), np.float32), run


@pytest.mark.parametrize("orders", [[None, None], [1, 1], [None, 1], [1, None]])
def test_a_stream_that_brings_its_first_blocks_is_heard_at_once_after_the_one_before(one_page, orders):
    left, run = played(one_page, orders=orders, lead=13)
    switched = 20 * STEP_BLOCKS * BLOCK
    # From the first's fade-in on there is always sound, and no step.
    begun = np.argmax(left > 0.99 * BEFORE)
    assert 0 < begun < switched / 2
    assert left[begun:].min() > 0.9 * BEFORE
    assert np.abs(np.diff(left[begun:])).max() < 0.02
    assert np.argmax(left > 0.99 * AFTER) < switched + 2 * BLOCK
    np.testing.assert_allclose(left[switched + 2 * BLOCK :], AFTER, atol=1e-4)
    assert run["counters"]["underruns"] == 0
    assert run["counters"]["blocks"] > 100  # of both
    # Poses are those of the first stream until it ends, and then those of the second.
    (began,) = np.flatnonzero(np.diff(run["heard"]) < 0)
    assert run["heard"][began] < 20 * STEP_BLOCKS
    assert run["heard"][began + 1] < 13


def test_what_is_there_is_played_to_its_end_and_that_is_no_dropout(one_page):
    """The next stream brings nothing at first, and what there is of the other lasts for a tenth of a second."""
    left, run = played(one_page, orders=[1, 1], lead=0)
    switched = 20 * STEP_BLOCKS * BLOCK
    np.testing.assert_allclose(left[switched - BLOCK : switched + BLOCK], BEFORE, atol=1e-4)
    np.testing.assert_allclose(left[-4 * BLOCK :], AFTER, atol=1e-4)
    assert np.abs(np.diff(left)).max() < 0.02
    assert run["counters"]["underruns"] == 0
