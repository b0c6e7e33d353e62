"""What the player's buffer promises, on a simulated clock: blocks of 256 come in, quanta of 128 go out, at 24 kHz, or
blocks of 512 at 44.1 and 48 kHz."""

import base64
import math
from typing import Any

import numpy as np
import pytest

from tests import visitor

browser = visitor.browser
one_page = visitor.one_page
pytestmark = visitor.needs_browser


SIMULATE = """async ({ seconds, skew, delays, stalls = {}, spacing = 0, rate = 24_000 }) => {
  const { JitterBuffer } = await import(new URL("nafir/jitterbuffer.js", document.baseURI));
  const size = rate === 24_000 ? 256 : 512;
  const buffer = new JitterBuffer({ sampleRate: rate });
  const tone = (n) => 0.5 * Math.sin((2 * Math.PI * 220 * n) / rate);
  const played = [];
  const heard = [];
  const fills = [];
  const underruns = [];
  const stretches = [];
  const targets = [];
  let sent = 0;
  let last = -Infinity;
  for (let now = 0; now < seconds * rate; now += 128) {
    // The sender's clock runs `skew` fast; a block leaves when it is whole and comes in order after its delay, and
    // `spacing` after the one before at the soonest.
    for (;;) {
      const delay = stalls[sent / size] ?? (delays.length ? delays[(sent / size) % delays.length] : 0);
      const arrival = Math.max((sent + size) / (1 + skew) + delay * rate, last + spacing * rate);
      if (arrival > now) break;
      last = arrival;
      const left = Float32Array.from({ length: size }, (_, i) => tone(sent + i));
      const channels = [left, left.map((value) => -value)];
      buffer.push({ channels, sampleClock: sent, poseId: sent / size, late: false });
      sent += size;
    }
    const left = new Float32Array(128);
    const right = new Float32Array(128);
    for (const { poseId, offset } of buffer.pull([left, right])) heard.push([poseId, played.length + offset]);
    played.push(...left);
    fills.push(buffer.fill / rate);
    targets.push(buffer.target / rate);
    underruns.push(buffer.counters.underruns);
    stretches.push(buffer.counters.stretches);
  }
  let steepest = 0;
  for (let i = 1; i < played.length; i++) steepest = Math.max(steepest, Math.abs(played[i] - played[i - 1]));
  const packed = (values) => {
    const bytes = new Uint8Array(Float64Array.from(values).buffer);
    let text = "";
    for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192));
    return btoa(text);
  };
  const series = { played: played.slice(-3 * rate), heard: heard.flat(), fills, targets, underruns, stretches };
  for (const name in series) series[name] = packed(series[name]);
  return { series, before: played.length - 3 * rate, counters: buffer.counters, steepest };
}"""
"""Series come as base64: playwright passes an array number by number, which takes seconds."""


def simulate(page, parameters: dict[str, object]) -> dict[str, Any]:
    run = page.evaluate(SIMULATE, parameters)
    series = {name: np.frombuffer(base64.b64decode(text)) for name, text in run.pop("series").items()}
    return run | series | {"heard": series["heard"].reshape(-1, 2)}


def tone(samples: np.ndarray, rate: int) -> np.ndarray:
    return 0.5 * np.sin(2 * np.pi * 220 * samples / rate)


STEEPEST_TONE = 0.5 * 2 * math.pi * 220 / 24_000
RATES = pytest.mark.parametrize("rate", [24_000, 44_100, 48_000])


SETTLED_S = 25
"""After which the larger buffer of a start has been given back."""
QUANTA_PER_S = 24_000 / 128


@RATES
def test_on_a_steady_network_the_buffer_plays_every_sample_unchanged_once_it_has_settled(one_page, rate):
    run = simulate(one_page, {"seconds": 40, "skew": 0, "delays": [], "rate": rate})
    size = 256 if rate == 24_000 else 512
    assert run["counters"]["underruns"] == 0
    assert run["counters"]["splices"] > 0
    assert run["steepest"] < 1.5 * STEEPEST_TONE * 24_000 / rate
    # Pose n is heard with the first sample of block n, and so says where in the tone the output is.
    pose, at = run["heard"][-1]
    delay = at - size * pose
    assert 0.02 < delay / rate < 0.045
    assert all(at - size * pose == delay for pose, at in run["heard"] if at > SETTLED_S * rate)
    played, first = run["played"], run["before"]
    np.testing.assert_allclose(played, tone(np.arange(first, first + len(played)) - delay, rate), atol=1e-7)


def test_a_stall_while_everything_starts_is_not_heard(one_page):
    """A tenth of a second without a block, as where the page draws its map and the sound card opens."""
    run = simulate(one_page, {"seconds": 28, "skew": 0, "delays": [], "stalls": {"20": 0.1, "60": 0.1}})
    assert run["counters"]["underruns"] == 0
    fills = run["fills"][round(SETTLED_S * QUANTA_PER_S) :]
    assert fills.mean() < run["targets"][-1] + 0.02


@pytest.mark.parametrize("spacing", [0, 0.005], ids=["at once", "in a row"])
@pytest.mark.parametrize(("block", "stall_s"), [(10, 0.6), (600, 0.15), (600, 0.6)])
def test_after_a_dropout_the_buffer_comes_back_to_its_aim(one_page, block, stall_s, spacing):
    """What stalled comes in a burst, and would be delay for as long as it is kept."""
    # Blocks come in order: those after it wait for it, and a socket hands them on one by one, so that playing goes on
    # before all of them are there.
    parameters = {"seconds": 40, "skew": 0, "delays": [], "stalls": {str(block): stall_s}, "spacing": spacing}
    run = simulate(one_page, parameters)
    assert run["counters"]["underruns"] <= 1
    later = round((block * 256 / 24_000 + stall_s + SETTLED_S) * QUANTA_PER_S)
    fills, targets = run["fills"], run["targets"]
    assert len(fills) - later > 2 * QUANTA_PER_S
    assert (fills - targets)[later:].mean() < 0.02
    assert run["steepest"] < 1.5 * STEEPEST_TONE


@RATES
@pytest.mark.parametrize("skew", [1e-3, -1e-3])
def test_clock_drift_is_absorbed_without_dropouts_or_clicks(one_page, skew, rate):
    run = simulate(one_page, {"seconds": 50, "skew": skew, "delays": [], "rate": rate})
    assert run["counters"]["underruns"] == run["counters"]["gaps"] == run["counters"]["overflows"] == 0
    assert run["counters"]["splices"] > 0
    assert run["counters"]["stretches"] == 0  # nothing is late
    assert max(run["fills"][-2000:]) < 0.1
    assert run["steepest"] < 1.5 * STEEPEST_TONE * 24_000 / rate


def test_after_a_few_dropouts_the_buffer_outgrows_the_jitter(one_page):
    delays = [0.0] * 40 + [0.11] + [0.0] * 52
    run = simulate(one_page, {"seconds": 40, "skew": 0, "delays": delays})
    assert run["underruns"][-1] == run["underruns"][len(run["underruns"]) // 4] <= 5
    assert run["steepest"] < 1.5 * STEEPEST_TONE


@RATES
@pytest.mark.parametrize("stall_s", [0.02, 0.03, 0.04])
def test_what_is_rarely_late_is_stretched_over_and_leaves_no_delay(one_page, stall_s, rate):
    parameters = {"seconds": 58, "skew": 0, "delays": [], "stalls": {str(30 * 24_000 // 256): stall_s}, "rate": rate}
    run = simulate(one_page, parameters)
    assert run["counters"]["underruns"] == 0
    assert 0 < run["counters"]["stretches"] <= 4
    assert run["stretches"][round(29 * len(run["stretches"]) / 58)] == 0
    assert run["steepest"] < 1.5 * STEEPEST_TONE * 24_000 / rate
    before, after = (run["fills"][round(s * rate / 128) :][: rate // 128].mean() for s in (29, 56))
    assert after < before + 0.008


def test_a_late_block_in_twenty_seconds_does_not_lengthen_the_buffer(one_page):
    delays = [0.0] * 1874 + [0.035]
    run = simulate(one_page, {"seconds": 82, "skew": 0, "delays": delays})
    assert run["counters"]["underruns"] == 0
    assert run["counters"]["stretches"] > 0
    assert np.median(run["fills"][round(60 * QUANTA_PER_S) :]) < 0.045


def test_for_blocks_that_are_often_late_there_is_room_in_the_buffer(one_page):
    """Stretched over are those alone that come before the buffer knows them."""
    delays = [0.0] * 187 + [0.04]  # one in two seconds
    run = simulate(one_page, {"seconds": 60, "skew": 0, "delays": delays})
    assert run["counters"]["underruns"] == 0
    assert run["stretches"][-1] == run["stretches"][len(run["stretches"]) // 2]
    assert np.median(run["fills"][round(40 * QUANTA_PER_S) :]) > 0.045


def test_a_long_silence_is_a_dropout_after_a_few_stretches(one_page):
    run = simulate(one_page, {"seconds": 40, "skew": 0, "delays": [], "stalls": {"2800": 0.3}})
    assert run["counters"]["underruns"] == 1
    assert 4 <= run["counters"]["stretches"] <= 8  # four before it, and four where playing begins again
    assert run["steepest"] < 1.5 * STEEPEST_TONE


RELEASE = """async () => {
  const { buffersOf, newChannels, release } = await import("./nafir/channels.js");
  const channels = newChannels(4, 512);
  const { port1, port2 } = new MessageChannel();
  const arrived = new Promise((resolve) => (port2.onmessage = ({ data }) => resolve(data)));
  port1.postMessage(channels, buffersOf(channels));
  const received = await arrived;
  const lengths = received.map(({ length }) => length);
  release(received);
  return { left: channels[0].length, lengths, then: received.map(({ length }) => length) };
}"""


def test_channels_are_handed_on_and_freed_when_they_are_read(one_page):
    """And not when the browser next looks for garbage, which would stop the audio thread."""
    assert one_page.evaluate(RELEASE) == {"left": 0, "lengths": [512] * 4, "then": [0] * 4}
