import shutil

import h5py
import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.rendering.hrtf import KEMAR, Hrtf

HEAD_RADIUS_M = 0.0875


def towards(azimuth_deg):
    azimuth = np.radians(azimuth_deg)
    return np.array([np.cos(azimuth), np.sin(azimuth), 0.0])


def interaural_delay_s(hrtf, azimuth_deg):
    """How much later the right ear hears, by the peak of the cross-correlation, interpolated 16 times."""
    n_fft = 4096
    left, right = hrtf.spectra(towards(azimuth_deg), n_fft)
    correlation = np.fft.irfft(right * np.conj(left), 16 * n_fft)
    lag = np.argmax(correlation)
    return (lag - (lag > 8 * n_fft) * 16 * n_fft) / 16 / hrtf.sample_rate


@pytest.mark.parametrize("azimuth_deg", [30, 60, 90, -30, -60, -90])
def test_interaural_delay_is_that_of_a_sphere(kemar, azimuth_deg):
    theta = np.radians(azimuth_deg)
    woodworth = HEAD_RADIUS_M / 343 * (theta + np.sin(theta))
    assert interaural_delay_s(kemar, azimuth_deg) == pytest.approx(woodworth, rel=0.2)


def test_the_near_ear_is_the_louder(kemar):
    left, right = np.sum(np.abs(kemar.spectra(towards(90), 512)) ** 2, axis=-1)
    assert power_to_db(left / right) > 6
    right_side = np.sum(np.abs(kemar.spectra(towards(-90), 512)) ** 2, axis=-1)
    assert power_to_db(right_side[1] / right_side[0]) > 6


def test_diffuse_field_has_unit_energy(kemar):
    assert np.mean(np.sum(kemar.impulse_responses**2, axis=-1)) == pytest.approx(1)


@pytest.mark.parametrize("sample_rate", [16_000, 24_000, 44_100, 48_000])
def test_a_wave_from_ahead_reaches_both_ears_when_it_passes_the_centre(sample_rate):
    hrtf = Hrtf.read(KEMAR, sample_rate)
    response = np.fft.irfft(hrtf.spectra(towards(0), 1024))
    onset = np.argmax(np.abs(response) > 0.1 * np.abs(response).max(), axis=-1)
    # A response may begin just before time zero, which wraps to the end.
    assert (np.minimum(onset, 1024 - onset) <= 0.0002 * sample_rate).all()


def test_ears_swapped_in_the_file_are_put_right(kemar, tmp_path):
    swapped = tmp_path / "swapped.sofa"
    shutil.copy(KEMAR, swapped)
    with h5py.File(swapped, "r+") as file:
        file["Data.IR"][...] = file["Data.IR"][()][:, ::-1]
    np.testing.assert_array_equal(Hrtf.read(swapped, 24_000).impulse_responses, kemar.impulse_responses)


def test_a_file_with_one_signal_in_both_ears_is_refused(tmp_path):
    mono = tmp_path / "mono.sofa"
    shutil.copy(KEMAR, mono)
    with h5py.File(mono, "r+") as file:
        file["Data.IR"][...] = np.repeat(file["Data.IR"][:, :1], 2, axis=1)
    with pytest.raises(ValueError, match="alike"):
        Hrtf.read(mono, 24_000)
