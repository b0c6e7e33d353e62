"""Any file is decoded or refused in bounded memory and time, and never in the server's own process."""

import asyncio
import os
import signal
import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import soundfile

from server.assets.audio_file import AudioFileError
from server.assets.upload_decoder import DecodingLimits, TooLongError, decode_apart, decode_file
from server.core.errors import RequestError
from tests.assets.uploads import KINDS, encoded, mutated, tone

LIMITS = DecodingLimits(seconds=2.0)


def decode(tmp_path, content, limits=LIMITS):
    """In this process: what was decoded, and its samples."""
    source, target = tmp_path / "upload", BytesIO()
    source.write_bytes(content)
    decoded = decode_file(source, target, limits)
    target.seek(0)
    samples, rate = soundfile.read(target, dtype="float32")
    assert (len(samples), rate) == (decoded.frames, decoded.sample_rate)
    return decoded, samples


def decode_as_uploaded(tmp_path, content, limits=LIMITS):
    source, target = tmp_path / "upload", tmp_path / "decoded"
    source.write_bytes(content)
    return asyncio.run(decode_apart(source, target, limits)), soundfile.read(target, dtype="float32")[0]


KINDS_AND_CHANNELS = [(kind, channels) for kind in KINDS for channels in (1, 2)]
MANY_CHANNELS = [(kind, 8) for kind in KINDS if kind not in {"mp3", "opus"}]
"""MP3 has no more than two, and one of Opus' eight is for low frequencies alone."""


@pytest.mark.parametrize(("kind", "channels"), KINDS_AND_CHANNELS + MANY_CHANNELS)
def test_every_kind_of_file_sounds_as_it_did(tmp_path, kind, channels):
    decoded, samples = decode(tmp_path, encoded(kind, channels=channels))
    original = tone(0.5, channels=channels).mean(axis=1)
    assert (decoded.sample_rate, decoded.warning) == (48_000, "")
    assert abs(decoded.frames - original.size) < 4_000, "mp3 and opus may add some"
    spectrum = np.abs(np.fft.rfft(samples[:24_000]))
    assert np.argmax(spectrum) == 220
    level_db = 20 * np.log10(np.std(samples[4_000:20_000]) / np.std(original[4_000:20_000]))
    assert abs(level_db) < 0.5


def test_a_process_of_its_own_gives_the_same(tmp_path):
    content = encoded("flac")
    here, apart = decode(tmp_path, content), decode_as_uploaded(tmp_path, content)
    assert here[0] == apart[0]
    np.testing.assert_array_equal(here[1], apart[1])


@pytest.mark.parametrize(
    ("content", "error", "problem"),
    [
        (encoded("wav", 2.1), TooLongError, "lasts 2.1 s"),
        (encoded("mp3", 2.5), TooLongError, "at most 2 s"),
        (encoded("wav", 0.1, channels=9), TooLongError, "9 channels; at most 8"),
        (encoded("wav", 0.1, sample_rate=4_000), AudioFileError, "4000 Hz"),
        (b"", AudioFileError, "not an audio file"),
        (b"RIFF but not really", AudioFileError, "not an audio file"),
    ],
    ids=["long", "long mp3", "nine channels", "slow", "empty", "no file"],
)
def test_what_is_not_taken_is_refused_with_its_reason(tmp_path, content, error, problem):
    with pytest.raises(error, match=problem):
        decode(tmp_path, content)


def test_a_format_that_nobody_asked_for_is_not_decoded(tmp_path):
    file = BytesIO()
    soundfile.write(file, tone(0.1), 48_000, format="AIFF")
    with pytest.raises(AudioFileError, match="its format is AIFF, and none of wav, flac, ogg, mp3"):
        decode(tmp_path, file.getvalue())


def test_a_header_that_promises_an_hour_is_refused_before_room_is_made(tmp_path, monkeypatch):
    """A FLAC file of some bytes may say that it holds 2^36 samples."""
    content = bytearray(encoded("flac", 0.1))
    at = content.index(b"fLaC") + 8 + 13
    content[at + 1 : at + 5] = struct.pack(">I", 2**32 - 1)
    read = []
    monkeypatch.setattr(soundfile.SoundFile, "read", lambda *_, **__: read.append(1))
    with pytest.raises(TooLongError):
        decode(tmp_path, bytes(content))
    assert not read


def test_samples_that_are_no_audio_are_refused(tmp_path):
    for bad in (np.nan, np.inf, 1e30):
        file = BytesIO()
        soundfile.write(file, np.array([0.1, bad, 0.2], np.float32), 48_000, format="WAV", subtype="FLOAT")
        with pytest.raises(AudioFileError, match=r"not finite|not audio"):
            decode(tmp_path, file.getvalue())


def test_a_decoder_that_dies_or_never_ends_is_a_refusal(tmp_path, monkeypatch):
    async def fail(how, limits):
        (tmp_path / "upload").write_bytes(encoded("wav"))
        started = asyncio.create_subprocess_exec

        async def start(*command, **options):
            process = await started(*command, **options)
            os.kill(process.pid, how)
            return process

        monkeypatch.setattr(asyncio, "create_subprocess_exec", start)
        try:
            with pytest.raises(RequestError) as caught:
                await decode_apart(tmp_path / "upload", tmp_path / "decoded", limits)
        finally:
            monkeypatch.setattr(asyncio, "create_subprocess_exec", started)
        return caught.value

    killed = asyncio.run(fail(signal.SIGKILL, LIMITS))
    assert (killed.code, killed.status) == ("undecodable_clip", 422)
    stopped = asyncio.run(fail(signal.SIGSTOP, DecodingLimits(seconds=2.0, decoding_s=0.5)))
    assert (stopped.code, "longer than 0.5 s" in str(stopped)) == ("undecodable_clip", True)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no device that is always full")
@pytest.mark.parametrize("seconds", [0.01, 1.0])
def test_a_disk_that_is_full_while_it_is_decoded_is_no_fault_of_the_file(tmp_path, seconds):
    (tmp_path / "upload").write_bytes(encoded("flac", seconds))
    with pytest.raises(RequestError, match=r"No space left on device$") as caught:
        asyncio.run(decode_apart(tmp_path / "upload", Path("/dev/full"), LIMITS))
    assert (caught.value.code, caught.value.status) == ("storage_failed", 507)


def check_mutations(tmp_path, kinds, count, seed):
    """Whatever became of a file, it is decoded within its limits or refused by an error of ours."""
    rng = np.random.default_rng(seed)
    originals = [encoded(kind, 0.2, channels=1 + number % 2) for number, kind in enumerate(kinds)]
    outcomes = {"decoded": 0, "refused": 0}
    for number in range(count):
        content = rng.bytes(2_000) if number % 20 == 19 else mutated(originals[number % len(originals)], rng)
        try:
            decoded, samples = decode(tmp_path, content)
            assert decoded.frames <= 2 * decoded.sample_rate
            assert np.isfinite(samples).all()
            outcomes["decoded"] += 1
        except AudioFileError:
            outcomes["refused"] += 1
    return outcomes


@pytest.mark.parametrize("count", [150, pytest.param(20_000, marks=pytest.mark.long)])
def test_broken_files_are_decoded_or_refused(tmp_path, count):
    outcomes = check_mutations(tmp_path, tuple(KINDS), count, seed=count)
    assert min(outcomes.values()) > count / 20, outcomes
