"""A scene whose field predicts directions, in a stream: the head's orientation and the head decide what is heard."""

import numpy as np
import pytest

from server.acoustics.geometry import LEVEL, Pose, Quaternion
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose
from server.rendering.convolver import Sharing
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs, compute_irs
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.directional_flat import with_ears_exchanged, write_directional

HERE, THERE = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)
CLIP = 0.005 * np.random.default_rng(3).standard_normal(2_000).astype(np.float32)  # no limiter acts
UP = Quaternion(0.0, -0.5, 0.0, np.sqrt(0.75))
ON_ITS_SIDE = Quaternion(np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
LATE = np.s_[..., 1500:]


@pytest.fixture(params=["stft", "bands"])
def field(request, tmp_path) -> AcousticField:
    return AcousticField.load(write_directional(tmp_path / "flat", towards=(0.0, 0.0, 1.0), tail=request.param))


@pytest.fixture
def session(field, filters) -> Session:
    hello = Hello(protocol=PROTOCOL, scene="flat")
    quality = QualityStep("standard", None, Sharing.NOTHING, 1.0)
    return Session(hello, FieldsByLevel([field]), filters, lambda _: CLIP, quality=quality, window=1_000)


def late_energy(response):
    return np.sum(response[LATE].astype(np.float64) ** 2, axis=-1)


def response_of(field, filters, orientation):
    direct = DirectSound.of(field.bundle, filters)
    return composed_irs(field, direct, Pose(HERE, orientation), [EmitterState(Pose(THERE))])[0]


def test_a_head_on_its_side_hears_what_is_above_at_the_ear_that_points_there(field, filters):
    upright, side = (late_energy(response_of(field, filters, orientation)) for orientation in (LEVEL, ON_ITS_SIDE))
    assert 0.5 < upright[0] / upright[1] < 2.0
    assert side[0] > 2 * side[1]


def test_another_head_hears_another_reverberation(field, filters):
    exchanged = with_ears_exchanged(filters)
    own, other = (late_energy(response_of(field, head, ON_ITS_SIDE)) for head in (filters, exchanged))
    assert own[0] > 2 * own[1]
    assert other[1] > 2 * other[0]


def test_looking_up_asks_for_a_response_and_hears_it(session, field, filters):
    session.receive(ListenerPose(pose_id=1, position=HERE, orientation=LEVEL))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    levels = FieldsByLevel([field])
    level = compute_irs(levels, session.take_request(), session.renderer)
    session.accept(level)
    session.render_block()
    session.receive(ListenerPose(pose_id=2, position=HERE, orientation=UP))
    request = session.take_request()
    assert request is not None
    assert request.listener.orientation == UP
    session.accept(compute_irs(levels, request, session.renderer))
    expected = response_of(field, filters, UP)
    assert not np.allclose(late_energy(expected), late_energy(response_of(field, filters, LEVEL)), rtol=0.02)


def test_an_offline_render_is_the_stream(session, field, filters):
    session.receive(ListenerPose(pose_id=1, position=HERE, orientation=UP))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    session.accept(compute_irs(FieldsByLevel([field]), session.take_request(), session.renderer))
    streamed = np.concatenate([session.render_block().samples for _ in range(12)], axis=1)
    path = [PathPoint.at(0, Pose(HERE, UP))]
    rendered = render(
        field, DirectSound.of(field.bundle, filters), [RenderedEmitter(CLIP, Pose(THERE))], path, length=12 * 256
    )
    np.testing.assert_array_equal(rendered, streamed)
