"""What a network may say, and what decodes it: compiled code, NumPy and double precision."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from server.acoustics.phase import FrozenNoise
from server.field.decoder import Decoder
from server.field.gate import Gate
from server.field.graph import Spectrograms
from server.health.double_precision import DoubleDecoder, DoubleGate
from server.scene.manifest import CodecParameters, Phase, QualityLevel
from tests.oracles.decoder import NumpyDecoder
from training.models.frozen_noise import even_noise

SAMPLES = 6_000
FROZEN, INTEGRATED = Phase(), Phase(kind="integrated")
COLD, WARM = Phase(kind="griffin_lim", iterations=5), Phase(kind="griffin_lim", iterations=5, warm=True)
PHASES = [
    pytest.param(FROZEN, id="frozen"),
    pytest.param(INTEGRATED, id="integrated"),
    pytest.param(COLD, id="from zero phase"),
    pytest.param(WARM, id="warm"),
]
COMPILED = pytest.mark.parametrize("is_compiled", [pytest.param(True, id="compiled"), pytest.param(False, id="numpy")])


def parameters(samples=SAMPLES, *, n_fft=256, known=6, rate=24_000, lead=64):
    return CodecParameters(
        sample_rate=rate,
        n_fft=n_fft,
        hop=n_fft // 4,
        samples=samples,
        lead_samples=lead,
        known_frames=known,
        log_floor=1e-5,
    )


@cache
def noise_of(parameters):
    return even_noise(parameters.codec, np.random.default_rng(9), iterations=10)


def decoder_of(parameters, phase=FROZEN, *, is_compiled=True, **options):
    noise = FrozenNoise.from_signal(parameters.codec, noise_of(parameters))
    kind = Decoder if is_compiled else NumpyDecoder
    return kind(parameters, noise, ir_samples=parameters.samples, phase=phase, **options)


def gate_of(parameters, *, is_compiled=True, **options):
    gate = Gate(parameters, **options)
    return gate if is_compiled else DoubleGate(gate)


def exact_of(parameters, phase=FROZEN, frames=None):
    """The same in double precision."""
    field = SimpleNamespace(
        graph=SimpleNamespace(parameters=parameters),
        ir_samples=parameters.samples,
        level=QualityLevel(name="level", field="field", phase=phase, frames=frames),
        bundle=SimpleNamespace(frozen_noise=noise_of(parameters)),
    )
    return DoubleDecoder(field)


def predicted(parameters, count=1, *, seed=0, decay=7.0):
    """Decaying over the response by so many nepers, with everything that a network may say at random."""
    codec, rng = parameters.codec, np.random.default_rng(seed)
    shape, known = (count, 2, codec.bins, codec.frames), (count, 2, codec.bins, parameters.known_frames)
    return Spectrograms(
        (np.linspace(0, -decay, codec.frames) + 0.5 * rng.standard_normal(shape)).astype(np.float32),
        rng.uniform(-np.pi, np.pi, known).astype(np.float32),
        rng.uniform(0, 1, known).astype(np.float32),
        rng.uniform(-0.6, 0.6, shape).astype(np.float32),
    )


def flat(parameters, level):
    some = predicted(parameters)
    return replace(some, log_magnitude=np.full_like(some.log_magnitude, level))


def energy(signal):
    return float(np.sum(np.asarray(signal, float) ** 2))


def difference_db(found, expected):
    return 10 * np.log10(max(energy(found - np.asarray(expected, float)), 1e-300) / energy(expected))


def predicted_energy(parameters, some):
    codec = parameters.codec
    weight = np.r_[1, np.full(codec.bins - 2, 2), 1] / codec.n_fft * codec.hop / codec.window_energy
    return float(np.einsum("cft,f->", codec.magnitude(some.log_magnitude[0].astype(float)) ** 2, weight))


AT = np.array([350.3])
