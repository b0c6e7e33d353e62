import numpy as np
import pytest
from rich.progress import Progress

from server.acoustics.codec import Codec
from training.models.cells import Cells
from training.models.factorised import Heads
from training.models.targets import codec_of, expected_levels, flat_targets, load_targets
from training.responses import SimulatedResponses


def test_levels_of_a_known_power_are_those_of_its_noise():
    """White noise of variance s has power s times the window's energy in every bin."""
    codec = Codec(16_000, 256, 64, 4_000, 1e-5)
    cells = Cells(codec)
    levels = expected_levels(np.full((2, codec.bins, codec.frames), 0.25 * codec.window_energy), cells)
    np.testing.assert_allclose(levels.astype(float), 0.5 * np.log(0.25 * codec.window_energy), atol=2e-3)
    noise = 0.5 * np.random.default_rng(0).standard_normal((200, 2, codec.samples))
    drawn = flat_targets(noise, cells)[:, : levels.shape[-1]].astype(float)
    mean_power = np.log(np.mean(np.exp(2 * drawn), axis=0)) / 2
    # Bins at either end of spectrum and signal see other power.
    assert np.median(np.abs(mean_power - levels)) < 0.05


@pytest.fixture(scope="module")
def both(dataset, tmp_path_factory):
    responses = SimulatedResponses(dataset)
    cells = Cells(codec_of(responses))
    flats = [
        load_targets(responses, cells, tmp_path_factory.mktemp("t"), Progress(disable=True), expected=expected).flat
        for expected in (False, True)
    ]
    return Heads(cells), *(np.array(flat, dtype=np.float64) for flat in flats)


def test_drawn_responses_scatter_around_what_is_expected(both):
    heads, drawn, expected = both
    for name, tolerance in (("fine", 0.1), ("late", 0.1)):
        part = heads.slices[name]
        # Power over all responses, where there is any: nepers.
        power = [np.log(np.mean(np.exp(2 * flat[:, part]), axis=0)) / 2 for flat in (drawn, expected)]
        loud = power[1] > np.quantile(power[1], 0.3)
        assert np.median(np.abs(power[0] - power[1])[loud]) < tolerance * 2
        assert abs(np.mean((power[0] - power[1])[loud])) < tolerance


def test_phases_and_coherences_stay_as_drawn(both):
    heads, drawn, expected = both
    for name in ("phasor", "interaural"):
        np.testing.assert_array_equal(drawn[:, heads.slices[name]], expected[:, heads.slices[name]])
