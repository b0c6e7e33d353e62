"""Blocks in Opus: exact clocks, faithful sound, and packets that are none. Live input in Opus: losses are filled in."""

import struct
from contextlib import suppress
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.core.errors import RequestError
from server.protocol.blocks import AudioBlock, DryBlock, DryPackets, join_packets, split_packets
from server.protocol.client_messages import PROTOCOL, Hello, ListenerPose, parse_client_message
from server.protocol.codecs import libopus
from server.protocol.codecs.libopus import OpusDecoder, OpusEncoder, OpusError
from server.protocol.codecs.registry import require_encoding
from server.protocol.opus import OpusOptions, channels_of_streams
from server.protocol.packets import BlockEncoder, BlockReader, LiveDecoder, LiveDecoders
from tests.hard_cases.listening import Listening
from tests.signals import noise

RATE = 24_000
APPLICATIONS = ["low_delay", "audio", "voip"]


def sound(channels, frames, rate=RATE, lowest_hz=200):
    """Tones that differ from channel to channel, and a little noise: (channel, frame)."""
    time_s, channel = np.arange(frames) / rate, np.arange(channels)[:, None]
    tones = 0.25 * np.sin(2 * np.pi * (lowest_hz + 31 * channel) * time_s + channel)
    return (tones + 0.02 * noise(channels, channels, frames)).astype(np.float32)


def reader_of(encoder, rate=RATE):
    return BlockReader(SimpleNamespace(encoding="opus", opus=encoder.streams, sample_rate=rate))


def blocks_of(samples, size, start=0):
    for sequence, at in enumerate(range(0, samples.shape[1], size)):
        yield AudioBlock(sequence, start + at, 7, 5, samples[:, at : at + size])


def sent(samples, size, options, rate=RATE):
    """The blocks that a client reads."""
    encoder = BlockEncoder(options, channels=len(samples), sample_rate=rate)
    reader = reader_of(encoder, rate)
    for block in blocks_of(samples, size):
        yield reader.read(block.serialize_packets(encoder.encode(block.sample_clock, block.samples)))


def snr_db(heard, true):
    return 10 * np.log10(np.sum(np.square(true, dtype=float)) / np.sum(np.square(heard - true, dtype=float)))


@pytest.mark.parametrize("application", APPLICATIONS)
@pytest.mark.parametrize("frame_ms", [5, 10, 20])
@pytest.mark.parametrize(("size", "rate", "channels"), [(128, 24_000, 2), (1024, 24_000, 4), (256, 48_000, 1)])
def test_what_is_heard_has_the_clock_of_what_was_rendered_to_a_sample(size, rate, channels, frame_ms, application):
    # voip takes the lowest frequencies away, with a filter that turns the phases above them.
    samples = sound(channels, 24 * 1024, rate, 1_500 if application == "voip" else 200)
    options = OpusOptions(frame_ms=frame_ms, bitrate=256_000, application=application)
    clock, heard = 0, []
    for block in sent(samples, size, options, rate):
        assert block.sample_clock == clock
        assert block.is_restart == (block.sequence == 0)
        heard.append(block.samples)
        clock += block.samples.shape[1]
    # All but what waits for its frame to be full, and the look-ahead.
    assert samples.shape[1] - clock < (frame_ms + 6.5) * rate / 1000
    heard = np.concatenate(heard, axis=1)[:, 1_000:-1]
    fits = [snr_db(heard, samples[:, 1_000 + lag : clock - 1 + lag]) for lag in (-1, 0, 1)]
    assert fits[1] > max(fits[0], fits[2]) + 3
    assert fits[1] > 18


@pytest.mark.parametrize("channels", [1, 2, 4, 9, 16])
def test_ambisonics_are_a_stream_for_each_pair_of_channels(channels):
    """Order 2 has nine: the last is alone. None is exchanged for another."""
    assert sum(channels_of_streams(channels)) == channels
    samples = sound(channels, 20 * 512)
    blocks = list(sent(samples, 512, OpusOptions(bitrate=256_000)))
    heard = np.concatenate([block.samples for block in blocks], axis=1)
    true = samples[:, : heard.shape[1]]
    fits = np.array([[snr_db(heard[a, 500:], true[b, 500:]) for b in range(channels)] for a in range(channels)])
    assert (np.argmax(fits, axis=1) == np.arange(channels)).all()
    assert np.diag(fits).min() > 15


def test_after_skipped_blocks_the_clock_is_exact_again():
    samples = sound(2, 40 * 256)
    encoder = BlockEncoder(OpusOptions(bitrate=256_000), channels=2, sample_rate=RATE)
    reader, heard = reader_of(encoder), np.zeros_like(samples)
    restarts, ends = [], []
    for block in blocks_of(samples, 256):
        if block.sequence in {*range(11, 14), 20}:
            continue
        read = reader.read(block.serialize_packets(encoder.encode(block.sample_clock, block.samples)))
        if read.is_restart:
            restarts.append(read.sample_clock)
        end = read.sample_clock + read.samples.shape[1]
        heard[:, read.sample_clock : end] = read.samples
        ends.append(end)
    assert restarts == [0, 14 * 256, 21 * 256]
    for start, end in ((14 * 256, 20 * 256 - 300), (21 * 256, ends[-1])):
        assert snr_db(heard[:, start:end], samples[:, start:end]) > 18
    lost = np.flatnonzero(~heard.any(axis=0))
    assert ((lost >= 11 * 256 - 300) & (lost < 21 * 256) | (lost >= ends[-1])).all()


@pytest.fixture
def walk(field, filters):
    """What a listener hears who walks past an emitter and turns: (2, n)."""
    listening = Listening(field, filters, clip=0.5 * noise(3, 3_000) * np.hanning(3_000).astype(np.float32))
    listening.add()
    heard = [listening.hear(1)]
    for step in range(1, 90):
        listening.say(ListenerPose(pose_id=step, position=(2.0 + step / 30, 2.0, 1.5), yaw=step / 40))
        heard.append(listening.hear(1))
    heard = np.concatenate(heard, axis=1)
    return (0.3 * heard / np.abs(heard).max()).astype(np.float32)


def decoded(walk, **options):
    heard = np.concatenate([block.samples for block in sent(walk, 256, OpusOptions(**options))], axis=1)
    return snr_db(heard, walk[:, : heard.shape[1]])


def test_streams_of_one_walk_agree_the_more_bits_the_better(walk):
    """Noise of full band, which is the hardest to code."""
    fits = [decoded(walk, bitrate=kilobits * 1_000) for kilobits in (48, 96, 192, 384)]
    assert all(better > worse + 2 for worse, better in pairwise(fits))
    assert fits[2] > 12
    assert fits[3] > 25
    whole = [AudioBlock.parse(block.serialize("f32"), "f32").samples for block in blocks_of(walk, 256)]
    assert np.array_equal(np.concatenate(whole, axis=1), walk)
    integers = [AudioBlock.parse(block.serialize("s16"), "s16").samples for block in blocks_of(walk, 256)]
    rounding_db = 20 * np.log10(np.sqrt(np.mean(np.square(walk, dtype=float)) * 12) * 32_767)
    assert abs(snr_db(np.concatenate(integers, axis=1), walk) - rounding_db) < 0.5


def test_more_complexity_and_longer_frames_do_not_sound_worse(walk):
    assert decoded(walk, complexity=10) > decoded(walk, complexity=0) - 0.2
    assert decoded(walk, frame_ms=20, bitrate=64_000) > decoded(walk, frame_ms=5, bitrate=64_000) - 0.2


def test_a_block_in_opus_has_the_documented_layout():
    encoder = BlockEncoder(OpusOptions(frame_ms=5), channels=4, sample_rate=RATE)
    samples = sound(4, 128)
    made = encoder.encode(0, samples)
    data = AudioBlock(3, 0, 12, 9, samples, is_late=True).serialize_packets(made)
    first, second = made.packets  # 120 of 128 samples, of which 60 are the look-ahead
    header = bytes([1, 10]) + struct.pack("<HIQIII", 4, 3, 0, 12, 9, 60)
    lengths = struct.pack("<H", len(first)), struct.pack("<H", len(second))
    assert data == header + lengths[0] + first + lengths[1] + second
    # 8 + 128 samples make one frame more of each stream. What comes is heard from sample 60 on.
    made = encoder.encode(128, samples)
    assert (made.sample_clock, made.frames, len(made.packets), made.is_restart) == (60, 120, 2, False)


def test_a_block_that_completes_no_frame_has_no_packet():
    encoder = BlockEncoder(OpusOptions(frame_ms=20), channels=2, sample_rate=RATE)
    samples = sound(2, 256)
    made = encoder.encode(0, samples)
    assert (made.frames, made.packets, made.is_restart) == (0, (), True)
    assert len(AudioBlock(0, 0, 0, 0, samples).serialize_packets(made)) == AudioBlock.HEADER_BYTES
    made = encoder.encode(256, samples)
    assert (made.sample_clock, made.frames, len(made.packets)) == (0, 420, 1)


def test_an_audio_block_cut_short_anywhere_is_none():
    samples = sound(4, 512)
    encoder = BlockEncoder(OpusOptions(), channels=4, sample_rate=RATE)
    whole = AudioBlock(0, 0, 0, 0, samples).serialize_packets(encoder.encode(0, samples))
    for length in range(len(whole)):
        with pytest.raises((ValueError, OpusError)):
            reader_of(encoder).read(whole[:length])
    assert reader_of(encoder).read(whole).samples.shape == (4, 420)


@given(st.lists(st.binary(min_size=1, max_size=300), min_size=1, max_size=6))
def test_packets_come_out_as_they_went_in(packets):
    assert split_packets(b"head" + join_packets(packets), 4) == tuple(packets)


def voice(packets, frame=480, **settings):
    """(dry samples, packets) of a swelling tone in frames of 20 ms."""
    samples = sound(1, packets * frame)[0] * np.linspace(0.3, 1, packets * frame, dtype=np.float32)
    given = {"application": "low_delay", "bitrate": 64_000, "complexity": 5} | settings
    encoder = OpusEncoder(sample_rate=RATE, channels=1, **given)
    return samples, [encoder.encode(each) for each in samples.reshape(packets, frame, 1)], encoder


def test_live_packets_become_samples_in_their_order():
    samples, packets, encoder = voice(20)
    decoder = LiveDecoder(RATE)
    pairs = [DryPackets("me", number, 960, tuple(packets[2 * number : 2 * number + 2])) for number in range(10)]
    blocks = [decoder.decode(DryBlock.parse(pair.serialize())) for pair in pairs]
    assert [(block.id, block.sequence, block.samples.shape, block.concealed) for block in blocks] == [
        ("me", number, (960,), 0) for number in range(10)
    ]
    heard = np.concatenate([block.samples for block in blocks])[encoder.look_ahead :]
    assert snr_db(heard, samples[: heard.size]) > 10


def test_lost_blocks_are_filled_in_and_the_sound_goes_on_in_its_place():
    samples, packets, encoder = voice(30)
    decoder = LiveDecoder(RATE)
    kept = [number for number in range(30) if number not in {12, 13, 20}]
    blocks = [decoder.decode(DryPackets("me", number, 480, (packets[number],))) for number in kept]
    assert {block.sequence: block.concealed for block in blocks if block.concealed} == {14: 960, 21: 480}
    heard = np.concatenate([block.samples for block in blocks])[encoder.look_ahead :]
    assert heard.size == samples.size - encoder.look_ahead
    kept_again = slice(16 * 480, 20 * 480)
    assert snr_db(heard[kept_again], samples[kept_again]) > 10
    gap = slice(12 * 480, 14 * 480 - encoder.look_ahead)
    assert np.abs(heard[gap]).max() > 0.1  # a guess, and no silence


def test_what_a_packet_says_of_the_lost_one_before_it_is_better_than_a_guess():
    """In-band FEC, which the encoder of a client may add: requests 4012 and 4014 of libopus."""

    def heard_without(number, *, has_fec):
        encoder = OpusEncoder(sample_rate=RATE, channels=1, application="voip", bitrate=32_000, complexity=10)
        for request, value in ((4012, has_fec), (4014, 30 * has_fec), (4024, 3001)):
            assert encoder._lib.encoder_ctl(encoder._state, request, libopus.ctypes.c_int32(value)) == 0
        # A glide, which cannot be guessed.
        time_s = np.arange(480 * 40) / RATE
        samples = (0.3 * np.sin(2 * np.pi * (150 * time_s + 900 * time_s**2))).astype(np.float32)
        packets = [encoder.encode(each) for each in samples.reshape(-1, 480, 1)]
        decoder = LiveDecoder(RATE)
        blocks = [
            decoder.decode(DryPackets("me", at, 480, (packet,))) for at, packet in enumerate(packets) if at != number
        ]
        heard = np.concatenate([block.samples for block in blocks])[encoder.look_ahead :]
        lost = slice(number * 480, (number + 1) * 480 - encoder.look_ahead)
        return snr_db(heard[lost], samples[lost])

    assert heard_without(30, has_fec=True) > heard_without(30, has_fec=False) + 3


def test_leaving_numbers_out_makes_no_more_work_than_sending():
    _, packets, _ = voice(8)
    decoder = LiveDecoder(RATE)
    sequences = [0, 2**31, 2**31 + 2, *(2**32 - 6 + each for each in range(0, 6, 2))]
    blocks = [decoder.decode(DryPackets("me", at, 480, (packets[0],))) for at in sequences]
    filled_in = np.cumsum([block.concealed for block in blocks])
    assert (filled_in <= 480 * np.arange(len(blocks))).all()
    assert filled_in[1] == 480
    for at in range(9, 40):
        decoder.decode(DryPackets("you", 2**32 + at, 480, (packets[1],)))
    assert decoder.decode(DryPackets("you", 2**33, 480, (packets[1],))).concealed == 0.12 * RATE


GOOD = voice(1)[1][0]
TOO_LONG = bytes([GOOD[0] & 0xFC | 3, 4]) + bytes(40)  # four frames of 20 ms in one packet


@pytest.mark.parametrize(
    ("block", "field"),
    [
        (DryPackets("a", 1, 481, (GOOD,)), "frames"),
        (DryPackets("a", 1, 480, (GOOD, GOOD)), "frames"),
        (DryPackets("a", 1, 1_920, (TOO_LONG,)), "frames"),
        (DryPackets("a", 1, 480, (bytes([0xFF, 0x3F]),)), "packets"),  # 63 frames
        (DryPackets("a", 1, 480, (bytes([GOOD[0] | 3]),)), "packets"),  # several frames, and not how many
        (DryPackets("a", 1, 960, (bytes([GOOD[0] & 0xFC | 2, 200, 1]),)), "packets"),  # the first is longer than both
    ],
)
def test_packets_that_cannot_be_are_refused_and_the_next_ones_are_heard(block, field):
    decoder = LiveDecoder(RATE)
    decoder.decode(DryPackets("a", 0, 480, (GOOD,)))
    with pytest.raises(RequestError) as caught:
        decoder.decode(block)
    assert (caught.value.code, caught.value.field) == ("malformed_block", field)
    # The refused one counts as lost.
    assert decoder.decode(DryPackets("a", 2, 480, (GOOD,))).concealed == 480


@given(st.lists(st.binary(min_size=1, max_size=1_500), min_size=1, max_size=3), st.integers(1, 3_000))
def test_any_bytes_are_samples_or_are_refused(packets, frames):
    for held in (frames, 480 * len(packets)):
        try:
            block = LiveDecoder(RATE).decode(DryPackets("a", 0, held, tuple(packets)))
        except RequestError as exc:
            refusal = exc
        else:
            assert block.samples.shape == (held,)
            continue
        assert refusal.code == "malformed_block"


def test_noise_after_the_first_byte_of_every_kind_of_packet_is_survived():
    """All 256 first bytes (mode, bandwidth, length, frames in the packet), one decoder for all."""
    decoder, draw, heard = LiveDecoder(RATE), np.random.default_rng(1), 0
    for first in range(256):
        for number in range(4):
            packet = bytes([first]) + draw.bytes(int(draw.integers(0, 400)))
            for frames in (60, 120, 240, 480, 960, 1_440):
                with suppress(RequestError):
                    block = decoder.decode(DryPackets("a", 10_000 * first + 10 * number, frames, (packet,)))
                    assert block.samples.size == frames + block.concealed
                    heard += 1
    assert heard > 300


def test_a_dry_block_cut_short_anywhere_is_refused_by_code():
    whole = DryPackets("violin", 4, 960, (GOOD, GOOD)).serialize()
    packets = DryPackets("violin", 4, 960, (GOOD,)).serialize()
    assert parse_client_message(whole) == DryPackets("violin", 4, 960, (GOOD, GOOD))
    for length in range(1, len(whole)):
        with pytest.raises(RequestError) as caught:
            LiveDecoder(RATE).decode(parse_client_message(whole[:length]))
        assert caught.value.code == "malformed_block"
        # Whole packets fewer than it says are found when they are decoded.
        assert length == len(packets) or caught.value.field in {"header", "packets", "frames", "id"}


def test_a_block_without_packets_or_frames_is_refused():
    for block in (DryPackets("a", 0, 480, ()), DryPackets("a", 0, 0, (GOOD,))):
        with pytest.raises(RequestError, match="frames"):
            parse_client_message(block.serialize())


def test_a_block_that_is_not_newer_is_stale():
    decoder = LiveDecoder(RATE)
    decoder.decode(DryPackets("a", 5, 480, (GOOD,)))
    with pytest.raises(RequestError) as caught:
        decoder.decode(DryPackets("a", 5, 480, (GOOD,)))
    assert (caught.value.code, caught.value.field) == ("stale_block", "sequence")


def test_emitters_have_decoders_of_their_own_and_no_more_than_there_may_be():
    decoders = LiveDecoders(RATE, most=2)
    for name in ("a", "b", "a"):
        decoders.decode(DryPackets(name, 5 + (name == "a") * len(decoders._decoders), 480, (GOOD,)))
    decoders.decode(DryPackets("c", 0, 480, (GOOD,)))
    assert list(decoders._decoders) == ["a", "c"]  # b has been idle for longest
    decoders.forget("a")
    decoders.forget("b")
    assert decoders.decode(DryPackets("a", 0, 480, (GOOD,))).sequence == 0


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"frame_ms": 2.5}, "opus.frame_ms"),
        ({"frame_ms": 40}, "opus.frame_ms"),
        ({"bitrate": 600_000}, "opus.bitrate"),
        ({"bitrate": 500}, "opus.bitrate"),
        ({"complexity": 11}, "opus.complexity"),
        ({"application": "games"}, "opus.application"),
        ({"signal": "noise"}, "opus.signal"),
        ({"bit_rate": 64_000}, "opus.bit_rate"),
    ],
)
def test_options_that_opus_lacks_are_refused_by_name(options, field):
    hello = Hello(protocol=PROTOCOL, scene="flat", encoding="opus").model_dump(mode="json", exclude_unset=True)
    text = f'{{"type": "hello", {str(hello)[1:-1]}, "opus": {options}}}'.replace("'", '"')
    with pytest.raises(RequestError) as caught:
        parse_client_message(text)
    assert (caught.value.code, caught.value.field) == ("malformed_message", field)


@pytest.mark.parametrize("option", OpusOptions.model_fields)
def test_every_option_within_its_bounds_makes_an_encoder(option):
    least = {"frame_ms": 5, "bitrate": 12_000, "complexity": 0, "application": "voip", "signal": "voice"}
    most = {"frame_ms": 20, "bitrate": 510_000, "complexity": 10, "application": "audio", "signal": "music"}
    for each in (least, most):
        encoder = BlockEncoder(OpusOptions(**{option: each[option]}), channels=3, sample_rate=48_000)
        assert encoder.encode(0, sound(3, 1024)).packets


def test_options_of_opus_belong_to_opus():
    with pytest.raises(RequestError, match="belongs to the encoding opus"):
        parse_client_message('{"type": "hello", "protocol": 3, "scene": "flat", "opus": {}}')


@pytest.mark.parametrize("rate", [22_050, 44_100, 96_000])
def test_another_rate_is_refused_and_told_what_to_do(rate):
    with pytest.raises(RequestError, match=r"not for .* use f32 or s16, or another rate") as caught:
        require_encoding("opus", rate)
    assert (caught.value.code, caught.value.field) == ("unsupported_encoding", "encoding")
    require_encoding("s16", rate)


def test_where_there_is_no_libopus_it_is_refused_and_nothing_else(monkeypatch):
    monkeypatch.setattr(libopus, "_library", lambda: None)
    with pytest.raises(RequestError, match=r"libopus is not installed\); use f32 or s16"):
        require_encoding("opus", RATE)
    with pytest.raises(RequestError) as caught:
        LiveDecoders(RATE, most=2).decode(DryPackets("a", 0, 480, (GOOD,)))
    assert caught.value.code == "unsupported_encoding"
    with pytest.raises(libopus.OpusMissingError, match="apt install"):
        OpusDecoder(sample_rate=RATE, channels=1)
    require_encoding("f32", RATE)


def test_a_library_of_that_name_without_the_functions_is_none(monkeypatch):
    monkeypatch.setattr(libopus, "_NAMES", {libopus.sys.platform: ("libc.so.6", "libnothing.so.9")})
    libopus._library.cache_clear()
    try:
        assert not libopus.is_available()
    finally:
        monkeypatch.undo()
        libopus._library.cache_clear()
    assert libopus.is_available()
    assert libopus.version().startswith("libopus")
