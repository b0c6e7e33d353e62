"""Quality levels that reuse responses, in sessions, in single responses, and offline."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, MoveEmitter, RemoveEmitter
from server.rendering.renderer import Renderer
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState
from server.responses.full_response import FullResponse
from server.responses.ir_request import compute_irs
from server.scene.manifest import Reuse
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

RATE = 24_000
EMITTER, START = (6.0, 3.0, 1.5), (2.0, 2.0, 1.5)
CLIP = np.random.default_rng(3).standard_normal(3_000).astype(np.float32)


def open_session(field, filters, clip=CLIP, levels=None):
    hello, levels = Hello(protocol=PROTOCOL, scene="flat"), levels or FieldsByLevel([field])
    session = Session(hello, levels, filters, lambda _: clip, quality=QualityStep.full(field.level, 1.0), window=10_000)
    session.receive(ListenerPose(pose_id=1, position=START))
    session.receive(AddEmitter(id="talker", clip="noise", position=EMITTER))
    return session


def answer(session, levels):
    request = session.take_request()
    if request is not None:
        session.accept(compute_irs(levels, request, session.renderer))
    return request


def graph_calls(field, monkeypatch):
    calls, predictions = [], field.graph.predictions
    monkeypatch.setattr(field.graph, "predictions", lambda *poses: calls.append(poses) or predictions(*poses))
    return calls


def walk(session, levels, field):
    """Over 4 m in steps of 5 cm: how often the session asked, and how many nodes were passed."""
    requests, nodes = 0, set()
    for number, x in enumerate(np.arange(2.0, 6.0, 0.05)):
        position = (float(x), 2.0, 1.5)
        session.receive(ListenerPose(pose_id=number + 2, position=position, yaw=0.1))
        requests += answer(session, levels) is not None
        block = session.render_block()
        assert block.reverberation_pose_id == number + 2
        nodes.add(field.snap(position, EMITTER, 0.1))
    return requests, nodes


def test_a_session_asks_for_nothing_while_its_response_stays_the_same(whole_at_nodes, filters, monkeypatch):
    field, levels = whole_at_nodes, FieldsByLevel([whole_at_nodes])
    calls = graph_calls(field, monkeypatch)
    session = open_session(field, filters)
    requests, nodes = walk(session, levels, field)
    assert requests == len(nodes) < 40
    assert len(calls) == len({snapped.node for snapped in nodes})
    other = open_session(field, filters)
    again, _ = walk(other, levels, field)
    assert (again, len(calls)) == (requests, len({snapped.node for snapped in nodes}))


def test_a_session_looks_up_no_node_as_long_as_its_listener_hardly_moves(whole_at_nodes, filters, monkeypatch):
    levels, session = FieldsByLevel([whole_at_nodes]), open_session(whole_at_nodes, filters)
    finds, find = [], whole_at_nodes.find
    monkeypatch.setattr(whole_at_nodes, "find", lambda *poses: finds.append(poses) or find(*poses))
    around = find(START, EMITTER, 0.0)[1]
    answer(session, levels)
    for number in range(20):
        shifted = (START[0] + 0.04 * around.radius_m * number, *START[1:])
        session.receive(ListenerPose(pose_id=number + 2, position=shifted))
        assert answer(session, levels) is None
    assert len(finds) <= 4


def settled(session, levels, pose_id):
    """The session has found that its listener, who has hardly moved, hears the same."""
    for step in (1, 2):
        session.receive(ListenerPose(pose_id=pose_id + step, position=(START[0] + 1e-4 * step, *START[1:])))
        assert answer(session, levels) is None


def test_an_emitter_that_moves_is_asked_for_anew_however_little_its_listener_does(whole_at_nodes, filters):
    levels, session = FieldsByLevel([whole_at_nodes]), open_session(whole_at_nodes, filters)
    answer(session, levels)
    settled(session, levels, 10)
    session.receive(MoveEmitter(pose_id=20, id="talker", position=(3.0, 4.0, 1.5)))
    assert answer(session, levels) is not None


def test_an_emitter_that_turns_its_beam_is_asked_for_anew_however_little_its_listener_moves(whole_at_nodes, filters):
    levels, session = FieldsByLevel([whole_at_nodes]), open_session(whole_at_nodes, filters)
    session.receive(RemoveEmitter(id="talker"))
    session.receive(AddEmitter(id="horn", clip="noise", position=EMITTER, directivity={"pattern": "cardioid"}))
    answer(session, levels)
    settled(session, levels, 10)
    session.receive(MoveEmitter(pose_id=20, id="horn", position=EMITTER, yaw=1.0))
    assert answer(session, levels) is not None


def test_another_level_is_asked_for_however_little_a_listener_moves(whole_at_nodes, mirrored_bundle, filters):
    coarse = whole_at_nodes.level.model_copy(
        update={"name": "coarse", "reuse": Reuse(spacing_m=20, turn_deg=360, first_reflections="node")}
    )
    levels = FieldsByLevel([whole_at_nodes, AcousticField(mirrored_bundle, coarse, whole_at_nodes.graph)])
    session = open_session(whole_at_nodes, filters, levels=levels)
    answer(session, levels)
    settled(session, levels, 10)
    for number, level in enumerate((coarse, whole_at_nodes.level, coarse)):
        session.set_quality(QualityStep.full(level, 1.0), "chosen")
        session.receive(ListenerPose(pose_id=20 + number, position=START))
        assert answer(session, levels).level == level.name


def test_who_returns_to_where_a_response_was_heard_asks_for_it_again(whole_at_nodes, filters):
    levels, session = FieldsByLevel([whole_at_nodes]), open_session(whole_at_nodes, filters)
    answer(session, levels)
    nearby, far = (START[0] + 1e-4, *START[1:]), (5.0, 1.0, 1.5)
    assert whole_at_nodes.find(START, EMITTER, 0.0)[1].holds(Pose(nearby))
    session.receive(ListenerPose(pose_id=2, position=nearby))
    assert answer(session, levels) is None
    for number, place in enumerate((far, START, far, START)):
        session.receive(ListenerPose(pose_id=number + 3, position=place))
        assert answer(session, levels) is not None


def test_first_reflections_of_the_pose_are_asked_for_at_every_pose_and_the_field_at_nodes(
    field_at_nodes, filters, monkeypatch
):
    levels, calls = FieldsByLevel([field_at_nodes]), graph_calls(field_at_nodes, monkeypatch)
    requests, nodes = walk(open_session(field_at_nodes, filters), levels, field_at_nodes)
    assert requests == 80
    assert len(calls) == len({snapped.node for snapped in nodes}) < 40


def test_an_emitter_that_beams_elsewhere_has_another_response(whole_at_nodes, filters):
    session, levels = open_session(whole_at_nodes, filters), FieldsByLevel([whole_at_nodes])
    session.receive(AddEmitter(id="horn", clip="noise", position=EMITTER, directivity={"pattern": "cardioid"}))
    answer(session, levels)
    session.receive(MoveEmitter(pose_id=2, id="horn", position=EMITTER, yaw=1.0))
    asked = answer(session, levels)
    assert [each.serial for each in asked.asked] == [1]
    session.receive(MoveEmitter(pose_id=3, id="talker", position=EMITTER, yaw=1.0))
    assert answer(session, levels) is None


def ir_of(session, samples):
    """What follows the direct sound of a click."""
    heard = [session.render_block().samples for _ in range(-(-samples // 256))]
    return np.concatenate(heard, axis=1)[:, :samples].astype(float)


@pytest.mark.parametrize("name", ["field_at_nodes", "whole_at_nodes"])
def test_a_stream_hears_the_whole_response_that_is_given_singly(name, filters, request):
    field = request.getfixturevalue(name)
    levels = FieldsByLevel([field])
    click = np.zeros(field.ir_samples, np.float32)
    click[0] = 1
    session = open_session(field, filters, click)
    session.receive(ListenerPose(pose_id=2, position=(3.3, 1.9, 1.4), yaw=0.7))
    answer(session, levels)
    whole = FullResponse(field, filters).impulse_responses([(3.3, 1.9, 1.4)], [EMITTER], [0.7])[0]
    assert_allclose(ir_of(session, field.ir_samples), whole, atol=2e-5 * np.abs(whole).max())


def test_first_reflections_end_before_the_sample_from_which_the_rest_is_used_again(mirrored_bundle, filters):
    early = EarlyReflections.of(mirrored_bundle, filters)
    rng, latest = np.random.default_rng(1), 0
    corners = np.array([(x, y, z) for x in (0.01, 7.99) for y in (0.01, 4.99) for z in (0.01, 2.79)])
    places = np.concatenate([corners, rng.uniform((0.3, 0.3, 0.5), (7.7, 4.7, 2.3), (20, 3))])
    for listener in places:
        heads = [EmitterState(Pose(tuple(emitter))) for emitter in places]
        responses = np.zeros((len(places), 2, early.end_samples + 2_000), np.float32)
        early.add(responses, Pose.from_yaw(tuple(listener), rng.uniform(-3, 3)), heads)
        latest = max(latest, int(np.flatnonzero(np.abs(responses).max(axis=(0, 1)))[-1]))
    assert 0.5 * early.end_samples < latest < early.end_samples


@pytest.mark.parametrize("block_size", [64, 256])
def test_an_ir_prepared_from_one_like_it_is_what_it_would_be_without(block_size):
    rng = np.random.default_rng(0)
    first = rng.standard_normal((2, 9_000)).astype(np.float32)
    second = first.copy()
    second[:, 40:700] += 1.0

    def renderer():
        return Renderer(
            block_size=block_size,
            ir_samples=9_000,
            sample_rate=RATE,
            filters=None,
            speed_of_sound=343.0,
            air_db_per_m=np.zeros(7),
            shared_tail=True,
        )

    preparer = renderer()
    like = preparer.prepare(first)
    short, whole = preparer.prepare(second, like=like, same_from=700), preparer.prepare(second)
    assert short.energies[-1] == whole.energies[-1]
    assert short.nbytes == whole.nbytes
    for one, other in zip(short.filters.spectra, whole.filters.spectra, strict=True):
        assert_array_equal(one, other)
    assert [a is b for a, b in zip(short.filters.spectra, like.filters.spectra, strict=True)] == (
        [False, False, True] if block_size == 64 else [False, True, True]
    )
    other = Renderer(
        block_size=128, ir_samples=9_000, sample_rate=RATE, filters=None, speed_of_sound=343.0, air_db_per_m=np.zeros(7)
    )
    assert other.preparation != preparer.preparation == renderer().preparation
    with pytest.raises(ValueError, match="another convolver"):
        other.prepare(second, like=like, same_from=700)


@pytest.mark.parametrize("name", ["field_at_nodes", "whole_at_nodes"])
def test_crossing_from_cell_to_cell_while_a_tone_sounds_does_not_splatter(name, filters, request):
    """The listener walks round the emitter, so that nothing of the direct sound moves but its direction."""
    field = request.getfixturevalue(name)
    levels = FieldsByLevel([field])
    tone = np.sin(2 * np.pi * 997 * np.arange(10 * RATE) / RATE).astype(np.float32)
    session = open_session(field, filters, tone)
    answer(session, levels)
    for _ in range(80):
        session.render_block()
    heard, exchanges = [], session.ir_exchanges
    for number in range(240):
        angle = 0.01 * number
        place = (EMITTER[0] - 1.5 * math.cos(angle), EMITTER[1] - 1.5 * math.sin(angle), 1.5)
        session.receive(ListenerPose(pose_id=number + 2, position=place, yaw=angle))
        answer(session, levels)
        heard.append(session.render_block().samples)
    wet = np.concatenate(heard, axis=1).astype(float)[:, 20 * 256 :]
    assert session.ir_exchanges - exchanges >= 4
    power = np.abs(np.fft.rfft(wet * np.kaiser(wet.shape[1], 20))) ** 2
    high = np.fft.rfftfreq(wet.shape[1], 1 / RATE) > 4_000
    assert 10 * np.log10(power[:, high].sum() / power.sum()) < -90
