import shutil

import numpy as np
import pytest

from training.baselines.coded import _OPUS_OF_FFMPEG, AAC, OPUS, AudioCodec, CodedResponses
from training.baselines.held_out import EvaluationError
from training.evaluation.methods import method_columns

RATE = 8_000


def pulse(pair, channels=2, samples=1_600):
    """A low pulse somewhere else in every pair and orientation: what a codec of few bits keeps."""
    ir = np.zeros((2, channels, samples))
    time_s = np.arange(samples) / RATE
    for turn in range(2):
        since = time_s - centre_s(pair, turn)
        ir[turn] = 0.01 * 2.0**pair * np.exp(-0.5 * (since / 1e-3) ** 2) * np.cos(2 * np.pi * 300 * since)
    return ir


def centre_s(pair, turn):
    return 0.02 + 0.011 * pair + 0.003 * turn


CODECS = [
    pytest.param(codec, marks=pytest.mark.skipif(not codec.is_installed, reason=f"needs {codec.encode[0]}"), id=name)
    for name, codec in (("aac", AAC), ("opus", OPUS), ("opus-of-ffmpeg", _OPUS_OF_FFMPEG))
]


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("codec", CODECS)
def test_coding_keeps_time_and_level(codec, make_held_out, channels) -> None:
    """The delay of the codec is taken away, and every response has its own gain back."""
    held_out = make_held_out(lambda pair: pulse(pair, channels), yaws=2, pairs=8, held_out=(3,))
    coded = CodedResponses(codec, held_out)
    for pair in (0, 2, 7):
        decoded, plain = np.asarray(coded[pair], dtype=float), pulse(pair, channels)
        assert decoded.shape == plain.shape
        for turn in range(2):
            # Coders of so few bits may turn the wave inside out, but not move it.
            power = np.square(decoded[turn]).sum(axis=0)
            centre = float(power @ np.arange(len(power)) / power.sum() / RATE)
            assert centre == pytest.approx(centre_s(pair, turn), abs=1.5e-3)
        np.testing.assert_allclose(np.square(decoded).sum(), np.square(plain).sum(), rtol=0.5)


def coders(path):
    """The configuration numbers of all packets of an Ogg Opus file, headers left out (RFC 6716, 3.1; RFC 3533, 6)."""
    data, at, packet, found = path.read_bytes(), 0, b"", []
    while at < len(data):
        laces = data[at + 27 : at + 27 + data[at + 26]]
        at += 27 + len(laces)
        for lace in laces:
            packet, at = packet + data[at : at + lace], at + lace
            if lace < 255:
                found.append(packet[0] >> 3)
                packet = b""
    return found[2:]


@pytest.mark.skipif(not OPUS.is_installed, reason="needs opusenc")
def test_opus_codes_music_as_the_paper_had_it(make_held_out) -> None:
    """Noise that decays would be taken for speech. Configurations from 16 on are CELT's (RFC 6716, table 2)."""
    decay = 10 ** (-3 * np.arange(8_000) / 4_000)
    noise = np.random.default_rng(0).standard_normal((6, 2, 2, 8_000)) * decay
    held_out = make_held_out(lambda pair: noise[pair], yaws=2)
    CodedResponses(OPUS, held_out)
    (file,) = (held_out.folder / "coded").rglob("*.opus")
    assert min(coders(file)) >= 16


@pytest.mark.skipif(not AAC.is_installed, reason="needs ffmpeg")
def test_what_is_coded_is_coded_once(make_held_out) -> None:
    held_out = make_held_out(pulse, yaws=2)
    first = CodedResponses(AAC, held_out)
    files = sorted((held_out.folder / "coded").rglob("*.m4a"))
    times = [file.stat().st_mtime_ns for file in files]
    again = CodedResponses(AAC, held_out)
    assert [file.stat().st_mtime_ns for file in sorted((held_out.folder / "coded").rglob("*.m4a"))] == times
    np.testing.assert_array_equal(first[0], again[0])
    gains = 5 * 2 * 4  # five training pairs at two orientations
    assert first.storage_bytes == sum(file.stat().st_size for file in files) + gains
    other = make_held_out(lambda pair: 0.5 * pulse(pair), yaws=2)
    np.testing.assert_allclose(CodedResponses(AAC, other)[0], 0.5 * first[0], atol=1e-3)


@pytest.mark.skipif(not AAC.is_installed, reason="needs ffmpeg")
def test_nearest_and_linear_are_of_coded_responses(make_held_out) -> None:
    held_out = make_held_out(pulse, yaws=2, held_out=(3,))
    nearest, linear = method_columns(["aac-nearest", "aac-linear"], held_out)
    coded = CodedResponses(AAC, held_out)
    turns = np.array([1])
    np.testing.assert_array_equal(nearest.source(0, turns), np.asarray(coded[2], np.float32)[turns])
    between = 0.5 * np.asarray(coded[2], np.float32) + 0.5 * np.asarray(coded[4], np.float32)
    np.testing.assert_allclose(linear.source(0, turns), between[turns], atol=1e-6)
    assert nearest.storage_bytes == coded.storage_bytes
    assert linear.extra_ms > nearest.extra_ms > 0


def test_held_out_pairs_are_not_coded(make_held_out) -> None:
    if not AAC.is_installed:
        pytest.skip("needs ffmpeg")
    with pytest.raises(KeyError):
        CodedResponses(AAC, make_held_out(pulse, yaws=2, held_out=(3,)))[3]


def test_a_missing_or_failing_program_is_named(make_held_out) -> None:
    absent = AudioCodec("absent", ".x", ("no-such-coder", "{source}"), ("no-such-coder",))
    with pytest.raises(EvaluationError, match="no-such-coder, which is not installed"):
        CodedResponses(absent, make_held_out(pulse, yaws=2))
    failing = AudioCodec("failing", ".x", (shutil.which("python3") or "python3", "-c", "raise SystemExit('no')"), ())
    with pytest.raises(EvaluationError, match="failed: no"):
        CodedResponses(failing, make_held_out(pulse, yaws=2))


@pytest.mark.skipif(not AAC.is_installed, reason="needs ffmpeg")
def test_files_are_coded_when_they_are_asked_for(make_held_out, monkeypatch) -> None:
    monkeypatch.setattr("training.baselines.coded._PER_FILE", 2)
    monkeypatch.setattr("training.baselines.coded._SAMPLED_FILES", 2)
    held_out = make_held_out(pulse, yaws=2, pairs=8, held_out=(3,))

    def sizes() -> list[int]:
        return [file.stat().st_size for file in (held_out.folder / "coded").rglob("*.m4a")]

    coded = CodedResponses(AAC, held_out)
    assert len(sizes()) == 2
    estimate = coded.storage_bytes
    for pair in (0, 1, 2, 4, 5, 6, 7):
        coded[pair]
    assert len(sizes()) == 7
    assert estimate == coded.storage_bytes == pytest.approx(sum(sizes()) + 7 * 2 * 4, rel=0.25)
