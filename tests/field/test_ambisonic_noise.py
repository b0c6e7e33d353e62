"""The noises behind ambisonic channels are level in each octave whenever sound begins, and hardly alike."""

import hashlib
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.fft import dct
from scipy.signal import butter, hilbert, sosfiltfilt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.field.ambisonic_noise import (
    NOISES,
    even_noises,
    signs,
    subband_edges,
    sum_of_packets,
    whole_units,
)

RATE, SAMPLES = 24_000, 14_400
STARTS_S = np.arange(0.013, 0.3, 0.0137)
"""Other ones than those for which amplitudes were optimised."""


def octaves(signals, rate):
    """(band, signal, sample)"""
    found = []
    for centre_hz in OCTAVE_BANDS_HZ:
        edges_hz = np.minimum(centre_hz * np.sqrt([0.5, 2.0]), 0.49 * rate)
        found.append(sosfiltfilt(butter(2, edges_hz, "bandpass", fs=rate, output="sos"), signals, axis=-1))
    return np.array(found)


def covariances(noises, decay_s, rate=RATE):
    """(start, band, noise, noise) complex covariances of decaying sound, beside the power that white noise has on the
    mean."""
    impulse = np.zeros((1, 2 * rate))
    impulse[0, rate] = 1
    expected = np.sum(octaves(impulse, rate)[:, 0] ** 2, axis=-1)
    analytic = hilbert(octaves(noises, rate), axis=-1) / np.sqrt(2)
    time_s = np.arange(noises.shape[1]) / rate
    conjugate = analytic.conj().swapaxes(1, 2)
    found = []
    for start_s in STARTS_S:
        decay = np.where(time_s >= start_s, 10 ** (-6 * np.maximum(time_s - start_s, 0) / decay_s), 0)
        found.append((decay / decay.sum() * analytic) @ conjugate / expected[:, None, None])
    return np.array(found)


def levels_off_db(found):
    """(band,) root mean squares over starts and noises."""
    return np.sqrt(np.mean((10 * np.log10(np.einsum("sbii->sbi", found).real)) ** 2, axis=(0, 2)))


def correlations(found, count):
    """(band,) root mean squares over starts and pairs of the first noises."""
    pairs = found[:, :, :count, :count][:, :, ~np.eye(count, dtype=bool)]
    return np.sqrt(np.mean(np.abs(pairs) ** 2, axis=(0, 2)))


@pytest.fixture(scope="module")
def noises():
    return even_noises(RATE, SAMPLES, NOISES)


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(0).standard_normal((NOISES, SAMPLES))


@pytest.fixture(scope="module")
def decaying(noises):
    """Covariances of the noises, decaying by 60 dB in 0.4 s."""
    return covariances(noises, 0.4)


@pytest.fixture(scope="module")
def decaying_white(white):
    return covariances(white, 0.4)


def test_decaying_sound_has_its_level_in_each_octave_whenever_it_begins(decaying, decaying_white):
    found = levels_off_db(decaying)
    assert (found < [1.0, 0.5, 0.3, 0.25, 0.15, 0.1, 0.1]).all()
    assert (found < 0.5 * levels_off_db(decaying_white)).all()


def test_the_level_is_right_on_the_mean(noises, decaying):
    for found in (covariances(noises, 0.2), decaying, covariances(noises, 1.0)):
        powers = np.einsum("sbii->sbi", found).real
        assert_allclose(10 * np.log10(powers.mean(axis=(0, 2))), 0, atol=0.3)
        assert_allclose(10 * np.log10(powers[..., :4].mean(axis=(0, 2))), 0, atol=0.2)


@pytest.mark.parametrize(("count", "share"), [(4, 0.9), (9, 0.9), (16, 0.9)])
def test_noises_are_less_alike_than_white_ones(decaying, decaying_white, count, share):
    found, of_white = (correlations(each, count) for each in (decaying, decaying_white))
    assert (found < share * of_white).all()


def test_the_four_noises_of_a_first_order_are_least_alike(decaying):
    assert (correlations(decaying, 4) < [0.22, 0.14, 0.09, 0.07, 0.11, 0.07, 0.06]).all()


def test_packets_are_orthonormal():
    edges = subband_edges(8000, 640)
    counts = np.diff(edges)
    rows = np.split(np.eye(640), np.cumsum(counts)[:-1], axis=1)
    packets = sum_of_packets(rows, edges)
    assert_allclose(packets @ packets.T, np.eye(640), atol=1e-12)


def test_signs_of_neighbouring_packets_are_orthogonal():
    edges = subband_edges(RATE, whole_units(RATE, SAMPLES))
    drawn = signs(edges, NOISES)
    assert all((np.abs(of_subband) == 1).all() for of_subband in drawn)
    for low in range(0, len(drawn) - 4, 4):
        block = np.concatenate([drawn[low + subband][:, 8:12] for subband in range(4)], axis=1)
        assert_array_equal(block @ block.T, 16 * np.eye(NOISES))
        four = np.concatenate([drawn[low + subband][:4, 8:10] for subband in range(2)], axis=1)
        assert_array_equal(four @ four.T, 4 * np.eye(4))


def test_a_signal_is_the_transform_of_its_spectrum():
    """Packets that overlap in nothing else give back what SciPy's transform gives."""
    edges = [0, 640]
    amplitudes = np.random.default_rng(2).standard_normal((2, 640))
    spectrum = dct(amplitudes, type=4, norm="ortho")
    assert_allclose(sum_of_packets([amplitudes], edges), dct(spectrum, type=4, norm="ortho"), atol=1e-12)


@pytest.mark.parametrize("rate", [8000, 22_050, 24_000, 44_100, 96_000])
def test_a_longer_response_begins_as_a_shorter_one(rate):
    short, long = even_noises(rate, rate // 2, 4), even_noises(rate, rate, 4)
    kept = slice(0, rate // 2 - rate // 10)  # what lies beyond is seen through the ends of packets
    assert np.abs(short[:, kept] - long[:, kept]).max() < 0.1
    assert np.std(short[:, kept] - long[:, kept]) < 0.005


def test_low_frequencies_are_the_same_at_all_rates(noises):
    other = even_noises(48_000, 2 * SAMPLES, NOISES)
    # Unit variance is less power per hertz at a higher rate.
    low, other_low = octaves(noises, RATE)[:2], np.sqrt(2) * octaves(other, 48_000)[:2, :, ::2]
    late = slice(1000, None)  # before, filters have their ends
    assert np.std((low - other_low)[..., late]) < 0.05 * np.std(low[..., late])


@pytest.mark.parametrize(("rate", "samples"), [(8000, 256), (96_000, 256), (12_345, 5000), (24_000, 40_000)])
def test_any_length_and_rate_has_noises_of_unit_power(rate, samples):
    found = even_noises(rate, samples, NOISES)
    assert found.shape == (NOISES, samples)
    assert np.mean(found**2) == pytest.approx(1, abs=0.25 if samples == 256 else 0.04)


def test_fewer_noises_are_the_first_ones(noises):
    assert_array_equal(even_noises(RATE, SAMPLES, 4), noises[:4])


def test_they_are_the_same_in_every_process(noises):
    script = (
        "import hashlib; from server.field.ambisonic_noise import even_noises;"
        f"print(hashlib.sha256(even_noises({RATE}, {SAMPLES}, {NOISES}).tobytes()).hexdigest())"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert said.strip() == hashlib.sha256(noises.tobytes()).hexdigest()


def test_random_signs_are_those_of_every_version_of_numpy():
    """So the noises of a scene stay what they are; raw bits of PCG64 are part of NumPy's promises."""
    drawn = signs(subband_edges(RATE, whole_units(RATE, SAMPLES)), NOISES)
    bits = np.concatenate(drawn, axis=1) > 0
    assert hashlib.sha256(np.packbits(bits).tobytes()).hexdigest()[:16] == "84578877346a5a78"
