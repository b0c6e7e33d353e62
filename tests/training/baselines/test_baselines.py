import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from training.baselines.baselines import TrainingPairs, linear, linear_aligned, linear_weights, nearest, nearest_pair

RATE = 24_000
SPEED_OF_SOUND = 343.0


def grid_pairs(held_out: list[int], *, listeners: npt.NDArray[np.float64] | None = None) -> TrainingPairs:
    """Two emitters and a 4 x 3 grid of listeners; pair = emitter * listeners + listener."""
    if listeners is None:
        x, y = np.meshgrid(np.arange(4.0), np.arange(3.0), indexing="ij")
        listeners = np.stack([x.ravel(), y.ravel(), np.full(12, 1.5)], axis=-1)
    emitters = np.array([[0.5, -1.0, 1.5], [9.0, 1.0, 1.5]])
    pair_listener = np.tile(np.arange(len(listeners)), 2)
    pair_emitter = np.repeat([0, 1], len(listeners))
    position = listeners[pair_listener]
    plane = 1.0 + position[:, 0] + 2.0 * position[:, 1] + 100.0 * pair_emitter  # linear in the listener's position
    responses = np.broadcast_to(plane[:, None, None, None], (len(plane), 3, 2, 4)).astype(np.float16)
    training = np.ones(len(plane), dtype=bool)
    training[held_out] = False
    return TrainingPairs(responses, pair_listener, pair_emitter, listeners, emitters, training)


@pytest.mark.parametrize("pair", [4, 7, 16, 19])  # listeners 4 and 7 are inside the grid
def test_linear_reproduces_a_plane(pair: int) -> None:
    pairs = grid_pairs([pair])
    assert_allclose(linear(pairs, pair), pairs.responses[pair], rtol=1e-3)


@pytest.mark.parametrize("pair", range(24))
def test_weights_are_barycentric(pair: int) -> None:
    pairs = grid_pairs([pair, 2, 15])
    neighbours, weights = linear_weights(pairs, pair)
    assert all(pairs.training[neighbours])
    assert_array_equal(pairs.pair_emitter[neighbours], pairs.pair_emitter[pair])
    assert min(weights) >= 0.0
    assert_allclose(sum(weights), 1.0)
    positions = pairs.listener_positions[pairs.pair_listener[neighbours]]
    target = pairs.listener_positions[pairs.pair_listener[pair]]
    if len(neighbours) > 1:
        assert_allclose(np.asarray(weights) @ positions, target, atol=1e-9)
    else:
        others = pairs.training & (pairs.pair_emitter == pairs.pair_emitter[pair])
        distances = np.linalg.norm(pairs.listener_positions[pairs.pair_listener[others]] - target, axis=-1)
        assert_allclose(np.linalg.norm(positions[0] - target), distances.min())


def test_outside_the_hull_linear_is_the_nearest_listener() -> None:
    pairs = grid_pairs([0])
    neighbours, weights = linear_weights(pairs, 0)
    assert neighbours in ([1], [3])
    assert weights == [1.0]


def test_listeners_on_a_line() -> None:
    line = np.array([[0.0, 0.0, 1.5], [1.0, 1.0, 1.5], [3.0, 3.0, 1.5]])
    neighbours, weights = linear_weights(grid_pairs([1], listeners=line), 1)
    assert dict(zip(neighbours, np.round(weights, 9), strict=True)) == {0: 0.666666667, 2: 0.333333333}


def test_listeners_at_several_heights_surround_in_plan() -> None:
    cube = np.array([[x, y, z] for x in (0.0, 2.0) for y in (0.0, 2.0) for z in (1.0, 2.0)] + [[0.7, 1.1, 1.3]])
    pairs = grid_pairs([8], listeners=cube)
    neighbours, weights = linear_weights(pairs, 8)
    assert_allclose(np.asarray(weights) @ cube[neighbours, :2], cube[8, :2], atol=1e-9)


def test_an_emitter_without_training_pairs_falls_back_to_the_nearest_pair() -> None:
    pairs = grid_pairs(list(range(12, 24)))
    assert linear_weights(pairs, 15) == ([nearest_pair(pairs, 15)], [1.0])
    assert nearest_pair(pairs, 15) == 3  # the same listener with the other emitter


@pytest.mark.parametrize("pair", range(24))
def test_nearest_is_the_closest_in_both_positions(pair: int) -> None:
    pairs = grid_pairs([pair, 5, 6, 17])
    poses = np.concatenate(
        [pairs.listener_positions[pairs.pair_listener], pairs.emitter_positions[pairs.pair_emitter]], axis=-1
    )
    distances = np.where(pairs.training, np.linalg.norm(poses - poses[pair], axis=-1), np.inf)
    found = nearest_pair(pairs, pair)
    assert_allclose(distances[found], distances.min())
    assert_array_equal(nearest(pairs, pair), pairs.responses[found])


def test_without_training_pairs_there_is_no_baseline() -> None:
    with pytest.raises(ValueError, match="no pair"):
        grid_pairs(list(range(24)))


class TestAligned:
    LISTENERS = np.array([[0.0, 0.0, 1.5], [2.0, 0.0, 1.5], [1.0, 0.0, 1.5]])

    def pulses(self) -> tuple[TrainingPairs, npt.NDArray[np.float64]]:
        """A band-limited pulse at the propagation delay of each pair, with fractions of samples."""
        template = grid_pairs([2], listeners=self.LISTENERS)
        distances = np.linalg.norm(
            self.LISTENERS[template.pair_listener] - template.emitter_positions[template.pair_emitter], axis=-1
        )
        delays_s = distances / SPEED_OF_SOUND
        time_s = np.arange(2_400) / RATE
        pulse = np.exp(-0.5 * np.square((time_s - delays_s[:, np.newaxis]) / 8e-5))
        responses = np.broadcast_to(pulse[:, None, None, :], (len(pulse), 3, 2, len(time_s)))
        return TrainingPairs(
            responses,
            template.pair_listener,
            template.pair_emitter,
            template.listener_positions,
            template.emitter_positions,
            template.training,
        ), delays_s

    @pytest.mark.parametrize("emitter", [0, 1])
    def test_moves_pulses_onto_the_direct_sound(self, emitter: int) -> None:
        pairs, delays_s = self.pulses()
        pairs.training[5] = False
        pair = 2 + 3 * emitter
        aligned = linear_aligned(pairs, pair, delays_s, RATE)
        assert_allclose(aligned, pairs.responses[pair], atol=2e-3)
        if emitter == 1:  # here the neighbours arrive apart, and plain interpolation gives two small pulses
            assert np.abs(linear(pairs, pair) - pairs.responses[pair]).max() > 0.4

    @pytest.mark.parametrize("later_s", [-0.2, 0.2])
    def test_a_shift_past_either_end_leaves_silence(self, later_s: float) -> None:
        pairs, delays_s = self.pulses()
        delays_s[2] += later_s
        assert not linear_aligned(pairs, 2, delays_s, RATE).any()
