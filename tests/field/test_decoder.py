"""Spectrograms to responses: compiled and not, and what each choice of phase promises."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.codec import Codec
from server.acoustics.phase import FrozenNoise, griffin_lim
from server.field.decoder import Decoder, is_compiled_size
from server.field.graph import Spectrograms
from server.scene.manifest import CodecParameters, Phase
from tests.oracles.decoder import NumpyDecoder

SAMPLES = 3_000
FROZEN, INTEGRATED = Phase(), Phase(kind="integrated")


def _parameters(n_fft=128, samples=SAMPLES, known=5, floor=1e-5):
    return CodecParameters(
        sample_rate=24_000,
        n_fft=n_fft,
        hop=n_fft // 4,
        samples=samples,
        lead_samples=40,
        known_frames=known,
        log_floor=floor,
    )


def _iterations(count, *, warm=False):
    return Phase(kind="griffin_lim", iterations=count, warm=warm)


def _decoder(parameters, phase=FROZEN, *, kind=Decoder, **options):
    noise = np.random.default_rng(9).standard_normal((2, parameters.samples))
    return kind(
        parameters,
        FrozenNoise.from_signal(parameters.codec, noise),
        **{"ir_samples": SAMPLES, **options},
        phase=phase,
    )


def _predicted(parameters, count=1, seed=0):
    """Decaying, with everything a network may say at random."""
    codec, rng = parameters.codec, np.random.default_rng(seed)
    shape, known = (count, 2, codec.bins, codec.frames), (count, 2, codec.bins, parameters.known_frames)
    decay = np.linspace(0, -7, codec.frames)
    return Spectrograms(
        (decay + 0.5 * rng.standard_normal(shape)).astype(np.float32),
        rng.uniform(-np.pi, np.pi, known).astype(np.float32),
        rng.uniform(0, 1, known).astype(np.float32),
        rng.uniform(-0.9, 0.9, shape).astype(np.float32),
    )


def _coded(codec: Codec, signals) -> Spectrograms:
    """What a network would say that knows everything."""
    log_magnitude, frequency = codec.encode(signals)
    nothing = np.zeros(log_magnitude.shape, np.float32)
    return Spectrograms(log_magnitude.astype(np.float32), frequency.astype(np.float32), nothing, nothing)


def _decaying(codec: Codec, seed=3):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((1, 2, codec.samples)) * np.exp(-np.arange(codec.samples) / 600) * 0.1


def _inconsistency(codec: Codec, magnitude, signal) -> float:
    """Spectral convergence: how far the signal's magnitudes are from those asked for, relative."""
    return float(np.linalg.norm(np.abs(codec.transform(signal)) - magnitude) / np.linalg.norm(magnitude))


@dataclass(frozen=True)
class Case:
    parameters: CodecParameters
    phase: Phase = FROZEN
    frames: int | None = None


CASES = {
    "frozen": Case(_parameters()),
    "nothing known": Case(_parameters(known=0)),
    "all known": Case(_parameters(known=_parameters().codec.frames)),
    "another window": Case(_parameters(256)),
    "codec longer than responses": Case(_parameters(samples=SAMPLES + 500)),
    "codec shorter than responses": Case(_parameters(samples=SAMPLES - 500)),
    "first frames": Case(_parameters(), frames=21),
    "fewer frames than known": Case(_parameters(), frames=3),
    "integrated": Case(_parameters(known=_parameters().codec.frames), INTEGRATED),
    "iterated": Case(_parameters(), _iterations(1, warm=True)),
    "first frames, iterated": Case(_parameters(), _iterations(1, warm=True), frames=21),
}
ALIGNED = np.array([0.0, 100.0, 431.37, -40.0, -17.6, 32.5, SAMPLES - 90.2, 1e5])
"""Starts of responses, where they are heard from the first sample on, late, and never."""


@pytest.mark.parametrize("name", CASES)
def test_compiled_and_numpy_agree(name):
    case = CASES[name]
    assert is_compiled_size(case.parameters)
    predicted = _predicted(case.parameters, len(ALIGNED))
    compiled, reference = (
        _decoder(case.parameters, case.phase, frames=case.frames, kind=kind).decode(predicted, ALIGNED)
        for kind in (Decoder, NumpyDecoder)
    )
    assert np.abs(reference[:-1]).max(axis=(1, 2)).min() > 1e-3
    assert not compiled[-1].any()
    difference = np.linalg.norm(compiled - reference, axis=(1, 2))
    assert np.all(difference[:-1] < 1e-5 * np.linalg.norm(reference[:-1], axis=(1, 2)))


def test_a_window_that_is_no_power_of_two_is_decoded_all_the_same():
    parameters = _parameters(192)
    predicted = _predicted(parameters)
    assert not is_compiled_size(parameters)
    expected = _decoder(parameters, kind=NumpyDecoder).decode(predicted, np.array([50.5]))
    assert_array_equal(_decoder(parameters).decode(predicted, np.array([50.5])), expected)
    assert np.abs(expected).max() > 1e-3


def test_rows_of_a_batch_do_not_mix():
    parameters = _parameters()
    predicted, decoder = _predicted(parameters, 4), _decoder(parameters)
    together = decoder.decode(predicted, ALIGNED[:4])
    for row in (2, 0, 3, 1):
        rows = slice(row, row + 1)
        assert_array_equal(decoder.decode(predicted[rows], ALIGNED[rows])[0], together[row])


@pytest.mark.parametrize("aligned", [0, 57])
def test_integrated_phase_of_all_frames_gives_back_what_was_coded(aligned):
    parameters = _parameters(known=_parameters().codec.frames, floor=1e-7)
    signals = _decaying(parameters.codec)
    decoded = _decoder(parameters, INTEGRATED).decode(_coded(parameters.codec, signals), np.array([float(aligned)]))
    expected = np.zeros_like(signals)
    expected[..., aligned:] = signals[..., : SAMPLES - aligned]
    assert_allclose(decoded, expected, atol=2e-5)


def test_frames_after_the_first_are_silent_and_those_before_unchanged():
    parameters = _parameters()
    predicted = _predicted(parameters)
    whole = _decoder(parameters).decode(predicted, np.array([64.0]))
    part = _decoder(parameters, frames=30).decode(predicted, np.array([64.0]))
    # Frame 30 begins that many hops on, less the first frame's reach before the signal.
    begins = 64 + 30 * parameters.hop - parameters.codec.frame_lead_samples
    ends = begins - parameters.hop + parameters.n_fft
    assert_allclose(part[..., :begins], whole[..., :begins], atol=1e-6)
    assert np.abs(whole[..., ends:]).max() > 1e-3
    assert not part[..., ends:].any()


def test_iterations_bring_magnitudes_closer_to_those_asked_for():
    parameters = _parameters(floor=1e-7)
    codec = parameters.codec
    signals = _decaying(codec)
    magnitude = np.abs(codec.transform(signals))
    found = [
        _inconsistency(
            codec, magnitude, _decoder(parameters, _iterations(count)).decode(_coded(codec, signals), np.zeros(1))
        )
        for count in (1, 4, 16, 64)
    ]
    assert np.all(np.diff(found) < 0)
    assert found[-1] < 0.6 * found[0]


def test_near_the_goal_two_iterations_do_more_than_sixty_from_nothing():
    parameters = _parameters(floor=1e-7)
    codec = parameters.codec
    signals = _decaying(codec)
    magnitude = np.abs(codec.transform(signals))
    near = (signals + 0.2 * np.roll(_decaying(codec, seed=4), 5)).astype(np.float32)
    warm = _decoder(parameters, _iterations(2, warm=True)).decode(_coded(codec, signals), np.zeros(1), list(near))
    cold = _decoder(parameters, _iterations(60)).decode(_coded(codec, signals), np.zeros(1))
    assert _inconsistency(codec, magnitude, warm) < 0.5 * _inconsistency(codec, magnitude, cold)


def test_a_warm_start_from_noise_keeps_the_ears_as_different_as_asked():
    """From zero phase both ears have the same, and come out alike; the frozen phase has the coherence predicted."""
    parameters = _parameters(known=0)
    predicted = _predicted(parameters)
    predicted.interaural[:] = 0
    predicted.log_magnitude[:] = np.linspace(0, -7, parameters.codec.frames)

    def coherence(phase):
        left, right = _decoder(parameters, phase).decode(predicted, np.array([64.0]))[0].astype(np.float64)
        return abs(np.sum(left * right)) / np.sqrt(np.sum(left**2) * np.sum(right**2))

    assert coherence(_iterations(4)) > 0.99
    assert coherence(_iterations(4, warm=True)) < 0.25


@pytest.mark.parametrize("phase", [FROZEN, INTEGRATED, _iterations(3), _iterations(3, warm=True)], ids=str)
def test_silence_is_decoded_to_silence(phase):
    parameters = _parameters()
    predicted = _predicted(parameters)
    predicted.log_magnitude[:] = np.log(parameters.log_floor)
    for near in (None, np.zeros((2, SAMPLES), np.float32)):
        responses = _decoder(parameters, phase).decode(predicted, np.array([64.0]), [near])
        assert np.abs(responses).max() < 1e-9


def test_iterations_from_silence_are_finite_and_sound():
    codec = _parameters().codec
    magnitude = np.abs(codec.transform(_decaying(codec))).astype(np.float32)
    signal = griffin_lim(codec, magnitude, np.zeros((1, 2, codec.samples), np.float32), 3)
    assert np.isfinite(signal).all()
    assert _inconsistency(codec, magnitude, signal) < 0.6
