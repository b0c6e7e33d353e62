"""Clips: what is decoded is what was written, and what cannot be played says why."""

import logging
import threading
from pathlib import Path

import numpy as np
import pytest
import soundfile

import server.assets.clips
from server.assets.clips import ClipLibrary, DecodeError, UnknownClipError, decode

SAMPLE_RATE = 24_000
DATA = Path(server.assets.clips.__file__).parent / "clips_data"


def noise(seed, *shape):
    return (0.1 * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


@pytest.mark.parametrize(("name", "subtype"), [("a.wav", "FLOAT"), ("a.wav", "PCM_24"), ("a.flac", "PCM_24")])
def test_decodes_what_was_written(tmp_path, name, subtype):
    samples = noise(1, 5_000)
    soundfile.write(tmp_path / name, samples, SAMPLE_RATE, subtype=subtype)
    decoded = decode(tmp_path / name, SAMPLE_RATE).samples
    np.testing.assert_allclose(decoded, samples, atol=2**-23)
    assert decoded.dtype == np.float32
    assert not decoded.flags.writeable


def test_channels_are_averaged(tmp_path):
    samples = noise(2, 1_000, 3)
    soundfile.write(tmp_path / "a.wav", samples, SAMPLE_RATE, subtype="FLOAT")
    np.testing.assert_allclose(decode(tmp_path / "a.wav", SAMPLE_RATE).samples, samples.mean(axis=1), atol=1e-7)


def test_channels_that_cancel_give_the_louder_one_and_a_warning(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    samples = noise(2, 4_000)
    soundfile.write(tmp_path / "a.wav", np.column_stack([-0.5 * samples, 0.5 * samples]), SAMPLE_RATE, subtype="FLOAT")
    decoded = decode(tmp_path / "a.wav", SAMPLE_RATE).samples
    assert np.abs(decoded).max() == pytest.approx(0.5 * np.abs(samples).max(), rel=1e-6)
    assert "a.wav: its 2 channels cancel each other" in caplog.text
    asked = decode(tmp_path / "a.wav", SAMPLE_RATE, channel=1).samples
    np.testing.assert_allclose(asked, 0.5 * samples, atol=1e-7)
    with pytest.raises(DecodeError, match=r"a\.wav: it has no channel 3, only 2"):
        decode(tmp_path / "a.wav", SAMPLE_RATE, channel=2)


@pytest.mark.parametrize("declared", [0, 1_000])
def test_a_header_that_tells_of_less_than_there_is_does_not_cut_the_clip(tmp_path, caplog, declared):
    caplog.set_level(logging.INFO)
    samples = noise(7, 48_000)
    soundfile.write(tmp_path / "a.wav", samples, SAMPLE_RATE, subtype="PCM_16")
    content = bytearray((tmp_path / "a.wav").read_bytes())
    at = content.index(b"data") + 4
    content[at : at + 4] = declared.to_bytes(4, "little")
    (tmp_path / "a.wav").write_bytes(content)
    np.testing.assert_allclose(decode(tmp_path / "a.wav", SAMPLE_RATE).samples, samples, atol=2**-15)
    assert "48000 samples (2 s) were read" in caplog.text


@pytest.mark.parametrize("file_rate", [8_000, 16_000, 44_100, 48_000])
def test_resampling_keeps_a_tone_where_it_was(tmp_path, file_rate):
    def tone(rate):
        return np.sin(2 * np.pi * 997 * np.arange(rate) / rate + 0.3)

    soundfile.write(tmp_path / "a.wav", tone(file_rate), file_rate, subtype="FLOAT")
    decoded = decode(tmp_path / "a.wav", SAMPLE_RATE).samples
    assert decoded.size == SAMPLE_RATE
    middle = slice(2_000, -2_000)  # the ends of the recording are cut tones, which do not resample to cut tones
    np.testing.assert_allclose(decoded[middle], tone(SAMPLE_RATE)[middle], atol=1e-5)


def test_the_name_of_a_file_does_not_matter(tmp_path):
    samples = noise(3, 100)
    soundfile.write(tmp_path / "a.wav", samples, SAMPLE_RATE, subtype="FLOAT")
    for name in ("a.raw", "a.ogg", "a"):
        renamed = (tmp_path / "a.wav").rename(tmp_path / name)
        np.testing.assert_allclose(decode(renamed, SAMPLE_RATE).samples, samples, atol=1e-7)
        renamed.rename(tmp_path / "a.wav")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_samples_that_are_not_finite_are_refused_before_they_spread(tmp_path, bad):
    samples = noise(4, 1_000, 2)
    samples[[70, 80], 1] = bad
    soundfile.write(tmp_path / "a.wav", samples, 44_100, subtype="FLOAT")
    with pytest.raises(DecodeError, match=r"^a\.wav: 2 samples are not finite, the first at 70$"):
        decode(tmp_path / "a.wav", SAMPLE_RATE)


def test_samples_that_are_no_audio_are_refused(tmp_path):
    soundfile.write(tmp_path / "a.wav", np.array([0.0, 2.0**31]), SAMPLE_RATE, subtype="FLOAT")
    with pytest.raises(DecodeError, match=r"peak of 2\.15e\+09 is not audio"):
        decode(tmp_path / "a.wav", SAMPLE_RATE)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not an audio file"),
        (b"not audio at all" * 100, "not an audio file"),
        (b"RIFF\x24\x00\x00\x00WAVE", "not an audio file"),
    ],
)
def test_a_file_that_is_no_audio_says_so(tmp_path, content, reason):
    (tmp_path / "a.wav").write_bytes(content)
    with pytest.raises(DecodeError, match=reason) as caught:
        decode(tmp_path / "a.wav", SAMPLE_RATE)
    assert caught.value.name == "a.wav"
    assert str(caught.value) == f"a.wav: {caught.value.reason}"


def test_an_empty_recording_says_so(tmp_path):
    soundfile.write(tmp_path / "a.wav", np.zeros(0), SAMPLE_RATE)
    with pytest.raises(DecodeError, match="no samples"):
        decode(tmp_path / "a.wav", SAMPLE_RATE)


def test_a_recording_that_resamples_to_nothing_says_so(tmp_path):
    soundfile.write(tmp_path / "a.wav", np.ones(1), 192_000, subtype="FLOAT")
    with pytest.raises(DecodeError, match="too short"):
        decode(tmp_path / "a.wav", 8_000)


def test_a_file_that_cannot_be_opened_says_so(tmp_path):
    with pytest.raises(DecodeError, match=r"^absent\.wav: No such file"):
        decode(tmp_path / "absent.wav", SAMPLE_RATE)
    with pytest.raises(DecodeError, match="directory"):
        decode(tmp_path, SAMPLE_RATE)


def test_every_bundled_clip_plays_and_is_fit_for_a_loop():
    library = ClipLibrary(SAMPLE_RATE)
    assert len(library.names) >= 2
    for name in library.names:
        samples = library.load(name).samples
        level_db = 10 * np.log10(np.mean(samples**2))
        assert 2 < samples.size / SAMPLE_RATE < 60
        assert -32 < level_db < -15
        assert np.abs(samples).max() <= 1
        assert abs(samples[0] - samples[-1]) < 0.01


def test_every_bundled_file_is_listed_and_credited():
    library = ClipLibrary(SAMPLE_RATE)
    recordings = {path.stem for path in DATA.iterdir() if path.suffix not in {".md", ".toml"}}
    assert recordings == set(library.names)
    credits_page = (DATA / "CREDITS.md").read_text(encoding="utf-8")
    for name in library.names:
        clip = library.describe(name)
        assert f"`{name}.ogg`" in credits_page
        assert clip.title
        for part in clip.credit.split(", "):  # author, source, licence
            assert part in credits_page
    assert sum(path.stat().st_size for path in DATA.iterdir()) < 1_000_000


def test_a_description_says_how_long_it_plays(tmp_path):
    soundfile.write(tmp_path / "a.wav", noise(5, 44_100 * 2), 44_100)
    clip = ClipLibrary(SAMPLE_RATE, {"mine": tmp_path / "a.wav"}).describe("mine")
    assert (clip.name, clip.title, clip.credit) == ("mine", "mine", "")
    assert clip.duration_s == pytest.approx(2, abs=1e-4)


def test_a_users_file_wins_over_a_bundled_clip_of_that_name_and_says_so(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    soundfile.write(tmp_path / "a.wav", noise(6, 100), SAMPLE_RATE, subtype="FLOAT")
    library = ClipLibrary(SAMPLE_RATE, {"trumpet": tmp_path / "a.wav"})
    np.testing.assert_allclose(library.load("trumpet").samples, noise(6, 100), atol=1e-7)
    assert library.describe("trumpet").credit == ""
    assert library.names == ClipLibrary(SAMPLE_RATE).names
    assert "a.wav takes the place of the bundled clip 'trumpet'" in caplog.text


@pytest.mark.parametrize("name", ["absent", "", "../clips", "trumpet.ogg"])
def test_an_unknown_clip_is_a_404_naming_it(name):
    library = ClipLibrary(SAMPLE_RATE)
    for call in (library.load, library.describe):
        with pytest.raises(UnknownClipError, match=repr(name)) as caught:
            call(name)
        assert (caught.value.code, caught.value.status, caught.value.field) == ("unknown_clip", 404, "clip")


def test_a_clip_is_decoded_once_however_many_ask():
    library = ClipLibrary(SAMPLE_RATE)
    loaded = []
    threads = [threading.Thread(target=lambda: loaded.append(library.load("trumpet"))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(loaded) == 8
    assert all(samples is loaded[0] for samples in loaded)
