"""Blocks in Opus in the browser: what it decodes is what libopus decodes, sample by sample in its place."""

import base64

import numpy as np
import pytest

from server.protocol.blocks import AudioBlock
from server.protocol.codecs import libopus
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockEncoder
from tests import visitor

browser = visitor.browser
page = visitor.one_page
pytestmark = [*visitor.needs_browser, pytest.mark.skipif(not libopus.is_available(), reason="no libopus")]

RATE = 48_000

READ = """async ({ opus, messages }) => {
  const { parsePackets } = await import(new URL("nafir/wire.js", document.baseURI));
  const { OpusReader } = await import(new URL("nafir/opus.js", document.baseURI));
  const text = (bytes) => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
  return new Promise((resolve, reject) => {
    const found = [];
    const reader = new OpusReader(opus, ({ sampleClock, channels }) => {
      found.push([sampleClock, channels.map((samples) => text(new Uint8Array(samples.buffer)))]);
      if (found.length === messages.length) resolve(found);
    }, reject);
    for (const message of messages) {
      const bytes = Uint8Array.from(atob(message), (char) => char.charCodeAt(0));
      const { header, packets } = parsePackets(bytes.buffer);
      reader.read(header, packets, (header.flags & 8) !== 0);
    }
  });
}"""

SPLIT = """async (message) => {
  const { parsePackets } = await import(new URL("nafir/wire.js", document.baseURI));
  const bytes = Uint8Array.from(atob(message), (char) => char.charCodeAt(0));
  const whole = parsePackets(bytes.buffer).packets.map(({ length }) => length);
  let refused = 0;
  for (let size = 0; size < bytes.length; size++) {
    try {
      parsePackets(bytes.slice(0, size).buffer);
    } catch (error) {
      if (!(error instanceof TypeError)) throw error;
      refused += 1;
    }
  }
  return [whole, refused];
}"""


def tones(channels: int, seconds: float) -> np.ndarray:
    """(channel, n), a few partials of its own in each."""
    time = np.arange(round(seconds * RATE)) / RATE
    hertz = 110.0 * (1 + np.arange(channels))[:, None, None] * np.arange(1, 5)[:, None]
    return np.float32(0.1 * np.sin(2 * np.pi * hertz * time).sum(axis=1))


def messages_of(sound: np.ndarray, options: OpusOptions, clocks: list[int]) -> tuple[BlockEncoder, list[bytes]]:
    """The blocks of 256 samples from each of these clocks on, as they are sent."""
    encoder = BlockEncoder(options, channels=len(sound), sample_rate=RATE)
    messages = []
    for sequence, clock in enumerate(clocks):
        block = AudioBlock(sequence, clock, 0, 0, sound[:, clock : clock + 256])
        messages.append(block.serialize_packets(encoder.encode(clock, block.samples)))
    return encoder, messages


@pytest.mark.parametrize(("channels", "frame_ms"), [(1, 10), (2, 5), (2, 20), (4, 10), (9, 10)])
def test_the_browser_hears_what_was_encoded_where_it_was(page, channels, frame_ms):
    sound = tones(channels, 0.6)
    clocks = list(range(0, 20_000, 256))
    del clocks[40:44]  # which the server skipped
    encoder, messages = messages_of(sound, OpusOptions(frame_ms=frame_ms, bitrate=256_000), clocks)
    found = page.evaluate(
        READ,
        {
            "opus": encoder.streams.model_dump(),
            "messages": [base64.b64encode(message).decode() for message in messages],
        },
    )
    heard = np.full_like(sound, np.nan)
    for clock, planes in found:
        samples = np.array([np.frombuffer(base64.b64decode(plane), np.float32) for plane in planes])
        heard[:, clock : clock + samples.shape[1]] = samples[:channels]
    gap = slice(40 * 256 - RATE * 25 // 1000, 44 * 256 + 1_000)  # and what the encoder had not given out
    for part in (slice(1_000, gap.start), slice(gap.stop, clocks[-1] - RATE * 25 // 1000)):
        error = heard[:, part] - sound[:, part]
        assert 10 * np.log10(np.mean(sound[:, part] ** 2) / np.mean(error**2)) > 20


def test_a_block_that_is_cut_short_is_refused(page):
    _, messages = messages_of(tones(2, 0.1), OpusOptions(frame_ms=5), [0, 256, 512])
    message = next(each for each in messages if len(each) > AudioBlock.HEADER_BYTES)
    whole, refused = page.evaluate(SPLIT, base64.b64encode(message).decode())
    assert sum(length + 2 for length in whole) == len(message) - AudioBlock.HEADER_BYTES
    assert refused == len(message) - len(whole)  # all but those that end where a packet does, or the header
