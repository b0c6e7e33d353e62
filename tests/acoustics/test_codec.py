"""The codec inverts, agrees with SciPy's own inverse, and keeps instantaneous frequency off the branch cut."""

from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from server.acoustics.codec import Codec

MEASURED = sorted((Path(__file__).parents[1] / "data" / "measured").glob("*.flac"))
CODECS = [
    Codec(24_000, 256, 64, 16_800, 1e-5),
    Codec(22_050, 512, 128, 14_001, 1e-3),
    Codec(48_000, 512, 128, 9_000, 1e-3),
]


@pytest.mark.parametrize("codec", CODECS)
def test_noise_survives_the_round_trip(codec: Codec) -> None:
    signal = np.random.default_rng(0).standard_normal((3, 2, codec.samples))
    assert_allclose(codec.decode(*codec.encode(signal)), signal, atol=1e-9)


@pytest.mark.parametrize("codec", CODECS)
def test_silence_and_a_click_survive_the_round_trip(codec: Codec) -> None:
    signal = np.zeros((2, codec.samples))
    signal[1, 700] = 1.0
    log_magnitude, _ = codec.encode(signal)
    assert np.isfinite(log_magnitude).all()
    assert_allclose(codec.decode(*codec.encode(signal)), signal, atol=1e-9)


@pytest.mark.parametrize("path", MEASURED, ids=lambda path: path.stem)
def test_measured_binaural_responses_survive_the_round_trip(path: Path) -> None:
    response, sample_rate = soundfile.read(path, always_2d=True)
    codec = Codec(sample_rate, 512, 128, len(response), 1e-3)
    assert_allclose(codec.decode(*codec.encode(response.T)), response.T, atol=1e-10)


@given(
    n_fft=st.sampled_from([16, 64, 250, 256, 512]),
    hops=st.sampled_from([2, 4, 8]),
    samples=st.integers(256, 3_000),
    single=st.booleans(),
)
def test_the_transform_is_scipys_to_the_bit(n_fft: int, hops: int, samples: int, single: bool) -> None:
    codec = Codec(24_000, n_fft, n_fft // hops, samples, 1e-5)
    transform = ShortTimeFFT(hann(n_fft, sym=False), codec.hop, codec.sample_rate, phase_shift=None)
    signal = np.random.default_rng(samples).standard_normal((2, samples)).astype(np.float32 if single else np.float64)
    assert_array_equal(codec.window, transform.win)
    assert_array_equal(codec.dual_window, transform.dual_win)
    assert_array_equal(codec.transform(signal), transform.stft(signal, p1=transform.p_max(samples)))
    assert codec.frame_times_s[0] == transform.p_min * codec.hop / codec.sample_rate


@pytest.mark.parametrize("codec", CODECS)
def test_synthesis_equals_scipy(codec: Codec) -> None:
    transform = ShortTimeFFT(hann(codec.n_fft, sym=False), codec.hop, codec.sample_rate, phase_shift=None)
    rng = np.random.default_rng(1)
    spectrogram = rng.standard_normal((2, codec.bins, codec.frames)) + 1j * rng.standard_normal(
        (2, codec.bins, codec.frames)
    )
    spectrogram[:, [0, -1]] = spectrogram[:, [0, -1]].real
    assert_allclose(codec.synthesise(spectrogram), transform.istft(spectrogram, k1=codec.samples), atol=1e-9)


def test_single_precision_stays_100_db_below_the_signal() -> None:
    codec = CODECS[0]
    signal = np.random.default_rng(2).standard_normal(codec.samples)
    log_magnitude, frequency = codec.encode(signal)
    decoded = codec.decode(log_magnitude.astype(np.float32), frequency.astype(np.float32))
    assert decoded.dtype == np.float32
    assert np.sqrt(np.mean((decoded - signal) ** 2) / np.mean(signal**2)) < 1e-5 * 10


@pytest.mark.parametrize("bin_index", [2, 6, 10, 11, 50])
def test_a_bin_centred_tone_has_no_instantaneous_frequency(bin_index: int) -> None:
    codec = CODECS[1]
    time = np.arange(codec.samples)
    tone = np.cos(2 * np.pi * bin_index * time / codec.n_fft)
    _, frequency = codec.encode(tone)
    assert_allclose(frequency[bin_index, 10:-10], 0, atol=1e-6)


def test_a_click_has_no_instantaneous_frequency_where_it_is_seen() -> None:
    codec = CODECS[0]
    click = np.zeros(codec.samples)
    click[1000] = 1.0
    log_magnitude, frequency = codec.encode(click)
    seen = np.flatnonzero(log_magnitude[5] > np.log(1e-3))
    assert len(seen) >= 3
    assert_allclose(frequency[:, seen[1:]], 0, atol=1e-6)


def test_window_energy_is_that_of_white_noise() -> None:
    codec = CODECS[0]
    spectrogram = codec.transform(np.random.default_rng(3).standard_normal((40, codec.samples)))
    assert_allclose(np.mean(np.abs(spectrogram[:, 1:-1, 4:-4]) ** 2), codec.window_energy, rtol=0.02)
