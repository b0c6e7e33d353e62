"""Which impulse responses a session asks for, and which it hears: one request at a time, for the newest poses."""

import numpy as np
import pytest

from server.acoustics.geometry import Pose
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, MoveEmitter, RemoveEmitter
from server.protocol.server_messages import EmitterAdded, EmitterRemoved, Error
from server.rendering.convolver import Sharing
from server.responses.ir_request import composed_irs, compute_irs
from server.streaming.quality_steps import QualityStep
from server.streaming.response_scheduler import Scope
from server.streaming.session import Session

CLIP = 0.005 * np.random.default_rng(3).standard_normal(3_000).astype(np.float32)  # no limiter acts
HERE, THERE = (2.0, 2.0, 1.5), (6.0, 3.0, 1.5)


@pytest.fixture
def session(field, filters):
    hello, quality = Hello(protocol=PROTOCOL, scene="flat"), QualityStep("standard", None, Sharing.NOTHING, 1.0)
    return Session(hello, FieldsByLevel([field]), filters, lambda _: CLIP, quality=quality, window=1_000)


def add(session, identifier="talker", position=THERE):
    session.receive(AddEmitter(id=identifier, clip="noise", position=position))


def answer(session, field):
    """Compute what the session wants, at once, and hand it in."""
    request = session.take_request()
    return [] if request is None else session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))


def poses(block):
    return block.pose_id, block.reverberation_pose_id


def test_sound_never_waits_for_the_field(session):
    add(session)
    assert session.take_request() is not None
    blocks = [session.render_block() for _ in range(20)]
    assert [block.sample_clock for block in blocks] == [256 * k for k in range(20)]
    assert not np.any([block.samples for block in blocks])


def test_poses_that_arrive_during_a_computation_become_one_request(session, field):
    add(session)
    first = session.take_request()
    for pose_id in range(1, 100):
        session.receive(ListenerPose(pose_id=pose_id, position=(2.0 + pose_id / 100, 2.0, 1.5)))
    assert session.take_request() is None
    session.accept(compute_irs(FieldsByLevel([field]), first, session.renderer))
    second = session.take_request()
    assert (second.pose_id, second.listener.position) == (99, (2.99, 2.0, 1.5))


def test_a_block_carries_the_pose_of_its_direct_paths_and_the_one_whose_irs_it_fades_to(session, field):
    add(session)
    answer(session, field)
    assert poses(session.render_block()) == (0, 0)
    session.receive(ListenerPose(pose_id=7, position=HERE))
    request = session.take_request()
    assert poses(session.render_block()) == (7, 0)
    session.receive(ListenerPose(pose_id=8, position=HERE))
    session.receive(ListenerPose(pose_id=9, position=HERE))
    session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))
    exchange, after = session.render_block(), session.render_block()
    assert (*poses(exchange), exchange.is_exchange) == (9, 7, True)
    assert (*poses(after), after.is_exchange) == (9, 7, False)
    assert session.ir_exchanges == 1


def test_only_what_moved_is_computed_again(session, field):
    add(session, "a")
    add(session, "b")
    answer(session, field)
    session.receive(MoveEmitter(id="b", position=HERE, pose_id=1))
    assert [each.state.position for each in session.take_request().asked] == [HERE]


def test_a_pose_of_one_emitter_counts_for_the_whole(session, field):
    add(session, "a")
    add(session, "b")
    answer(session, field)
    session.render_block()
    session.receive(MoveEmitter(id="b", position=HERE, pose_id=5))
    answer(session, field)
    assert poses(session.render_block()) == (5, 5)


def test_without_emitters_every_pose_is_in_effect_at_once(session):
    session.receive(ListenerPose(pose_id=3, position=HERE))
    assert session.take_request() is None
    assert poses(session.render_block()) == (3, 3)


def test_an_emitter_that_turns_on_the_spot_needs_no_new_ir(session, field):
    add(session)
    answer(session, field)
    session.receive(MoveEmitter(id="talker", position=THERE, yaw=1.0, pose_id=1))
    assert session.take_request() is None
    assert poses(session.render_block()) == (1, 1)


def test_an_answer_for_an_emitter_that_left_is_ignored_even_if_its_id_is_taken_again(session, field):
    add(session)
    request = session.take_request()
    assert session.receive(RemoveEmitter(id="talker")) == [EmitterRemoved(id="talker")]
    add(session, position=HERE)
    assert session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer)) == []
    assert answer(session, field) == [EmitterAdded(id="talker", sample_clock=0)]


def test_after_a_failure_sound_goes_on_and_the_next_pose_asks_for_everything_outstanding(session, field):
    add(session, "a")
    add(session, "b")
    answer(session, field)
    session.render_block()
    session.receive(ListenerPose(pose_id=1, position=HERE))
    (error,) = session.give_up(session.take_request())
    assert isinstance(error, Error)
    assert error.code == "field_failure"
    assert session.take_request() is None
    block = session.render_block()
    assert poses(block) == (1, 0)
    assert np.any(block.samples)
    session.receive(MoveEmitter(id="a", position=HERE, pose_id=2))
    assert len(session.take_request().asked) == 2


def test_after_a_failure_whoever_comes_is_asked_for_with_everything_outstanding(session):
    add(session, "a")
    session.give_up(session.take_request())
    assert session.take_request() is None
    add(session, "b")
    assert len(session.take_request().asked) == 2


def test_what_changes_while_a_request_fails_is_asked_for_at_once(session):
    add(session, "a")
    failing = session.take_request()
    add(session, "b")
    session.receive(ListenerPose(pose_id=1, position=HERE))
    session.give_up(failing)
    again = session.take_request()
    assert (again.pose_id, len(again.asked)) == (1, 2)
    session.give_up(again)
    assert session.take_request() is None, "nothing has changed since: no failure after the other"


def test_a_newcomer_is_asked_for_alone_where_it_is_not_time_for_others(session, field):
    """Who waits to be heard waits for nobody else's response; nor does a client hear of a pose that is not heard."""
    add(session, "a")
    answer(session, field)
    session.render_block()
    session.receive(ListenerPose(pose_id=1, position=HERE))
    add(session, "b")
    request = session.take_request(Scope.FIRST)
    assert [each.serial for each in request.asked] == [1]
    assert request.is_first
    session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))
    assert poses(session.render_block()) == (1, 0)
    assert session.take_request(Scope.FIRST) is None
    assert session.wants_irs
    assert [each.serial for each in session.take_request().asked] == [0]
    assert not session.wants_irs


def test_where_a_newcomers_request_fails_others_still_get_theirs(session, field):
    add(session, "a")
    answer(session, field)
    session.render_block()
    session.receive(ListenerPose(pose_id=1, position=HERE))
    add(session, "b")
    session.give_up(session.take_request(Scope.FIRST))
    assert session.take_request(Scope.FIRST) is None, "no failure after the other"
    assert session.wants_irs
    assert len(session.take_request().asked) == 2


def test_a_field_that_is_not_finite_is_not_an_answer(session, field):
    shape = 1, 2, field.ir_samples
    field.impulse_responses = lambda *_, **__: np.full(shape, np.nan, np.float32)
    add(session)
    with pytest.raises(ValueError):
        compute_irs(FieldsByLevel([field]), session.take_request(), session.renderer)


def walk(session, field, positions, first_pose_id):
    """Whether each response that was asked for at these places was whole: one list per request."""
    wholes = []
    for number, position in enumerate(positions):
        session.receive(ListenerPose(pose_id=first_pose_id + number, position=position))
        request = session.take_request()
        wholes.append([asked.like is None for asked in request.asked])
        session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))
        session.render_block()
    return wholes


EASED = QualityStep("standard", None, Sharing.NOTHING, 1.0, late_reach_m=0.5)


def test_below_the_top_late_parts_are_kept_while_listener_and_emitters_stay_near(session, field):
    for name in "abc":
        add(session, name)
    session.receive(ListenerPose(pose_id=1, position=HERE))
    answer(session, field)
    near = [(2.0 + 0.1 * step, 2.0, 1.5) for step in range(1, 5)]
    assert walk(session, field, near, 2) == [[True] * 3] * 4
    session.set_quality(EASED, "load")
    assert walk(session, field, [(2.8, 2.0, 1.5)], 10) == [[False] * 3]
    # Too far away for all three: two are computed anew at a time.
    first, second, third = walk(session, field, [(3.0, 2.0, 1.5), (3.1, 2.0, 1.5), (3.2, 2.0, 1.5)], 20)
    assert (sum(first), sum(second), sum(third)) == (2, 1, 0)
    assert not any(both[0] and both[1] for both in zip(first, second, strict=True))


def test_a_turn_of_the_head_makes_late_parts_old_too(session, field):
    add(session)
    session.receive(ListenerPose(pose_id=1, position=HERE))
    answer(session, field)
    session.set_quality(EASED, "load")
    for pose_id, (yaw, is_whole) in enumerate([(0.5, False), (1.2, True)], 2):
        session.receive(ListenerPose(pose_id=pose_id, position=HERE, yaw=yaw))
        request = session.take_request()
        assert [asked.like is None for asked in request.asked] == [is_whole]
        session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))


def test_back_at_the_top_everything_is_computed_for_the_pose_that_is_heard(session, field):
    add(session, "a")
    add(session, "b")
    answer(session, field)
    top = session.quality
    session.set_quality(EASED, "load")
    session.receive(MoveEmitter(id="b", position=(6.1, 3.0, 1.5), pose_id=1))
    answer(session, field)
    assert session.take_request() is None
    session.set_quality(top, "recovered")
    assert [(each.state.position, each.like) for each in session.take_request().asked] == [((6.1, 3.0, 1.5), None)]


def test_a_response_with_a_kept_late_part_is_that_of_both_poses(session, field):
    add(session)
    session.receive(ListenerPose(pose_id=1, position=HERE))
    answer(session, field)
    session.set_quality(EASED, "load")
    session.receive(ListenerPose(pose_id=2, position=(2.2, 2.0, 1.5)))
    request = session.take_request()
    (kept,) = compute_irs(FieldsByLevel([field]), request, session.renderer).irs
    (asked,) = request.asked
    early = session.renderer.early_samples(2)
    (there,) = composed_irs(field, request.direct_sound, request.listener, [asked.state])
    (before,) = composed_irs(field, request.direct_sound, Pose(HERE), [asked.state])
    both = session.renderer.prepare(np.concatenate([there[:, :early], before[:, early:]], axis=1))
    for own, other in zip(kept.filters.spectra, both.filters.spectra, strict=True):
        np.testing.assert_array_equal(own, other)
    assert kept.energies == pytest.approx(both.energies)
