"""Blocks in Opus in the browser: what it decodes is what libopus decodes, sample by sample in its place."""

import base64

import numpy as np
import pytest

from server.protocol.blocks import AudioBlock, DryBlock, DryPackets
from server.protocol.codecs import libopus
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockEncoder, LiveDecoders
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
      const bytesOf = ({ buffer, byteOffset, byteLength }) => new Uint8Array(buffer, byteOffset, byteLength);
      found.push([sampleClock, channels.map((samples) => text(bytesOf(samples)))]);
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


SPEAK = """async ({ encoding, opus, blocks, withoutEncoder, failAt }) => {
  const { Stream, now } = await import(new URL("nafir/stream.js", document.baseURI));
  const { AudioEncoder } = globalThis;
  if (withoutEncoder) delete globalThis.AudioEncoder;
  const encoders = [];
  if (failAt !== null) {
    globalThis.AudioEncoder = class extends AudioEncoder {
      constructor(callbacks) {
        super(callbacks);
        encoders.push({ fail: () => (super.close(), callbacks.error(new DOMException("lost"))) });
      }
    };
  }
  const sent = [];
  const { send } = WebSocket.prototype;
  WebSocket.prototype.send = function (data) {
    if (typeof data !== "string" && new Uint8Array(data)[0] === 3) sent.push(new Uint8Array(data.slice(0)));
    send.call(this, data);
  };
  const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  const refused = [];
  let isLive = false;
  const ignore = () => {};
  const stream = new Stream({
    url: new URL("v1/stream", document.baseURI).href.replace(/^http/, "ws"),
    hello: { scene: "apartment", sampleRate: 48_000, encoding, opus },
    listener: { position: [2, 2, 1.5], at: now() },
    emitters: [{ id: "voice", live: true, position: [3, 2, 1.5], at: now() }],
    listeners: {
      ...Object.fromEntries(["block", "clock", "posed", "status", "level", "effects"].map((name) => [name, ignore])),
      refused: ({ code }) => refused.push(code),
      state: ({ state }) => (isLive ||= state === "live"),
    },
  });
  while (!isLive) await pause(20);
  await pause(500); // the emitter is added, and the browser asked whether it encodes
  const tone = (i) => 0.3 * Math.sin((2 * Math.PI * 440 * i) / 48_000);
  for (let block = 0; block < blocks; block++) {
    if (block === failAt) encoders.at(-1).fail();
    stream.feed("voice", Float32Array.from({ length: 256 }, (_, i) => tone(256 * block + i)));
    await pause(5);
  }
  await pause(500);
  stream.close();
  WebSocket.prototype.send = send;
  globalThis.AudioEncoder = AudioEncoder;
  const text = (bytes) => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
  return { sent: sent.map(text), refused };
}"""


def spoken(page, **options) -> tuple[list[bytes], np.ndarray]:
    """The dry blocks that the page has sent of a tone, and what the server makes of them."""
    asked = {"encoding": "opus", "opus": {"bitrate": 128_000}, "blocks": 150, "withoutEncoder": False, "failAt": None}
    said = page.evaluate(SPEAK, asked | options)
    assert said["refused"] == []
    messages = [base64.b64decode(text) for text in said["sent"]]
    blocks = [DryBlock.parse(message) for message in messages]
    assert {block.id for block in blocks} == {"voice"}
    assert [block.sequence for block in blocks] == list(range(len(blocks)))
    decoders = LiveDecoders(RATE, 1)
    heard = [decoders.decode(block) if isinstance(block, DryPackets) else block for block in blocks]
    assert all(block.concealed == 0 for block in heard)
    return messages, np.concatenate([block.samples for block in heard])


def error_of_tone(heard: np.ndarray) -> float:
    """The power of what is no tone of this pitch, in decibels relative to it: an encoder's delay shifts its phase."""
    time = np.arange(len(heard)) / RATE
    basis = np.stack([np.sin(2 * np.pi * 440 * time), np.cos(2 * np.pi * 440 * time)])
    fitted = basis.T @ np.linalg.lstsq(basis.T, heard, rcond=None)[0]
    assert np.sqrt(2 * np.mean(fitted**2)) == pytest.approx(0.3, rel=0.05)
    return 10 * np.log10(np.mean((heard - fitted) ** 2) / np.mean(fitted**2))


@pytest.mark.parametrize("frame_ms", [5, 20])
def test_live_sound_goes_up_in_opus_where_the_stream_is(page, frame_ms):
    messages, heard = spoken(page, opus={"bitrate": 128_000, "frame_ms": frame_ms})
    assert {message[1] for message in messages} == {2}
    assert len(heard) / RATE == pytest.approx(150 * 256 / RATE, abs=0.03)
    assert error_of_tone(heard[4_800:]) < -20
    assert sum(map(len, messages)) < 0.15 * 4 * len(heard)


def test_a_browser_that_encodes_no_opus_sends_half_the_bytes(page):
    messages, heard = spoken(page, withoutEncoder=True)
    assert {message[1] for message in messages} == {1}
    assert error_of_tone(heard) < -80
    assert len(heard) == 150 * 256


def test_a_browser_whose_encoder_fails_goes_on_with_samples(page):
    messages, heard = spoken(page, failAt=75)
    kinds = [message[1] for message in messages]
    assert kinds == sorted(kinds, reverse=True)
    assert set(kinds) == {1, 2}
    assert error_of_tone(heard[-50 * 256 :]) < -80


@pytest.mark.parametrize(("encoding", "kind"), [("s16", 1), ("f32", 0)])
def test_live_sound_is_as_exact_as_the_stream(page, encoding, kind):
    messages, heard = spoken(page, encoding=encoding, opus=None, blocks=20)
    assert {message[1] for message in messages} == {kind}
    expected = 0.3 * np.sin(2 * np.pi * 440 * np.arange(20 * 256) / RATE)
    np.testing.assert_allclose(heard, expected, atol=1e-7 if kind == 0 else 0.6 / 32_767)
