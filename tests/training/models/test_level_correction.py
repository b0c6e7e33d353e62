import math

import numpy as np
import pytest
import torch

from server.acoustics.codec import Codec
from training.models.cells import Cells
from training.models.level_correction import (
    InterpolatedLevels,
    PowerBalance,
    band_correction,
    band_levels,
    level_correction,
)

IN_SIGHT, OUT_OF_SIGHT = torch.ones(4, 1), torch.zeros(4, 1)
LOUD = torch.tensor([[0.0, -1.0], [0.5, -0.5], [-0.3, -0.7], [0.1, -1.2]])


def test_what_all_predictions_lack_is_missing():
    balance = PowerBalance(torch.ones(2))
    balance.add(LOUD, LOUD - torch.tensor([0.3, 0.1]), IN_SIGHT)
    torch.testing.assert_close(balance.deficit()[1], torch.tensor([0.3, 0.1]))


def test_a_logarithm_of_noise_lacks_half_of_eulers_constant():
    """ln |S| of a Rayleigh-distributed magnitude lies so far, on average, below that of its mean power."""
    torch.manual_seed(0)
    magnitude = torch.randn(200_000, 2).square().sum(dim=1).sqrt()
    # The second level is the same everywhere, and most of a pair's power: shares are then those of powers.
    levels = torch.stack([torch.log(magnitude), torch.full_like(magnitude, 5.0)], dim=1)
    predicted = levels.mean(dim=0).expand_as(levels)
    balance = PowerBalance(torch.ones(2))
    balance.add(levels, predicted, torch.ones(len(levels), 1))
    assert float(balance.deficit()[1, 0]) == pytest.approx(0.5772 / 2, abs=0.01)


def test_pairs_in_sight_are_not_corrected_for_those_round_a_corner():
    balance = PowerBalance(torch.ones(2))
    balance.add(LOUD, LOUD, IN_SIGHT)
    balance.add(LOUD, LOUD - 2.0, OUT_OF_SIGHT)
    torch.testing.assert_close(balance.deficit(), torch.tensor([[2.0, 2.0], [0.0, 0.0]]))


def test_what_is_all_but_silent_does_not_count_for_being_far_off():
    true, predicted = LOUD.clone(), LOUD.clone()
    true[0, 0], predicted[0, 0] = -10.0, -15.0
    balance = PowerBalance(torch.ones(2))
    balance.add(true, predicted, IN_SIGHT)
    assert balance.deficit().abs().max() < 0.01


def test_far_pairs_count_as_much_as_near_ones():
    level = torch.tensor([[0.0, 0.0], [-6.0, -6.0]])
    lacks = torch.tensor([[0.0], [0.4]])
    balance = PowerBalance(torch.ones(2))
    balance.add(level, level - lacks, torch.ones(2, 1))
    expected = -0.5 * math.log((1 + math.exp(-0.8)) / 2)
    torch.testing.assert_close(balance.deficit()[1], torch.full((2,), expected))


def test_where_no_pair_is_out_of_sight_both_kinds_are_corrected_alike():
    balance = PowerBalance(torch.ones(2))
    balance.add(LOUD, LOUD - 0.2, IN_SIGHT)
    torch.testing.assert_close(balance.deficit(), torch.full((2, 2), 0.2))


CELLS = Cells(Codec(sample_rate=24_000, n_fft=256, hop=64, samples=19_200, log_floor=1e-5))


def levels_of_decay(t60_s: float) -> torch.Tensor:
    """(1, n) levels of one channel whose power falls by 60 dB in `t60_s`, in every bin alike."""
    codec = CELLS.codec
    power = np.broadcast_to(10 ** (-6 * codec.frame_times_s / t60_s), (codec.bins, codec.frames))
    late = CELLS.bands.pool().T @ power[:, CELLS.fine_frames :] @ CELLS.late_frames.pool()
    flat = np.concatenate([power[:, : CELLS.fine_frames].ravel(), late.ravel()])
    return torch.tensor(0.5 * np.log(flat)[None], dtype=torch.float32)


def reverberation_time_s(levels: torch.Tensor) -> float:
    """Of late cells' levels of one band as they are interpolated, by a straight line through what is to come of power
    between 10 and 30 dB below all of it."""
    late_cells = CELLS.late_frames.cells
    first = CELLS.codec.bins * CELLS.fine_frames
    columns = np.concatenate([levels[0, : CELLS.fine_frames], levels[0, first : first + late_cells]])
    power = np.exp(2 * columns.astype(np.float64) @ CELLS.all_frames.spread())
    to_come_db = 10 * np.log10(np.cumsum(power[::-1])[::-1] / power.sum())
    fitted = (to_come_db < -10) & (to_come_db > -30)
    return -60 / float(np.polyfit(CELLS.codec.frame_times_s[fitted], to_come_db[fitted], 1)[0])


def test_sound_that_does_not_decay_is_heard_as_it_is_predicted():
    levels = torch.full_like(levels_of_decay(1.0), -1.5)
    torch.testing.assert_close(InterpolatedLevels(CELLS, 1)(levels), levels)


def test_more_is_heard_of_a_cell_than_its_level_says_where_sound_decays():
    """By the factor sinh(2x) / 2x of power, x nepers being what amplitude loses in half a cell; here of eight frames,
    between others of eight, whose sum is not quite that integral."""
    levels = levels_of_decay(0.4)
    excess = (InterpolatedLevels(CELLS, 1)(levels) - levels)[0, CELLS.codec.bins * CELLS.fine_frames :]
    x = 8 / 2 * 64 / 24_000 * 3 * math.log(10) / 0.4
    assert float(excess[25]) == pytest.approx(0.5 * math.log(math.sinh(2 * x) / (2 * x)), rel=0.03)
    single = levels[:, : CELLS.codec.bins * CELLS.fine_frames]
    torch.testing.assert_close(InterpolatedLevels(CELLS, 1)(levels)[:, : single.shape[1]], single)


@pytest.mark.parametrize("t60_s", [0.3, 0.4, 0.5])
def test_sound_decays_as_fast_as_it_should_once_corrected(t60_s):
    levels = levels_of_decay(t60_s)
    heard = InterpolatedLevels(CELLS, 1)
    correction = level_correction(lambda: [(levels, levels, torch.ones(1, 1))], heard, torch.ones(levels.shape[1]))
    before, after = (reverberation_time_s(each) / t60_s - 1 for each in (levels, levels + correction[1]))
    assert before > 0.001
    assert abs(after) < 0.02 * before


def test_each_kind_of_pairs_is_corrected_by_its_own_predictions():
    examples = [(LOUD, LOUD - 0.1, IN_SIGHT), (LOUD, LOUD - 0.4, OUT_OF_SIGHT)]
    correction = level_correction(lambda: examples, torch.nn.Identity(), torch.ones(2))
    torch.testing.assert_close(correction, torch.tensor([[0.4, 0.4], [0.1, 0.1]]))


def test_what_is_heard_of_a_correction_is_corrected_too():
    """As where half of what a level is raised by is heard."""
    correction = level_correction(
        lambda: [(LOUD, LOUD - 0.4, IN_SIGHT)], lambda heard: LOUD + (heard - LOUD) / 2, torch.ones(2)
    )
    torch.testing.assert_close(correction[1], torch.full((2,), 0.2 + 0.1 + 0.05))


def test_the_level_of_a_band_is_that_of_its_energy():
    levels = torch.log(torch.tensor([[1.0, 2.0, 3.0]]))
    bands = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    areas = torch.tensor([4.0, 5.0, 1.0])
    torch.testing.assert_close(band_levels(levels, areas, bands), 0.5 * torch.log(torch.tensor([[13.0, 20.0]])))


def test_what_bands_lack_is_told_by_the_features_that_say_it():
    generator = torch.Generator().manual_seed(0)
    hidden = 3.0 + 0.5 * torch.randn(2_000, 4, generator=generator)
    weights, offsets = torch.tensor([[0.2, -0.1, 0.0, 0.0], [0.0, 0.0, 0.3, 0.0]]), torch.tensor([-0.4, 0.1])
    lacking = hidden @ weights.T + offsets + 0.1 * torch.randn(2_000, 2, generator=generator)
    found = band_correction(hidden, lacking)
    torch.testing.assert_close(found[:, 1:], weights, rtol=0, atol=0.02)
    torch.testing.assert_close(found[:, 0], offsets, rtol=0, atol=0.06)


def test_chance_tells_nothing_of_what_bands_lack():
    """Of fewer pairs than features, which could explain everything."""
    generator = torch.Generator().manual_seed(0)
    hidden, lacking = torch.randn(60, 200, generator=generator), torch.randn(60, 2, generator=generator)
    found = band_correction(hidden, lacking)
    others = torch.randn(500, 200, generator=generator)
    assert (others @ found[:, 1:].T).std() < 0.1
    torch.testing.assert_close(found[:, 0], lacking.mean(dim=0), rtol=0, atol=0.05)
