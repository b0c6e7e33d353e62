"""Streams in Opus, read by the Python client."""

import asyncio
import json

import numpy as np
import pytest

import nafir_client
from nafir_client import MissingLibraryError, ProtocolError, opus, wire
from nafir_client.session import Session
from server.assets.clips import ClipLibrary
from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.codecs import libopus
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockEncoder, LiveDecoders
from tests.clients.test_python_wire import WELCOME

needs_opus = pytest.mark.skipif(not libopus.is_available(), reason="libopus is not installed (apt install libopus0)")
RATE = 24_000


def sent(samples, *, block_size=256, options=None, skipped=()):
    """The welcome of a stream of samples (channel, frame) in Opus, and its blocks but those of some numbers."""
    encoder = BlockEncoder(options or OpusOptions(), channels=len(samples), sample_rate=RATE)
    blocks = []
    for number, start in enumerate(range(0, samples.shape[1] - block_size + 1, block_size)):
        if number not in skipped:
            block = AudioBlock(len(blocks), start, 0, 0, samples[:, start : start + block_size])
            blocks.append(block.serialize_packets(encoder.encode(start, block.samples)))
    streams = {"frame_samples": encoder.streams.frame_samples, "look_ahead": encoder.streams.look_ahead}
    given = {"encoding": "opus", "channels": len(samples), "block_size": block_size}
    welcome = {**json.loads(WELCOME), **given, "opus": {**streams, "streams": list(encoder.streams.streams)}}
    return json.dumps(welcome), blocks


def received(welcome, blocks):
    session = Session("flat", {"encoding": "opus"})
    session.first_message()
    session.greet(welcome, 0.0)
    return [session.receive(block, 0.0) for block in blocks], session.statistics


def tones(channels, frames):
    times_s = np.arange(frames) / RATE
    return np.stack([0.3 * np.sin(2 * np.pi * (400 + 100 * number) * times_s) for number in range(channels)]).astype(
        "f4"
    )


@needs_opus
@pytest.mark.parametrize(
    ("channels", "frame_ms", "block_size"), [(2, 5, 256), (1, 10, 128), (4, 20, 512), (9, 10, 256)]
)
def test_what_is_heard_is_what_was_sent_at_its_clock(channels, frame_ms, block_size):
    samples = tones(channels, 24_000)
    options = OpusOptions(frame_ms=frame_ms, bitrate=256_000)
    blocks, _ = received(*sent(samples, block_size=block_size, options=options))
    assert blocks[0].sample_clock == 0
    clocks = [block.sample_clock for block in blocks]
    assert np.array_equal(np.diff(clocks), [block.frames for block in blocks[:-1]])
    heard = np.concatenate([block.samples for block in blocks]).T
    error = heard[:, 2_400:] - samples[:, 2_400 : heard.shape[1]]
    assert 10 * np.log10(np.mean(error**2) / np.mean(samples**2)) < -20


@needs_opus
def test_after_skipped_blocks_the_sound_goes_on_at_its_clock():
    samples = tones(2, 24_000)
    blocks, counts = received(*sent(samples, skipped=range(40, 50)))
    assert counts.blocks_skipped >= 10
    last = blocks[-1]
    error = last.samples.T - samples[:, last.sample_clock : last.sample_clock + last.frames]
    assert 10 * np.log10(np.mean(error**2) / np.mean(samples**2)) < -20


@needs_opus
def test_live_sound_goes_up_in_opus():
    """What the server decodes is what was written, behind by the encoder's look-ahead of 2.5 ms."""
    samples = ClipLibrary(RATE).load("woman-reading").samples[: 2 * RATE]
    session = Session("flat", {"encoding": "opus", "opus": {"bitrate": 256_000}})
    session.first_message()
    session.greet(sent(tones(2, 256))[0], 0.0)
    live = session.live_input(4, 2.0)
    emitter = session.add_emitter({"id": "voice", "live": True, "position": (2.0, 2.5, 1.5)}, live)
    session.outbox.take()
    emitter.is_heard = True
    live.open()
    decoders, heard, size = LiveDecoders(RATE, 1), [], 0
    for start in range(0, len(samples), 100):  # as a microphone gives them
        live.write(samples[start : start + 100])
        session.pump()
        while (data := session.outbox.take()) is not None:
            size += len(data)
            heard.append(decoders.decode(DryBlock.parse(data)).samples)
        live.advance(100)
    decoded = np.concatenate(heard)
    lag = RATE // 400
    error = decoded[lag:] - samples[: len(decoded) - lag]
    assert len(decoded) > len(samples) - RATE // 100 - 4 * 256
    assert 10 * np.log10(np.mean(samples**2) / np.mean(error**2)) > 30
    assert size / len(decoded) < 4 / 5


@needs_opus
@pytest.mark.parametrize("cut", [1, 3, 40])
def test_packets_that_are_cut_short_are_refused(cut):
    welcome, blocks = sent(tones(2, 4_096))
    whole = next(block for block in blocks if len(block) > wire.BLOCK.size + 60)
    with pytest.raises(ProtocolError):
        received(welcome, [whole[:-cut]])


def test_without_libopus_a_stream_says_what_to_install(monkeypatch):
    monkeypatch.setattr(opus, "_NAMES", {"linux": ("libnone.so.0",), "darwin": (), "win32": ()})
    opus._library.cache_clear()
    with pytest.raises(MissingLibraryError, match="apt-get install libopus0"):
        nafir_client.connect("ws://127.0.0.1:1", scene="flat", encoding="opus")
    opus._library.cache_clear()


@needs_opus
def test_a_server_streams_in_opus(served):
    async def listen():
        async with nafir_client.connect(f"ws://{served}", scene="flat", encoding="opus") as stream:
            live = await stream.add_emitter()
            await live.write(np.random.default_rng(1).standard_normal(6_000).astype(np.float32) / 10)
            blocks = []
            async for block in stream:
                blocks.append(block)
                if len(blocks) == 60:
                    return blocks
        return []

    blocks = asyncio.run(asyncio.wait_for(listen(), 60))
    assert np.array_equal(np.diff([block.sample_clock for block in blocks]), [block.frames for block in blocks[:-1]])
    assert np.sqrt(np.mean(np.concatenate([block.samples for block in blocks]) ** 2)) > 1e-3
