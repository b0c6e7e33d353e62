import numpy as np
import pytest

from training.baselines.baselines import TrainingPairs, nearest
from training.baselines.helmholtz import REGULARISATIONS, HelmholtzInterpolation, kernel, left_out_errors, octaves

RATE = 8_000
SAMPLES = 800
C = 343.0


def plane_waves(listeners, directions, low_hz=60.0, high_hz=400.0):
    """(listener, 1 yaw, 1 channel, sample): band-limited pulses from all directions, each its own way to arrive."""
    size = 4 * SAMPLES
    frequency = np.fft.rfftfreq(size, 1 / RATE)
    band = np.where(
        (frequency > low_hz) & (frequency < high_hz),
        np.sin(np.pi * np.clip((frequency - low_hz) / (high_hz - low_hz), 0, 1)) ** 2,
        0,
    )
    spectra = np.zeros((len(listeners), len(frequency)), complex)
    for number, direction in enumerate(directions):
        delay = 0.05 + 0.002 * number + listeners @ direction / C
        spectra += band * np.exp(-2j * np.pi * frequency * delay[:, None])
    return np.fft.irfft(spectra, size)[:, None, None, :SAMPLES]


@pytest.fixture
def directions():
    random = np.random.default_rng(3)
    vectors = random.standard_normal((6, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.fixture
def pairs(directions) -> TrainingPairs:
    """Listeners in a cube, 0.35 m apart: less than half of the shortest wavelength. The last one stands among them."""
    axis = 0.35 * np.arange(4)
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    listeners = np.concatenate([cube, [[0.55, 0.5, 0.48]]])
    count = len(listeners)
    training = np.arange(count) < count - 1
    responses = plane_waves(listeners, directions)
    return TrainingPairs(responses, np.arange(count), np.zeros(count, int), listeners, np.zeros((2, 3)), training)


def test_a_sound_field_is_found_between_listeners(pairs):
    target = len(pairs.training) - 1
    found = HelmholtzInterpolation(pairs, RATE).response(target)
    truth = pairs.responses[target]
    error = np.square(found - truth).sum() / np.square(truth).sum()
    assert error < 0.01
    assert np.square(nearest(pairs, target) - truth).sum() / np.square(truth).sum() > 10 * error


def test_the_low_pass_is_silent_above_and_the_same_below(pairs):
    target = len(pairs.training) - 1
    plain = HelmholtzInterpolation(pairs, RATE)
    low = HelmholtzInterpolation(pairs, RATE, cutoff_hz=180.0)
    low.regularisations = plain.regularisations
    spectra = [np.abs(np.fft.rfft(method.response(target)[0, 0])) for method in (plain, low)]
    frequency = np.fft.rfftfreq(SAMPLES, 1 / RATE)
    loudest = spectra[0].max()
    np.testing.assert_allclose(spectra[1][frequency < 170], spectra[0][frequency < 170], atol=0.02 * loudest)
    assert spectra[1][frequency > 300].max() < 0.01 * loudest < spectra[0][frequency > 300].max()


def test_without_a_listener_of_the_emitter_there_is_no_answer(pairs):
    pairs.pair_emitter[-1] = 1
    assert HelmholtzInterpolation(pairs, RATE).response(len(pairs.training) - 1) is None


def test_the_kernel_solves_the_helmholtz_equation():
    """Laplacian of K plus k squared K is zero, by central differences."""
    frequency, step = np.array([300.0]), 1e-3
    at = np.array([0.4, -0.3, 0.7])
    offsets = np.concatenate([np.zeros((1, 3)), step * np.eye(3), -step * np.eye(3)])
    values = kernel(frequency, np.linalg.norm(at + offsets, axis=-1))[0]
    laplacian = (values[1:].sum() - 6 * values[0]) / step**2
    wave_number = 2 * np.pi * frequency[0] / C
    assert laplacian == pytest.approx(-(wave_number**2) * values[0], rel=1e-4)
    np.testing.assert_allclose(kernel(np.array([0.0, 500.0]), np.zeros(2)), 1)


def test_errors_of_left_out_listeners_are_those_of_leaving_them_out():
    random = np.random.default_rng(0)
    points = random.uniform(0, 1, (7, 3))
    matrix = kernel(np.array([100.0, 400.0]), np.linalg.norm(points[:, None] - points, axis=-1))
    values = random.standard_normal((2, 7, 3)) + 1j * random.standard_normal((2, 7, 3))
    errors = left_out_errors(matrix, values, 0.05)
    for left in range(7):
        kept = np.arange(7) != left
        for row in range(2):
            inside = matrix[row][np.ix_(kept, kept)] + 0.05 * np.eye(6)
            estimate = matrix[row, left, kept] @ np.linalg.solve(inside, values[row, kept])
            np.testing.assert_allclose(values[row, left] - estimate, errors[row, left])


def test_noise_asks_for_more_regularisation(pairs):
    clean = HelmholtzInterpolation(pairs, RATE)
    noise = np.random.default_rng(0).standard_normal(pairs.responses.shape)
    noisy = TrainingPairs(
        pairs.responses + 0.5 * pairs.responses.std() * noise,
        pairs.pair_listener,
        pairs.pair_emitter,
        pairs.listener_positions,
        pairs.emitter_positions,
        pairs.training,
    )
    sounding = octaves(np.array([100.0, 150.0, 280.0]))
    assert np.all(clean.regularisations[sounding] == min(REGULARISATIONS))
    assert np.all(HelmholtzInterpolation(noisy, RATE).regularisations[sounding] > min(REGULARISATIONS))


def test_octaves_double():
    found = octaves(np.array([0.0, 60.0, 124.0, 126.0, 249.0, 251.0, 1001.0]))
    np.testing.assert_array_equal(found, [0, 0, 0, 1, 1, 2, 4])
