"""Audio files whose headers lie, and channels that cancel each other: what is read is what the file holds."""

import io
import os
import struct

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st

from server.assets.audio_file import AudioFileError, read_audio, to_mono

RATE = 48_000
SOUND = (0.2 * np.sin(2 * np.pi * 440 * np.arange(24_000) / RATE)).astype(np.float32)


def encoded(samples=SOUND, form="WAV", subtype="PCM_16"):
    buffer = io.BytesIO()
    soundfile.write(buffer, samples, RATE, format=form, subtype=subtype)
    return buffer.getvalue()


def wav(declared=None, *, before=b"", after=b"", samples=SOUND, order="<"):
    """By hand: `declared` bytes in place of those that there are."""
    data = np.round(samples * 32768).astype(f"{order}i2").tobytes()
    declared = len(data) if declared is None else declared
    chunks = b"fmt " + struct.pack(f"{order}IHHIIHH", 16, 1, 1, RATE, 2 * RATE, 2, 16)
    body = b"WAVE" + before + chunks + b"data" + struct.pack(f"{order}I", declared) + data + after
    return (b"RIFF" if order == "<" else b"RIFX") + struct.pack(f"{order}I", len(body)) + body


def chunk(name, content):
    return name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)


@pytest.fixture
def read(tmp_path):
    def read_bytes(content):
        (tmp_path / "a.wav").write_bytes(content)
        return read_audio(tmp_path / "a.wav")

    return read_bytes


HONEST = {
    "plain": wav(),
    "junk before": wav(before=chunk(b"JUNK", bytes(28)) + chunk(b"bext", b"x" * 603)),
    "a list behind": wav(after=chunk(b"LIST", b"INFOISFT" + struct.pack("<I", 4) + b"abc\0")),
    "two chunks behind, one odd": wav(after=chunk(b"id3 ", b"x" * 33) + chunk(b"LGWV", bytes(100))),
    "an ID3 tag behind": wav(after=b"TAG" + bytes(125)),
    "zeros behind": wav(after=bytes(2048)),
    "big-endian": wav(order=">"),
    "RF64": encoded(form="RF64"),
    "W64": encoded(form="W64"),
    "AIFF": encoded(form="AIFF"),
    "AU": encoded(form="AU"),
    "FLAC": encoded(form="FLAC"),
    "CAF": encoded(form="CAF"),
    "float": encoded(subtype="FLOAT"),
    "ADPCM": encoded(subtype="IMA_ADPCM"),
}


@pytest.mark.parametrize("content", HONEST.values(), ids=HONEST)
def test_honest_files_are_read_whole_without_a_word(read, content):
    recording = read(content)
    assert (recording.finding, recording.is_cut, recording.sample_rate) == ("", False, RATE)
    expected, _ = soundfile.read(io.BytesIO(content), dtype="float32", always_2d=True)
    np.testing.assert_array_equal(recording.samples, expected)
    assert len(expected) >= len(SOUND)


@pytest.mark.parametrize("declared", [0, 2, 1000, 1001, 47_000, 0xFFFFFFFF, 0x7FFFFFFF, 0xFFFFFFD0])
@pytest.mark.parametrize("order", "<>")
def test_sound_that_the_header_does_not_tell_of_is_read(read, declared, order):
    recording = read(wav(declared, order=order))
    np.testing.assert_allclose(recording.samples[:, 0], SOUND, atol=1e-4)
    assert not recording.is_cut
    assert "24000 samples (0.5 s) were read" in recording.finding


@pytest.mark.parametrize("form", ["WAV", "RF64", "AIFF", "AU", "FLAC", "OGG", "MP3"])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.9])
def test_a_file_that_breaks_off_is_read_until_there_and_says_so(read, form, share):
    sounds = np.random.default_rng(0).standard_normal(3 * RATE).astype(np.float32) * 0.1
    whole = encoded(sounds, form, {"OGG": "VORBIS", "MP3": "MPEG_LAYER_III"}.get(form, "PCM_16"))
    recording = read(whole[: int(share * len(whole))])
    assert recording.is_cut
    assert recording.finding.startswith("it is cut off")
    assert f"{len(recording.samples)} samples" in recording.finding
    most_of_a_page = 0.2 if form == "OGG" else 0.05
    assert len(recording.samples) == pytest.approx(share * len(sounds), abs=most_of_a_page * len(sounds))


def test_a_header_that_promises_the_sky_allocates_no_sky(read):
    flac = bytearray(encoded(form="FLAC"))
    flac[21] |= 0x0F  # 36 bits of samples, of which these are the first
    recording = read(bytes(flac))
    assert recording.is_cut
    count = len(recording.samples)
    assert len(SOUND) - 16 <= count <= len(SOUND)
    np.testing.assert_allclose(recording.samples[:, 0], SOUND[:count], atol=1e-4)


@pytest.mark.parametrize("rate", [48, 1, 4_000_000])
def test_rates_that_are_not_of_audio_are_refused(read, rate):
    with pytest.raises(AudioFileError, match=f"rate of {rate} Hz is not one of audio"):
        read(wav().replace(struct.pack("<I", RATE), struct.pack("<I", rate), 1))


def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.wav")
    with pytest.raises(AudioFileError, match="not a regular file"):
        read_audio(tmp_path / "pipe.wav")


@given(st.binary(max_size=400), st.integers(0, 100), st.integers(0, 255))
def test_any_bytes_are_read_or_refused(tmp_path_factory, data, at, value):
    path = tmp_path_factory.getbasetemp() / "any.wav"
    spoilt = bytearray(wav(after=chunk(b"LIST", b"abc")))
    spoilt[at] = value
    for content in (data, b"RIFF" + data[:4].ljust(4) + b"WAVE" + data, b"OggS" + data, bytes(spoilt)):
        path.write_bytes(content)
        try:
            recording = read_audio(path)
        except AudioFileError:
            continue
        assert recording.samples.ndim == 2


LEFT = np.random.default_rng(1).standard_normal(60_000).astype(np.float32) * 0.1
OTHER = np.random.default_rng(2).standard_normal(60_000).astype(np.float32) * 0.1


@pytest.mark.parametrize("gain", [-1.0, -0.9, -0.5])
def test_channels_of_opposite_phase_give_the_louder_one(gain):
    mono, told = to_mono(np.column_stack([LEFT, gain * LEFT]))
    np.testing.assert_array_equal(mono, LEFT)
    assert "cancel each other" in told
    assert "channel 1" in told
    mono, told = to_mono(np.column_stack([gain * 2.5 * LEFT, LEFT]))
    np.testing.assert_array_equal(mono, gain * 2.5 * LEFT)


def test_channels_that_cancel_for_a_while_are_found_too():
    right = LEFT.copy()
    right[20_000:40_000] *= -1
    mono, told = to_mono(np.column_stack([LEFT, right]))
    assert np.sum(mono[20_000:40_000] ** 2) == pytest.approx(np.sum(LEFT[20_000:40_000] ** 2))
    assert "opposite phase" in told


@pytest.mark.parametrize("right", [LEFT, 0.1 * LEFT, 0 * LEFT, OTHER, np.roll(LEFT, 9), 0.8 * OTHER - 0.4 * LEFT])
def test_channels_that_do_not_cancel_are_averaged_without_a_word(right):
    mono, told = to_mono(np.column_stack([LEFT, right]))
    assert told == ""
    np.testing.assert_allclose(mono, (LEFT + right) / 2, atol=1e-7)


def test_a_channel_that_is_asked_for_is_taken():
    samples = np.column_stack([LEFT, -LEFT, OTHER])
    for channel in range(3):
        mono, told = to_mono(samples, channel)
        np.testing.assert_array_equal(mono, samples[:, channel])
        assert told == ""
    with pytest.raises(AudioFileError, match="no channel 4, only 3"):
        to_mono(samples, 3)


def test_four_channels_in_two_pairs_that_cancel_are_found():
    assert "4 channels cancel" in to_mono(np.column_stack([LEFT, -LEFT, OTHER, -OTHER]))[1]
