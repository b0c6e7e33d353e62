"""Ambisonic channels decoded to ears, against the head's own ears."""

import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.spherical_harmonics import even_directions, mean_squares, real_harmonics
from server.rendering.ear_products import wave_spectra
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import kemar

BINS = 1025
RATES = (24_000, 48_000, 96_000)
DIRECTIONS = even_directions(400)


def frequencies(rate):
    return np.arange(BINS) * rate / (2 * (BINS - 1))


def spectra_of(decoder):
    """(bin, ear, k), without the delay."""
    turns = np.exp(2j * np.pi * np.arange(BINS) * decoder.delay / (2 * (BINS - 1)))
    return np.moveaxis(np.fft.rfft(decoder.filters, 2 * (BINS - 1), axis=-1) * turns, -1, 0)


def heard(decoder, directions):
    """(bin, direction, ear) plane waves of these directions, encoded and decoded."""
    return np.einsum("fek,dk->fde", spectra_of(decoder), real_harmonics(directions, decoder.order))


def by_head(rate, directions):
    return np.moveaxis(wave_spectra(kemar(rate), directions, BINS), -1, 0)


def band_powers(waves, rate):
    """(band, direction, ear)"""
    bands = np.searchsorted(np.array(OCTAVE_BANDS_HZ) * np.sqrt(0.5), frequencies(rate)) - 1
    return np.stack([np.sum(np.abs(waves[bands == band]) ** 2, axis=0) for band in range(len(OCTAVE_BANDS_HZ))])


def errors(decoder):
    """(band,) of levels and of level differences between the ears, each in dB."""
    wanted, found = (
        10 * np.log10(band_powers(waves, decoder.sample_rate))
        for waves in (by_head(decoder.sample_rate, DIRECTIONS), heard(decoder, DIRECTIONS))
    )
    difference = found - wanted
    return np.sqrt(np.mean(difference**2, axis=(1, 2))), np.mean(
        np.abs(difference[..., 0] - difference[..., 1]), axis=1
    )


@pytest.fixture(scope="module", params=RATES)
def decoders(request):
    return [HeadDecoder.of(kemar(request.param), order) for order in (1, 2, 3)]


def test_a_higher_order_errs_less(decoders):
    levels, differences = np.swapaxes([errors(decoder) for decoder in decoders], 0, 1)
    assert (np.diff(levels.mean(axis=1)) < -0.3).all()
    assert (np.diff(differences.mean(axis=1)) < -0.4).all()
    assert levels[:, :3].max() < 1.5  # up to 500 Hz
    assert levels[2, :6].max() < 1.5  # up to 4 kHz


def test_diffuse_sound_has_the_level_and_the_coherence_that_the_head_has(decoders):
    for decoder in decoders:
        rate = decoder.sample_rate
        waves = by_head(rate, DIRECTIONS)
        wanted = np.einsum("fde,fdg->feg", waves, np.conj(waves)) / len(DIRECTIONS)
        spectra = spectra_of(decoder)
        found = np.einsum("fek,k,fgk->feg", spectra, mean_squares(decoder.order), np.conj(spectra))
        is_heard = (frequencies(rate) > 90) & (frequencies(rate) < min(0.45 * rate, 16_000))
        levels = 10 * np.log10(np.einsum("fee->fe", found).real / np.einsum("fee->fe", wanted).real)
        assert np.abs(levels[is_heard]).max() < 1.5

        def coherence(products):
            return products[:, 0, 1].real / np.sqrt(products[:, 0, 0].real * products[:, 1, 1].real)

        assert np.abs(coherence(found) - coherence(wanted))[is_heard].max() < 0.12


def test_low_frequencies_arrive_at_each_ear_when_they_do_at_the_head(decoders):
    for decoder in decoders[1:]:
        is_low = (frequencies(decoder.sample_rate) > 150) & (frequencies(decoder.sample_rate) < 500)
        wanted, found = by_head(decoder.sample_rate, DIRECTIONS)[is_low], heard(decoder, DIRECTIONS)[is_low]
        lag = np.angle(found * np.conj(wanted)) / (2 * np.pi * frequencies(decoder.sample_rate)[is_low, None, None])
        assert np.sqrt(np.mean(lag**2)) < 40e-6


def test_filters_are_mirrored_as_the_head_is(decoders):
    mirror = np.array([1, -1, 1])
    for decoder in decoders:
        levels = 10 * np.log10(band_powers(heard(decoder, DIRECTIONS), decoder.sample_rate))
        mirrored = 10 * np.log10(band_powers(heard(decoder, DIRECTIONS * mirror), decoder.sample_rate))
        assert np.sqrt(np.mean((levels - mirrored[..., ::-1]) ** 2)) < 1.0  # KEMAR's ears differ a little


def test_little_is_heard_before_the_delay_and_nothing_at_the_end(decoders):
    for decoder in decoders:
        assert decoder.delay == round(0.001 * decoder.sample_rate)
        energy = np.cumsum(np.sum(decoder.filters.astype(float) ** 2, axis=(0, 1)))
        ahead = round(0.0004 * decoder.sample_rate)
        assert energy[decoder.delay - ahead] < 0.02 * energy[-1]
        assert energy[decoder.delay + round(0.003 * decoder.sample_rate)] > 0.999 * energy[-1]


def test_filters_of_a_head_are_kept():
    assert HeadDecoder.of(kemar(24_000), 1) is HeadDecoder.of(kemar(24_000), 1)


@pytest.mark.parametrize("order", [0, 4])
def test_an_order_that_cannot_be_decoded_is_refused(order):
    with pytest.raises(ValueError, match=r"order: is \d, must be 1, 2 or 3"):
        HeadDecoder.of(kemar(24_000), order)
