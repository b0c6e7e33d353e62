"""Responses of one channel."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.geometry import Pose, Quaternion
from server.field.field import AcousticField
from server.responses.direct_sound import DirectSound
from server.responses.effect_flags import EmitterEffects
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs
from server.responses.mono_response import mono_responses
from server.scene.bundle import Bundle, find_bundle

LISTENER, EMITTER = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)


@pytest.mark.parametrize("orientation", [Quaternion.from_yaw(0.5), Quaternion.from_angles(0.5, 0.4, -0.2)])
@pytest.mark.parametrize("which", ["field", "mirrored_field", "field_at_nodes", "whole_at_nodes"])
def test_of_a_field_that_knows_one_head_it_is_that_of_a_mono_stream(request, filters, which, orientation):
    field = request.getfixturevalue(which)
    (heard,) = mono_responses(field, [LISTENER], [EMITTER], [orientation])
    # A stream to one loudspeaker, with its direct sound as part of the response.
    still = EmitterState(Pose(EMITTER), effects=EmitterEffects(propagation_delay=False))
    streamed = composed_irs(field, DirectSound.of(field.bundle, filters), Pose(LISTENER, orientation), [still], 1)
    assert heard.shape == (1, field.ir_samples)
    assert_allclose(heard, streamed[0], atol=1e-6)


def test_of_a_scene_measured_with_one_microphone_it_is_the_measurement(measured_bundle):
    field = AcousticField.load(measured_bundle)
    poses = [(0.0, 0.4, 0.0)], [(1.5, 0.4, 0.0)], [0.0]
    assert_array_equal(mono_responses(field, *poses), field.impulse_responses(*poses))


def test_in_the_open_it_is_the_direct_sound():
    field = AcousticField.load(Bundle.load(find_bundle("open-field")))
    (heard,) = mono_responses(field, [(0.0, 0.0, 1.5)], [(4.0, 0.0, 1.5)], [1.0])
    assert heard.sum() == pytest.approx(0.25, rel=0.03)
    assert int(np.argmax(np.abs(heard[0]))) / field.sample_rate == pytest.approx(4 / 343, abs=1e-4)
