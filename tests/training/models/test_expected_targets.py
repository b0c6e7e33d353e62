import numpy as np
import pytest
from rich.progress import Progress

from training.models.cells import Cells
from training.models.expected_targets import expected_phasor
from training.models.factorised import Heads
from training.models.stored_targets import load_expected_points, load_targets
from training.models.targets import align, codec_of, delay_samples
from training.simulation.responses import SimulatedResponses


@pytest.mark.parametrize("ratio", [0.0, 1e-6, 0.3, 1.0, 4.0, 30.0, 1e6])
def test_the_expected_phasor_is_the_mean_of_many(ratio):
    rng = np.random.default_rng(0)
    variance = 3e-4
    mean = np.sqrt(ratio * variance) * np.exp(1j)
    noise = np.sqrt(variance / 2) * (rng.standard_normal(200_000) + 1j * rng.standard_normal(200_000))
    true = np.mean((mean + noise) / np.abs(mean + noise))
    assert expected_phasor(np.array(mean), np.array(variance)) == pytest.approx(true, abs=0.006)


def test_a_phasor_without_noise_is_certain_and_one_of_nothing_is_not():
    assert expected_phasor(np.array(0.2j), np.array(0.0)) == pytest.approx(1j)
    assert expected_phasor(np.array(0j), np.array(0.0)) == 0


@pytest.fixture(scope="module")
def both(dataset, tmp_path_factory):
    """Heads, and targets of drawn and of expected responses by head: (row, ...)."""
    responses = SimulatedResponses(dataset)
    cells = Cells(codec_of(responses), known_frames=8)
    folder = tmp_path_factory.mktemp("targets")
    heads = Heads(cells)
    found = []
    for expected in (False, True):
        flat = load_targets(responses, cells, folder, Progress(disable=True), expected=expected).flat
        flat = np.array(flat, dtype=np.float64)
        found.append({name: flat[:, part].reshape(-1, *heads.shapes[name]) for name, part in heads.slices.items()})
    return found


@pytest.fixture(scope="module")
def points(dataset, tmp_path_factory):
    """The codec of the paper's network, and expected points (row, ear, frequency, frame, 2) with drawn spectrograms."""
    responses = SimulatedResponses(dataset)
    codec = codec_of(responses, 512)
    stored = load_expected_points(responses, codec, tmp_path_factory.mktemp("points"), Progress(disable=True))
    expected = np.array(stored.flat, float).reshape(-1, 2, codec.bins, codec.frames, 2)
    rows = np.flatnonzero(~responses.held_out)
    aligned = [align(responses.read([row])[0], delay_samples(responses, row)) for row in rows]
    return codec, expected, codec.transform(np.stack(aligned))


def test_the_expected_level_of_a_point_is_that_of_the_power_of_many_draws(points):
    codec, expected, drawn = points
    level = np.log(np.mean(np.exp(2 * expected[..., 0]), axis=(0, 1))) / 2
    true = np.log(np.mean(np.abs(drawn) ** 2, axis=(0, 1)) + codec.log_floor**2) / 2
    loud = level > np.quantile(level, 0.3)
    assert abs(np.mean((level - true)[loud])) < 0.05
    assert np.median(np.abs(level - true)[loud]) < 0.2


def test_the_expected_frequency_is_where_products_of_consecutive_frames_point(points):
    """Weighted by power, drawn products turned back by what is expected point along the real axis. Where something else
    than noise is expected, which is where sound is specular, they do not without."""
    codec, expected, drawn = points
    product = drawn[..., 1:] * np.conj(drawn[..., :-1]) * np.exp(-1j * codec.nominal_advance)
    turned = product * np.exp(-1j * expected[..., 1:, 1])
    specular = np.abs(expected[..., 1:, 1]) > 1.0
    along, unturned = (np.sum(values[specular].real) / np.sum(np.abs(values[specular])) for values in (turned, product))
    assert along > unturned + 0.2
    assert abs(np.sum(turned.imag) / np.sum(np.abs(turned))) < 0.02


def test_of_noise_alone_the_expected_frequency_is_zero(points):
    """After the mirrored reflections, and before an aligned response fades out."""
    _, expected, _ = points
    assert np.mean(np.abs(expected[..., 10:20, 1]) < 0.05) > 0.99


@pytest.mark.parametrize("name", ["fine", "late"])
def test_drawn_responses_scatter_around_what_is_expected(both, name):
    drawn, expected = (part[name] for part in both)
    # Power over all responses, where there is any: nepers.
    power = [np.log(np.mean(np.exp(2 * levels), axis=0)) / 2 for levels in (drawn, expected)]
    loud = power[1] > np.quantile(power[1], 0.3)
    assert np.median(np.abs(power[0] - power[1])[loud]) < 0.2
    assert abs(np.mean((power[0] - power[1])[loud])) < 0.1


def test_coherence_is_what_drawn_ears_have_in_common(both):
    """In the widest cells, where one draw has little noise: regressing drawn on expected values."""
    drawn, expected = (part["interaural"][..., 30:-4, -12:-2] for part in both)
    assert np.sum(drawn * expected) / np.sum(expected**2) == pytest.approx(1, abs=0.1)
    assert np.corrcoef(drawn.ravel(), expected.ravel())[0, 1] > 0.4


def test_phasors_point_where_drawn_ones_do_and_are_as_long_as_that_is_sure(both):
    """Regressing drawn phasors on expected ones gives one: neither is a phase claimed that is not there, nor missed."""
    drawn, expected = (part["phasor"] for part in both)
    loud = np.broadcast_to(both[1]["fine"][:, None, ..., :8] > np.log(1e-3), expected.shape)
    assert np.sum((drawn * expected)[loud]) / np.sum((expected**2)[loud]) == pytest.approx(1, abs=0.1)
    assert 0.05 < np.sqrt(np.mean(expected[loud] ** 2)) < 0.7
