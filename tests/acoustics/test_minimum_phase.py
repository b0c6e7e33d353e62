import numpy as np
import pytest
from scipy.signal import butter, lfilter, minimum_phase, tf2zpk

from server.acoustics.air import absorption_db_per_m
from server.acoustics.bands import FILTER_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db
from server.acoustics.minimum_phase import band_cepstra, excess_delays_samples, folded_cepstrum
from server.rendering.hrtf import filter_taps


def test_the_cepstrum_of_poles_and_zeros_is_their_power_sums():
    """c[n] = (sum of poles**n - sum of zeros**n) / n, for those inside the unit circle (Oppenheim & Schafer)."""
    numerator, denominator = [1.0, 0.5, 0.3], [1.0, -0.7, 0.2]
    zeros, poles, _ = tf2zpk(numerator, denominator)
    grid = np.exp(-2j * np.pi * np.fft.rfftfreq(1024))
    magnitude = np.abs(np.polyval(numerator[::-1], grid) / np.polyval(denominator[::-1], grid))
    n = np.arange(1, 40)
    expected = (np.sum(poles[:, None] ** n, axis=0) - np.sum(zeros[:, None] ** n, axis=0)).real / n
    np.testing.assert_allclose(folded_cepstrum(np.log(magnitude))[1:40], expected, atol=1e-12)


@pytest.mark.parametrize("delays", [(3.0, 3.0), (2.0, 20.0), (17.25, 4.5), (0.0, 31.7)])
@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
def test_the_delay_of_a_minimum_phase_pair_is_found(delays, sample_rate):
    """Filters of different colour in the two ears, which delay by themselves, do not deceive it."""
    impulse = np.zeros(512)
    impulse[40] = 1
    near = lfilter(*butter(1, 0.6), impulse)
    far = lfilter(*butter(2, 0.2), impulse)
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(512) * np.array(delays)[:, None])
    pair = np.fft.irfft(np.fft.rfft([near, far]) * shift)
    found = excess_delays_samples(pair, sample_rate) - 40
    assert found[1] - found[0] == pytest.approx(delays[1] - delays[0], abs=0.05)
    assert found.mean() == pytest.approx(np.mean(delays), abs=0.5)


def test_polarity_and_the_phase_of_a_loudspeaker_do_not_delay(kemar_pair):
    plain = excess_delays_samples(kemar_pair, 24_000)
    np.testing.assert_allclose(excess_delays_samples(-kemar_pair, 24_000), plain, atol=1e-9)
    quarter = np.fft.irfft(np.fft.rfft(kemar_pair, 1024) * 1j)
    turned = excess_delays_samples(np.roll(quarter, 100, axis=-1), 24_000) - 100
    np.testing.assert_allclose(turned, plain, atol=1.0)


@pytest.fixture
def kemar_pair():
    from server.rendering.hrtf import KEMAR, Hrtf

    hrtf = Hrtf.read(KEMAR, 24_000)
    return hrtf.impulse_responses[np.argmax(hrtf.directions @ [0.5, 0.8, 0.2])]


@pytest.mark.parametrize("sample_rate", [16_000, 24_000, 48_000, 96_000])
def test_band_cepstra_meet_the_gains_at_the_centres_and_are_flat_beyond(sample_rate):
    taps = round(0.004 * sample_rate)
    audible = [band for band in FILTER_BANDS_HZ if band < sample_rate / 2]
    gains = np.array([-9, -6, -3, 0, -3, -6, -9.0, -9.0])
    log_magnitude = np.fft.rfft(gains @ band_cepstra(sample_rate, taps), 2**14).real
    frequency = np.fft.rfftfreq(2**14, 1 / sample_rate)
    at = np.interp([1.0, *audible, 0.49 * sample_rate], frequency, 20 / np.log(10) * log_magnitude)
    np.testing.assert_allclose(at[1:-1], gains[: len(audible)], atol=0.05)
    # Four milliseconds tell nothing apart below the first band.
    assert at[0] == pytest.approx(gains[0], abs=1.0)
    assert at[-1] == pytest.approx(gains[-1], abs=0.6)


@pytest.mark.parametrize("sample_rate", [24_000, 44_100, 96_000])
def test_filters_of_air_are_the_same_at_all_rates(sample_rate):
    """Their level below 10 kHz is; their delay after 10 m to 3 us, since the minimum phase is that of all the band."""
    lost_db = 10 * absorption_db_per_m(np.array(FILTER_BANDS_HZ))
    frequency = np.linspace(500, 10_000, 20)

    def log_response(rate):
        cepstrum = -lost_db @ band_cepstra(rate, filter_taps(rate))
        return np.exp(-2j * np.pi * np.outer(frequency / rate, np.arange(cepstrum.size))) @ cepstrum

    apart = log_response(sample_rate) - log_response(48_000)
    assert np.abs(20 / np.log(10) * apart.real).max() < 0.02
    assert np.abs(apart.imag / (2 * np.pi * frequency)).max() < 3e-6


def test_one_level_in_all_bands_is_a_gain():
    log_magnitude = np.fft.rfft(np.full(8, -20.0) @ band_cepstra(48_000, 192), 4096).real
    np.testing.assert_allclose(20 / np.log(10) * log_magnitude, -20, atol=1e-6)


def test_filters_agree_with_scipy():
    """`scipy.signal.minimum_phase` of the same magnitude, from a linear-phase filter of a smooth response."""
    taps = np.hanning(63)
    taps /= taps.sum()
    shaped = np.convolve(taps, taps)
    magnitude = np.abs(np.fft.rfft(shaped, 8192)) + 1e-2
    linear = np.fft.fftshift(np.fft.irfft(magnitude))[8192 // 2 - 500 : 8192 // 2 + 501]
    reference = minimum_phase(linear, method="homomorphic", n_fft=8192, half=False)
    ours = np.fft.irfft(np.exp(np.fft.rfft(folded_cepstrum(np.log(magnitude)), 8192)))
    error = np.abs(ours[:400] - reference[:400]).max() / np.abs(reference).max()
    assert amplitude_to_db(error) < -60
