import numpy as np
import pytest

from training.baselines.regression import PairRegression

RNG = np.random.default_rng(2)
LISTENERS = np.column_stack([np.zeros(24), np.linspace(0.0, 2.0, 24), np.full(24, 1.2)])
EMITTERS = np.array([[1.0, 0.2, 1.2], [1.5, 1.1, 1.2], [2.0, 1.8, 1.3], [3.0, 0.8, 1.0]])
PAIRS = np.array([(e, r) for e in range(len(EMITTERS)) for r in range(len(LISTENERS))])
GAIN = RNG.normal(0.0, 1.0, len(LISTENERS))  # of each microphone


def smooth(emitter, listener):
    distance = np.linalg.norm(emitter - listener, axis=-1)
    return np.stack([-6 * np.log(distance), np.cos(2 * listener[:, 1] + emitter[:, 0])], axis=-1)


def held_out_errors(values, share=0.25, **options):
    """Root mean square error of the regression, and of the nearest listener of the same emitter."""
    out = np.random.default_rng(5).permutation(len(PAIRS))[: round(share * len(PAIRS))]
    kept = np.setdiff1d(np.arange(len(PAIRS)), out)
    emitter, listener = EMITTERS[PAIRS[:, 0]], LISTENERS[PAIRS[:, 1]]
    expected = PairRegression(emitter[kept], listener[kept], values[kept], **options)(emitter[out], listener[out])
    far = np.linalg.norm(listener[out][:, None] - listener[kept], axis=-1) + 10 * (PAIRS[out, :1] != PAIRS[kept, 0])
    nearest = values[kept][far.argmin(axis=1)]
    return (float(np.sqrt(np.mean((estimate - values[out]) ** 2))) for estimate in (expected, nearest))


def test_what_is_smooth_is_found_between_places():
    regression, nearest = held_out_errors(smooth(EMITTERS[PAIRS[:, 0]], LISTENERS[PAIRS[:, 1]]))
    assert regression < 0.2 * nearest


def test_a_microphones_gain_is_learned_from_other_emitters():
    values = smooth(EMITTERS[PAIRS[:, 0]], LISTENERS[PAIRS[:, 1]]) + GAIN[PAIRS[:, 1], None]
    regression, nearest = held_out_errors(values)
    assert regression < 0.2 * nearest


def test_noise_is_averaged_and_not_believed():
    noise = np.random.default_rng(6).normal(0.0, 1.0, (len(PAIRS), 4))
    regression, nearest = held_out_errors(noise)
    assert regression < 1.15  # that of the mean is 1
    assert nearest > 1.25


def test_measurements_without_noise_are_given_back():
    emitter, listener = EMITTERS[PAIRS[:, 0]], LISTENERS[PAIRS[:, 1]]
    values = smooth(emitter, listener)
    np.testing.assert_allclose(PairRegression(emitter, listener, values)(emitter, listener), values, atol=0.1)


@pytest.mark.parametrize("moving", ["listener", "emitter"])
def test_one_end_may_stand_still(moving):
    still, ends = np.tile(EMITTERS[:1], (24, 1)), LISTENERS
    given = (still, ends) if moving == "listener" else (ends, still)
    values = np.sin(2 * ends[:, 1:2])
    kept = np.arange(24) % 3 != 1
    expected = PairRegression(given[0][kept], given[1][kept], values[kept])(given[0][~kept], given[1][~kept])
    np.testing.assert_allclose(expected, values[~kept], atol=0.1)


def test_what_never_changes_stays():
    emitter, listener = EMITTERS[PAIRS[:, 0]], LISTENERS[PAIRS[:, 1]]
    expected = PairRegression(emitter, listener, np.full((len(PAIRS), 2), 3.5))(emitter + 0.1, listener - 0.2)
    np.testing.assert_allclose(expected, 3.5)
