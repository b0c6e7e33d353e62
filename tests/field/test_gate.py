"""The gate that responses begin with: silence, a rise, and what it took given back to what follows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.field.gate import MOST_GIVEN, Gate
from server.health.double_precision import DoubleGate
from server.scene.manifest import CodecParameters

RATE, N_FFT, SAMPLES = 24_000, 256, 2_000
PARAMETERS = CodecParameters(
    sample_rate=RATE, n_fft=N_FFT, hop=64, samples=SAMPLES, lead_samples=40, known_frames=5, log_floor=1e-5
)
ONSETS = np.array([-100, -3, 0, 700, 700, 700, SAMPLES - 30, SAMPLES, 2**40])
ECHOES = np.array([-90, 4, 0, 690, 704, 900, SAMPLES - 20, 12, 2**40])

EITHER = pytest.mark.parametrize("is_compiled", [pytest.param(True, id="compiled"), pytest.param(False, id="numpy")])


def _gate(*, is_compiled=True, **options):
    gate = Gate(PARAMETERS, **options)
    return gate if is_compiled else DoubleGate(gate)


def _noise(count=1, channels=2, seed=0):
    return np.random.default_rng(seed).standard_normal((count, channels, SAMPLES)).astype(np.float32)


def _energy(responses):
    return np.sum(responses.astype(np.float64) ** 2, axis=-1)


@pytest.mark.parametrize("gives_back", [False, True])
@pytest.mark.parametrize("channels", [1, 2])
def test_compiled_and_numpy_agree(channels, gives_back):
    compiled = _noise(len(ONSETS), channels)
    reference = compiled.copy()
    for responses, is_compiled in ((compiled, True), (reference, False)):
        gate = _gate(rise_s=0.004, gives_back=gives_back, is_compiled=is_compiled)
        gate.open(responses, ONSETS, ECHOES)
    assert_allclose(compiled, reference, rtol=1e-5)
    assert np.all(_energy(compiled)[:-2] > 0.1)


@EITHER
def test_it_is_silent_until_sound_arrives_and_open_after_its_rise(is_compiled):
    responses = _noise(3)
    expected = responses.copy()
    _gate(rise_s=0.004, is_compiled=is_compiled).open(responses, np.array([-200, 300, 700]))
    assert_array_equal(responses[0], expected[0])
    for response, whole, onset in zip(responses[1:], expected[1:], (300, 700), strict=True):
        assert not response[:, :onset].any()
        assert_array_equal(response[:, onset + 96 :], whole[:, onset + 96 :])
        # A raised cosine: half of the amplitude in the middle, a hundredth at a sixteenth of the way.
        assert_allclose(
            response[:, onset + 47 : onset + 49].sum(axis=-1),
            whole[:, onset + 47 : onset + 49] @ (0.4918, 0.5082),
            rtol=1e-3,
        )
        assert np.all(np.abs(response[:, onset + 6]) < 0.012 * np.abs(whole[:, onset + 6]))


@EITHER
def test_it_is_silent_until_a_surface_has_answered(is_compiled):
    responses = _noise()
    expected = responses.copy()
    _gate(is_compiled=is_compiled).open(responses, np.array([300]), np.array([400]))
    assert not responses[..., : 400 - 7].any()
    assert responses[..., 400 - 7 : 400].all()
    assert_array_equal(responses[..., 400:], expected[..., 400:])


@pytest.mark.parametrize("echo", [None, 330])
def test_what_it_takes_follows_within_a_window(echo):
    """At each ear what that ear lost, and nothing of it later."""
    responses = _noise() * np.array([[[1.0], [0.1]]], np.float32)
    responses[..., :200] = 0
    expected = responses.copy()
    Gate(PARAMETERS, rise_s=0.004, gives_back=True).open(
        responses, np.array([300]), None if echo is None else np.array([echo])
    )
    opens = 300 if echo is None else echo - 7
    assert not responses[..., :opens].any()
    assert_array_equal(responses[..., opens + N_FFT :], expected[..., opens + N_FFT :])
    assert_allclose(_energy(responses), _energy(expected), rtol=1e-5)
    # Most of it at once: the first half of the window has far more of it than the second.
    more = responses.astype(np.float64) ** 2 - expected.astype(np.float64) ** 2
    middle = opens + N_FFT // 2
    first, second = more[..., opens + 96 : middle].sum() / (N_FFT // 2 - 96), more[..., middle:].sum() / (N_FFT // 2)
    assert first > 2.5 * second > 0


def test_what_little_there_is_is_not_made_up_of_what_was_taken():
    responses = _noise()
    responses[..., 300:] *= 1e-3
    expected = responses.copy()
    Gate(PARAMETERS, gives_back=True).open(responses, np.array([300]))
    most = np.abs(responses[..., 307:]) / np.abs(expected[..., 307:])
    assert most.max() <= np.sqrt(1 + MOST_GIVEN)
    assert most.max() > 0.9 * np.sqrt(1 + MOST_GIVEN)


@EITHER
def test_of_silence_nothing_is_given_back(is_compiled):
    responses = _noise()
    responses[..., 300:] = 0
    _gate(gives_back=True, is_compiled=is_compiled).open(responses, np.array([300]))
    assert not responses.any()


@EITHER
def test_as_many_responses_as_there_are_onsets(is_compiled):
    gate = _gate(is_compiled=is_compiled)
    with pytest.raises(ValueError, match="3 onsets and 3 echoes of 1 responses"):
        gate.open(_noise(), np.array([1, 2, 3]))
    with pytest.raises(ValueError, match="1 onsets and 2 echoes"):
        gate.open(_noise(), np.array([1]), np.array([1, 2]))


@pytest.mark.parametrize(("onset", "echo"), [(300, 300), (300, 420), (10, 3), (-5, -2), (990, 1_200), (1_000, 1_000)])
@pytest.mark.parametrize("after", [1.0, 1e-3, 0.0])
@pytest.mark.parametrize("gives_back", [False, True])
def test_gains_for_other_channels_are_those_of_the_gate(onset, echo, after, gives_back):
    gate = Gate(PARAMETERS, rise_s=0.004, gives_back=gives_back)
    responses = _noise()[:1, :1].copy()
    responses[..., 300:] *= after
    gains = gate.gains(responses[0, 0], onset, echo)
    expected = responses[0, 0].copy()
    expected[: len(gains)] *= gains
    assert np.isfinite(gains).all()
    gate.open(responses, np.array([onset]), np.array([echo]))
    assert_allclose(responses[0, 0], expected, rtol=1e-5, atol=1e-12)
