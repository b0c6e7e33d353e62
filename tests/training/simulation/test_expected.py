import h5py
import numpy as np
import pytest

from server.acoustics.codec import Codec
from server.whole_field import kemar
from training.dataset import Dataset, DatasetError
from training.simulation.expected import ExpectedSpectrograms, expected_log_magnitude
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


@pytest.mark.parametrize("ratio", [0.0, 1e-13, 1e-6, 0.3, 1.0, 4.0, 30.0, 1e6])
def test_the_expected_logarithm_is_the_mean_of_many(ratio):
    rng = np.random.default_rng(0)
    variance = 3e-4
    mean = np.sqrt(ratio * variance) * np.exp(1j)
    noise = np.sqrt(variance / 2) * (rng.standard_normal(200_000) + 1j * rng.standard_normal(200_000))
    found = expected_log_magnitude(np.array(mean), np.array(variance))
    assert found == pytest.approx(np.mean(np.log(np.abs(mean + noise))), abs=0.006)


def test_without_noise_it_is_the_logarithm_and_in_silence_finite():
    assert expected_log_magnitude(np.array(0.25), np.array(0.0)) == pytest.approx(np.log(0.25))
    assert np.isfinite(expected_log_magnitude(np.array(0.0), np.array(0.0)))


def test_stored_responses_are_what_is_expected_and_noise(dataset, codec, expected):
    """Of a pair's stored response, over all cells: no bias, and the spread of the logarithm of noise (0.64) or less."""
    stored = codec.transform(dataset.read(np.array([[0, 3]]))[0].astype(np.float64))
    loud = expected.log_magnitude(0, 3) > np.log(1e-3)
    difference = (np.log(np.abs(stored) + 1e-12) - expected.log_magnitude(0, 3))[loud]
    assert loud.mean() > 0.3
    assert np.mean(difference) == pytest.approx(0, abs=0.05)
    assert np.std(difference) < 0.75


def test_expected_spectrograms_are_the_mean_of_all_draws(codec, expected, drawn):
    """In the middle of the spectrum: at its ends cells are real and no complex Gaussians."""
    some = np.s_[:, :, 4:-4, 6:-6]
    mean_power = np.mean(np.abs(drawn) ** 2, axis=0)[some]
    specular = codec.transform(expected.specular(0, 3))
    found_power = (np.abs(specular) ** 2 + expected.diffuse_power(0, 3))[some]
    ratio = found_power.mean(axis=(0, 2)) / mean_power.mean(axis=(0, 2))  # (ear, frame)
    loud = mean_power.mean(axis=(0, 2)) > 1e-6
    np.testing.assert_allclose(10 * np.log10(ratio[loud]), 0, atol=0.6)
    logarithms = np.mean(np.log(np.abs(drawn) + 1e-12), axis=0)[some]
    difference = (logarithms - expected.log_magnitude(0, 3)[some])[
        np.broadcast_to(loud[None, :, None], mean_power.shape)
    ]
    assert np.mean(difference) == pytest.approx(0, abs=0.02)
    # Of one draw it would be 0.64.
    assert np.std(difference) < 0.12


def test_a_dataset_without_energies_says_so(tiny_scene, tmp_path, codec):
    dataset = Dataset.create(tmp_path, tiny_scene, 0)
    with h5py.File(tmp_path / "pairs.h5", "r+") as file:
        del file["log_energy"]
    with pytest.raises(DatasetError, match="holds no energies"):
        ExpectedSpectrograms(dataset, codec).diffuse_power(0, 1)
    with pytest.raises(DatasetError, match="no energies were kept"):
        Dataset.create(tmp_path, tiny_scene, 0)
