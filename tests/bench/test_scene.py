import numpy as np
import pytest

from server.bench.scene import IR_S, SAMPLE_RATE, SCENE, BankField, bundle_of, levels_of
from server.core.errors import RequestError


def test_the_bank_answers_like_a_field_and_differs_from_place_to_place():
    field = BankField()
    assert (field.sample_rate, field.ir_samples) == (SAMPLE_RATE, round(IR_S * SAMPLE_RATE))
    listeners = np.linspace((1.0, 1.0, 1.5), (3.0, 2.0, 1.5), 200)
    emitters = np.tile((6.0, 1.5, 1.5), (200, 1))
    irs = field.impulse_responses(listeners, emitters, np.zeros(200))
    assert irs.shape == (200, field.channels, field.ir_samples)
    assert irs.dtype == np.float32
    first = irs[:, 0, 0]
    assert np.mean(first[1:] != first[:-1]) > 0.5  # a walker's next pose mostly has another
    np.testing.assert_array_equal(irs[:1], field.impulse_responses(listeners[:1], emitters[:1], [0.0]))
    for position in (*listeners[::50], emitters[0], field.bundle.manifest.start.listener):
        field.bundle.require_inside(tuple(position), "position")


def test_a_scene_of_streams_is_that_of_the_bank_or_any_bundle(bundle):
    assert levels_of(SCENE).bundle.id == bundle_of(SCENE).id == SCENE
    assert bundle_of(str(bundle.folder)).digest == levels_of(str(bundle.folder)).bundle.digest == bundle.digest
    assert bundle_of("apartment").id == "apartment"
    with pytest.raises(RequestError, match="'atlantis' is neither"):
        bundle_of("atlantis")
