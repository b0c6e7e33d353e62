import numpy as np
import pytest

from training.learning.pairs import split
from training.simulation.responses import SimulatedResponses


def couples(responses, rows):
    trainable = np.flatnonzero(~responses.held_out)[rows]
    ends = zip(responses.emitter[trainable], responses.listener[trainable], strict=True)
    return {frozenset((tuple(one), tuple(other))) for one, other in ends}


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_held_back_is_trained_on_in_either_direction(dataset, seed):
    responses = SimulatedResponses(dataset)
    training, held_back = split(responses, share=1.0, seed=seed)
    assert not couples(responses, training) & couples(responses, held_back)
    assert len(training) + len(held_back) == np.sum(~responses.held_out)
    assert len(couples(responses, held_back)) == 1


def test_smaller_shares_are_among_larger_ones_and_hold_back_the_same(dataset):
    responses = SimulatedResponses(dataset)
    parts = [split(responses, share=share, seed=3) for share in (0.25, 0.5, 1.0)]
    rows = [set(training) for training, _ in parts]
    assert rows[0] < rows[1] < rows[2]
    pairs = [len(row) // len(dataset.yaws) for row in rows]
    assert pairs == [round(share * pairs[2]) for share in (0.25, 0.5, 1.0)]
    for _, held_back in parts:
        np.testing.assert_array_equal(held_back, parts[0][1])
