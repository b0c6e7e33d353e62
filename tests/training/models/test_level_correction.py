import math

import pytest
import torch

from training.models.level_correction import PowerBalance

IN_SIGHT, OUT_OF_SIGHT = torch.ones(4, 1), torch.zeros(4, 1)
LOUD = torch.tensor([[0.0, -1.0], [0.5, -0.5], [-0.3, -0.7], [0.1, -1.2]])


def test_what_all_predictions_lack_is_missing():
    balance = PowerBalance(torch.ones(2))
    balance.add(LOUD, LOUD - torch.tensor([0.3, 0.1]), IN_SIGHT)
    torch.testing.assert_close(balance.missing()[1], torch.tensor([0.3, 0.1]))


def test_a_logarithm_of_noise_lacks_half_of_eulers_constant():
    """ln |S| of a Rayleigh-distributed magnitude lies so far, on average, below that of its mean power."""
    torch.manual_seed(0)
    magnitude = torch.randn(200_000, 2).square().sum(dim=1).sqrt()
    # The second level is the same everywhere, and most of a pair's power: shares are then those of powers.
    levels = torch.stack([torch.log(magnitude), torch.full_like(magnitude, 5.0)], dim=1)
    predicted = levels.mean(dim=0).expand_as(levels)
    balance = PowerBalance(torch.ones(2))
    balance.add(levels, predicted, torch.ones(len(levels), 1))
    assert float(balance.missing()[1, 0]) == pytest.approx(0.5772 / 2, abs=0.01)


def test_pairs_in_sight_are_not_corrected_for_those_round_a_corner():
    balance = PowerBalance(torch.ones(2))
    balance.add(LOUD, LOUD, IN_SIGHT)
    balance.add(LOUD, LOUD - 2.0, OUT_OF_SIGHT)
    torch.testing.assert_close(balance.missing(), torch.tensor([[2.0, 2.0], [0.0, 0.0]]))


def test_what_is_all_but_silent_does_not_count_for_being_far_off():
    true, predicted = LOUD.clone(), LOUD.clone()
    true[0, 0], predicted[0, 0] = -10.0, -15.0
    balance = PowerBalance(torch.ones(2))
    balance.add(true, predicted, IN_SIGHT)
    assert balance.missing().abs().max() < 0.01


def test_far_pairs_count_as_much_as_near_ones():
    level = torch.tensor([[0.0, 0.0], [-6.0, -6.0]])
    lacks = torch.tensor([[0.0], [0.4]])
    balance = PowerBalance(torch.ones(2))
    balance.add(level, level - lacks, torch.ones(2, 1))
    expected = -0.5 * math.log((1 + math.exp(-0.8)) / 2)
    torch.testing.assert_close(balance.missing()[1], torch.full((2,), expected))


def test_where_no_pair_is_out_of_sight_both_kinds_are_corrected_alike():
    balance = PowerBalance(torch.ones(2))
    balance.add(LOUD, LOUD - 0.2, IN_SIGHT)
    torch.testing.assert_close(balance.missing(), torch.full((2, 2), 0.2))
