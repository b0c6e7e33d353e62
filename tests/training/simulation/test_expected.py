import numpy as np
import pytest

from server.acoustics.codec import Codec
from server.rendering.hrtf import kemar
from training.simulation.expected import ExpectedSpectrograms
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import Arrivals

DRAWS = 150


@pytest.fixture(scope="module")
def codec(dataset):
    return Codec(dataset.sample_rate, 256, 64, dataset.samples, 1e-5)


@pytest.fixture(scope="module")
def expected(dataset, codec):
    return ExpectedSpectrograms(dataset, codec)


@pytest.fixture(scope="module")
def drawn(dataset, codec):
    """(draw, yaw, ear, frequency, frame) spectrograms of pair (0, 3), drawn again and again from its energies."""
    synthesis = BinauralSynthesis(kemar(dataset.sample_rate), sphere_directions(6), dataset.yaws, dataset.samples)
    (energy,) = dataset.read_energy(np.array([[0, 3]]))
    specular = ExpectedSpectrograms(dataset, codec).specular(0, 3)
    diffuse = Arrivals(np.zeros((0, 3)), np.zeros((0, 7)), energy)
    rng = np.random.default_rng(0)
    draws = [synthesis.render(diffuse, dataset.probes[3], dataset.onset_s[0, 3], rng) for _ in range(DRAWS)]
    return np.stack([codec.transform(draw + specular).astype(np.complex64) for draw in draws])


def products(spectrograms):
    """(product, ..., frequency, frame) of (..., ear, frequency, frame)."""
    left, right = spectrograms[..., 0, :, :], spectrograms[..., 1, :, :]
    cross = left * np.conj(right)
    return np.stack([np.abs(left) ** 2, np.abs(right) ** 2, cross.real, cross.imag])


def every_frame(codec):
    return np.eye(codec.frames, dtype=np.float32)


def test_expected_products_are_the_mean_of_all_draws(codec, expected, drawn):
    """Power in decibels, and the complex coherence of the ears, in octaves or so of the middle of the spectrum."""
    some = np.s_[..., 4:-4, 6:-6]
    specular = products(codec.transform(expected.specular(0, 3)))
    found = (specular + expected.diffuse_products(0, 3, every_frame(codec)).transpose(1, 2, 0, 3))[some]
    true = products(drawn).mean(axis=1)[some]
    power = np.stack([found[:2], true[:2]]).mean(axis=(2, 3))  # (which, ear, frame)
    loud = power[1] > 1e-6
    np.testing.assert_allclose(10 * np.log10(power[0] / power[1])[loud], 0, atol=0.6)
    bands = np.array_split(np.arange(found.shape[-2]), 6)
    coherence = [
        np.stack([part[:, :, band].sum(axis=2) for band in bands])[:, :, :, loud.all(axis=0)] for part in (found, true)
    ]
    ours, theirs = ((part[:, 2] + 1j * part[:, 3]) / np.sqrt(part[:, 0] * part[:, 1]) for part in coherence)
    assert np.abs(theirs).max() > 0.5
    # Of the mean of a band of a single draw the error would be 0.3.
    assert np.sqrt(np.mean(np.abs(ours - theirs) ** 2)) < 0.08


def test_sums_over_cells_are_sums_of_frames(codec, expected):
    pool = np.random.default_rng(0).random((codec.frames, 7)).astype(np.float32)
    every = expected.diffuse_products(0, 3, every_frame(codec))
    np.testing.assert_allclose(expected.diffuse_products(0, 3, pool), every @ pool, rtol=1e-3, atol=3e-7)


def test_an_aligned_response_has_its_frames_earlier(codec, expected):
    at_emission = expected.diffuse_products(0, 3, every_frame(codec))
    aligned = expected.diffuse_products(0, 3, every_frame(codec), 3 * codec.hop)
    np.testing.assert_allclose(aligned[..., :-8], at_emission[..., 3:-5], rtol=1e-3, atol=1e-9)
