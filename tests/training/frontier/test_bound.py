from types import SimpleNamespace

import numpy as np
import pytest

from server.acoustics.codec import Codec
from training.frontier.bound import TruePhase
from training.models.targets import align

CODEC = Codec(8_000, 256, 64, 1_200, 1e-5)
LEAD, ONSET = 64, 100


@pytest.mark.parametrize("direct_sound", ["geometry", "field"])
def test_true_magnitudes_at_the_true_phase_are_the_reference(direct_sound):
    """Whatever part of it the field is asked for: what geometry adds is there once."""
    rng = np.random.default_rng(5)
    reflected, added = np.zeros((2, 1, 2, CODEC.samples))
    reflected[..., 150:900] = 0.1 * rng.standard_normal((1, 2, 750))
    added[..., ONSET + 10] = 1.0
    sound = reflected if direct_sound == "geometry" else reflected + added
    magnitudes = CODEC.log_magnitude(CODEC.transform(align(sound, ONSET - LEAD)))
    parameters = SimpleNamespace(codec=CODEC, lead_samples=LEAD)
    fields = {"naf": SimpleNamespace(codec=parameters)}
    field = SimpleNamespace(
        bundle=SimpleNamespace(manifest=SimpleNamespace(direct_sound=direct_sound, fields=fields)),
        level=SimpleNamespace(field="naf"),
        onset_s=lambda *_: np.array([ONSET / CODEC.sample_rate]),
        spectrograms=lambda *_: SimpleNamespace(log_magnitude=magnitudes),
    )
    entry = SimpleNamespace(
        yaws=np.zeros(1),
        listener=np.zeros(3),
        emitter=np.ones(3),
        openness=None,
        reference=reflected + added,
        reflected=reflected,
    )
    np.testing.assert_allclose(TruePhase(field)(entry)[..., :900], (reflected + added)[..., :900], atol=1e-3)
