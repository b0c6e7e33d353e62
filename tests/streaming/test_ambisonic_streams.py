"""A stream of ambisonics: sound in world axes, whatever the listener's head does."""

import numpy as np
import pytest

from server.acoustics.geometry import LEVEL, Pose, Quaternion
from server.acoustics.spherical_harmonics import real_harmonics
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, planned_effects, render
from server.planning.places import place_of_field
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    Hello,
    ListenerPose,
    SetEffects,
    parse_client_message,
)
from server.rendering.convolver import Sharing
from server.rendering.limiter import CEILING
from server.responses.ambisonic_response import AmbisonicResponse
from server.responses.direct_sound import DirectSound
from server.responses.ir_request import compute_irs
from server.scene.effects import EffectName
from server.streaming.calibration import calibrate
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.directional_flat import write_directional
from tests.signals import error_db

HERE, THERE = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)
CLIP = 0.005 * np.random.default_rng(3).standard_normal(2_000).astype(np.float32)  # no limiter acts
UP = Quaternion(0.0, -0.5, 0.0, np.sqrt(0.75))
QUALITY = QualityStep("standard", None, Sharing.NOTHING, 1.0)
ORDERS = pytest.mark.parametrize("order", [1, 2, 3])


@pytest.fixture(scope="module")
def field(tmp_path_factory) -> AcousticField:
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("flat"), order=3, towards=(0.0, 0.0, 1.0)))


def hello(order=None, **rest):
    return Hello(protocol=PROTOCOL, scene="flat", output="ambisonics", order=order, **rest)


def open_session(field, filters, asked, clip=CLIP, **rest):
    return Session(asked, FieldsByLevel([field]), filters, lambda _: clip, quality=QUALITY, window=1_000, **rest)


def answer(session, field):
    """Compute what the session asks for, if anything, and return whether it did."""
    request = session.take_request()
    if request is not None:
        session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))
    return request is not None


def stream(session, field, blocks=12, orientation=UP):
    session.receive(ListenerPose(pose_id=1, position=HERE, orientation=orientation))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    assert answer(session, field)
    return np.concatenate([session.render_block().samples for _ in range(blocks)], axis=1)


@ORDERS
def test_a_stream_is_its_clip_heard_through_the_ambisonic_response(field, filters, order):
    """Direct sound, first reflections and reverberation: all that the response over HTTP has, in world axes."""
    heard = stream(open_session(field, filters, hello(order)), field, 20)
    response = AmbisonicResponse(field).impulse_responses([HERE], [THERE], [LEVEL], order)[0]
    expected = np.array([np.convolve(CLIP, channel)[: heard.shape[1]] for channel in response.astype(float)])
    assert expected.shape[1] > CLIP.size + 2_500
    assert heard.shape[0] == (order + 1) ** 2
    assert error_db(heard, expected) < -75


def test_the_direct_sound_has_the_direction_of_the_emitter(field, filters):
    heard = stream(open_session(field, filters, hello()), field)
    offset = np.subtract(THERE, HERE)
    first = int(np.linalg.norm(offset) / 343 * 24_000) + 8
    part = heard[:, first : first + 24]  # before any reflection
    np.testing.assert_allclose(
        part @ part[0] / (part[0] @ part[0]), real_harmonics(offset / np.linalg.norm(offset), 1), atol=0.02
    )


def test_a_turn_of_the_head_asks_for_no_response_and_changes_no_sample(field, filters):
    still, turning = (open_session(field, filters, hello(1)) for _ in range(2))
    heard = [[], []]
    for session, kept in zip((still, turning), heard, strict=True):
        kept.append(stream(session, field, 2))
        for number in range(2, 10):
            if session is turning:
                orientation = Pose.from_yaw(HERE, 0.3 * number).orientation
                session.receive(ListenerPose(pose_id=number, position=HERE, orientation=orientation))
                assert session.take_request() is None
            block = session.render_block()
            kept.append(block.samples)
        assert not session.awaits_irs
    np.testing.assert_array_equal(*(np.concatenate(kept, axis=1) for kept in heard))
    # A turn is complete at once: the block says so.
    assert (block.pose_id, block.reverberation_pose_id) == (9, 9)


def test_a_step_asks_for_a_response(field, filters):
    session = open_session(field, filters, hello(1))
    stream(session, field, 2)
    session.receive(ListenerPose(pose_id=2, position=(2.2, 2.5, 1.5)))
    request = session.take_request()
    assert (request.channels, len(request.asked)) == (4, 1)


@ORDERS
@pytest.mark.parametrize("choice", ["all", "plan"])
def test_an_offline_render_is_the_stream(field, filters, order, choice):
    place = None if choice == "all" else place_of_field(field)
    session = open_session(field, filters, hello(order), place=place)
    session.receive(ListenerPose(pose_id=1, position=HERE, orientation=UP))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    blocks = []
    for _ in range(12):
        plan_request = session.take_plan_request()
        if plan_request is not None:
            session.adopt(plan_request.plan())
        answer(session, field)
        blocks.append(session.render_block().samples)
    streamed = np.concatenate(blocks, axis=1)
    planned = planned_effects(choice, field, Pose(HERE, UP), output="ambisonics")
    direct = DirectSound.of(field.bundle, filters, order=order)
    emitters, path = [RenderedEmitter(CLIP, Pose(THERE))], [PathPoint.at(0, Pose(HERE, UP))]
    rendered = render(field, direct, emitters, path, length=12 * 256, planned=planned)
    assert streamed.any()
    np.testing.assert_array_equal(rendered, streamed)


def test_plans_have_no_head_and_say_why(field, filters):
    session = open_session(field, filters, hello(1, effects={"hrtf": True}), place=place_of_field(field))
    session.receive(ListenerPose(pose_id=1, position=HERE))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE))
    request = session.take_plan_request()
    plan = request.plan()
    session.adopt(plan)
    assert plan.shared[EffectName.HRTF].overridden
    assert "the client turns ambisonic channels" in plan.shared[EffectName.HRTF].reason
    assert not plan.shared[EffectName.HEAD_ROTATION].called_for
    while answer(session, field):  # the direct sound may be baked in a second response
        pass
    assert session.render_block().samples.shape[0] == 4  # no wish gives it a head
    session.receive(ListenerPose(pose_id=2, position=HERE, yaw=1.0))
    assert session.take_request() is None


def test_checks_of_plans_hear_ambisonics_too(field, filters):
    session = open_session(field, filters, hello(2), place=place_of_field(field))
    stream_of = [AddEmitter(id="talker", clip="noise", position=THERE)]
    for message in stream_of:
        session.receive(message)
    session.adopt(session.take_plan_request().plan())
    answer(session, field)
    check = session.take_check()
    if check is not None:
        assert all(np.isfinite(list(check.run(field).by_parameter.values())))


def test_switching_effects_off_leaves_the_direct_sound_alone(field, filters):
    off = {"early_reflections": False, "late_reverberation": False, "air_absorption": False}
    session = open_session(field, filters, hello(1, effects=off), place=place_of_field(field))
    session.receive(ListenerPose(pose_id=1, position=HERE))
    session.receive(AddEmitter(id="talker", clip="noise", position=THERE, loop=False))
    session.adopt(session.take_plan_request().plan())
    assert session.take_request() is None
    heard = np.concatenate([session.render_block().samples for _ in range(12)], axis=1)
    offset = np.subtract(THERE, HERE)
    np.testing.assert_allclose(heard, real_harmonics(offset / np.linalg.norm(offset), 1)[:, None] * heard[0], atol=1e-6)
    assert heard.any()


def test_loud_blocks_are_turned_down_in_all_channels_alike(field, filters):
    session = open_session(field, filters, hello(1), clip=400 * CLIP)
    stream(session, field, 4)
    blocks = [session.render_block() for _ in range(8)]
    assert any(block.is_limited for block in blocks)
    assert max(np.abs(block.samples).max() for block in blocks) <= CEILING * (1 + 1e-6)


@pytest.mark.parametrize("encoding", ["f32", "s16"])
def test_blocks_carry_all_channels(field, filters, encoding):
    session = open_session(field, filters, hello(2), clip=20 * CLIP)
    stream(session, field, 3)
    block = session.render_block()
    read = AudioBlock.parse(block.serialize(encoding), encoding)
    assert read.samples.shape == (9, 256)
    np.testing.assert_allclose(read.samples, block.samples, atol=0 if encoding == "f32" else 1 / 32_000)
    session.receive(Acknowledge(sequence=block.sequence))
    assert session.window.unacknowledged == 0


@pytest.mark.parametrize(
    ("first", "then"), [("ambisonics", "mono"), ("headphones", "ambisonics"), ("mono", "ambisonics")]
)
@pytest.mark.parametrize("has_plan", [False, True])
def test_no_stream_becomes_or_ceases_to_be_ambisonic(field, filters, first, then, has_plan):
    place = place_of_field(field) if has_plan else None
    session = open_session(field, filters, Hello(protocol=PROTOCOL, scene="flat", output=first), place=place)
    (error,) = session.receive(SetEffects(output=then))
    assert (error.code, error.field) == ("fixed_output", "output")
    assert "open another stream" in error.message
    assert session.receive(SetEffects(output=first)) == []


def test_a_scene_of_ears_has_no_ambisonics(mirrored_field, filters):
    with pytest.raises(RequestError, match="ask for headphones") as refused:
        open_session(mirrored_field, filters, hello(1))
    assert (refused.value.code, refused.value.field) == ("no_directions", "output")


def test_levels_of_ears_are_not_offered_to_a_stream_of_ambisonics(field, field_at_nodes):
    both = FieldsByLevel([field_at_nodes, field])
    assert list(both.with_directions()) == ["standard"]
    assert list(both.with_directions("auto")) == ["standard"]
    with pytest.raises(RequestError, match="ask for auto, or for one of standard") as refused:
        both.with_directions("at-nodes")
    assert (refused.value.code, refused.value.field) == ("no_directions", "level")


@pytest.mark.parametrize(
    ("given", "field_at_fault"),
    [
        ('"output": "ambisonics", "order": 0', "order"),
        ('"output": "ambisonics", "order": 4', "order"),
        ('"output": "ambisonics", "order": 1.5', "order"),
        ('"output": "ambisonics", "order": "1"', "order"),
        ('"order": 1', "order"),
        ('"output": "mono", "order": 2', "order"),
        ('"output": "surround"', "output"),
    ],
)
def test_an_impossible_order_is_refused_by_its_name(given, field_at_fault):
    with pytest.raises(RequestError) as refused:
        parse_client_message(f'{{"type": "hello", "protocol": 3, "scene": "flat", {given}}}')
    assert (refused.value.code, refused.value.field) == ("malformed_message", field_at_fault)


@pytest.mark.parametrize(
    ("given", "order"), [("", 1), (', "order": 3', 3), (', "order": 2.0', 2), (', "order": null', 1)]
)
def test_the_usual_order_is_the_first(given, order):
    text = f'{{"type": "hello", "protocol": 3, "scene": "flat", "output": "ambisonics"{given}}}'
    assert parse_client_message(text).ambisonic_order == order


def test_calibration_measures_ambisonic_responses_apart(field, filters):
    levels = FieldsByLevel([field])
    ears, ambisonics = calibrate(levels, filters, poses=1), calibrate(levels, filters, poses=1, order=3)
    assert ears.keys() == ambisonics.keys()
    assert min(*ears.values(), *ambisonics.values()) > 0
