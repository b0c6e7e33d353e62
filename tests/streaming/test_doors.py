"""Doors that move while somebody listens."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.planning.places import place_of
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, SetDoor
from server.protocol.server_messages import Error
from server.rendering.convolver import Sharing
from server.rendering.hrtf import kemar
from server.responses.ir_request import compute_irs
from server.streaming.audience import Audience, NewListener
from server.streaming.doors import FollowedDoors
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from server.streaming.stream_times import StreamTimes
from tests.signals import error_db
from tests.two_rooms import BEFORE, BEHIND, EAST, SLIDE, WEST, write_reverberant_rooms, write_two_rooms

RATE, BLOCK = 24_000, 256
QUALITY = QualityStep("geometry", None, Sharing.NOTHING, 1.0)
TONE = (0.05 * np.sin(2 * np.pi * 500 / RATE * np.arange(RATE))).astype(np.float32)
NOISE = 0.02 * np.random.default_rng(0).standard_normal(RATE).astype(np.float32)
FAR = (7.5, 0.5, 1.5)
"""In the east room, out of the line through the door."""


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    return FieldsByLevel.load(write_two_rooms(tmp_path_factory.mktemp("two-rooms") / "scene"))


@pytest.fixture(scope="module")
def reverberant(tmp_path_factory):
    """Their field reverberates as much as the door is open."""
    return FieldsByLevel.load(write_reverberant_rooms(tmp_path_factory.mktemp("two-rooms") / "scene"))


def opened(levels, *, planned=False, clip=NOISE, quality=QUALITY, **hello):
    place = place_of(levels.bundle, ()) if planned else None
    hello = Hello(protocol=PROTOCOL, scene="two-rooms", **hello)
    quality = replace(quality, level=levels.default.level.name)
    head, own = kemar(hello.sample_rate or RATE), kemar(RATE)
    return Session(hello, levels, head, lambda _: clip, quality=quality, window=100_000, place=place, field_filters=own)


def answer_doors(session, *, whole=True) -> int:
    """Prepare what the session asks for, at once. Returns the number of answers."""
    count = 0
    while requests := session.take_door_requests():
        for request in requests:
            if request.before is None and not whole:
                continue
            session.adopt_doors(request.prepare())
            count += 1
        if not whole:
            break
    return count


def answer(session) -> None:
    while (request := session.take_request()) is not None:
        session.accept(compute_irs(session.levels, request, session.renderer))
    if (plan := session.take_plan_request()) is not None:
        session.adopt(plan.plan())


def listen(session, listener=BEFORE, emitter=BEHIND, **added):
    session.receive(ListenerPose(pose_id=1, position=listener, yaw=0.0))
    assert session.receive(AddEmitter(id="a", clip="clip", position=emitter, loop=True, **added)) == []
    answer(session)
    return session


def hear(session, blocks):
    return np.concatenate([session.render_block().samples for _ in range(blocks)], axis=1).astype(float)


def level_db(samples):
    return 10 * np.log10(np.mean(samples**2) + 1e-30)


def set_door(session, openness, door="between"):
    return session.receive(SetDoor(door=door, openness=openness))


def test_who_listens_through_a_door_hears_it_shut_at_once(levels):
    session = listen(opened(levels))
    hear(session, 40)
    before = level_db(hear(session, 40))
    assert set_door(session, 0.0) == []
    assert answer_doors(session, whole=False) == 1
    hear(session, 1)  # the block in which it is crossfaded
    answer(session)
    hear(session, 40)
    assert level_db(hear(session, 40)) < before - 20
    answer_doors(session)
    set_door(session, 1.0)
    answer_doors(session)
    answer(session)
    hear(session, 40)
    assert level_db(hear(session, 40)) == pytest.approx(before, abs=0.5)


@pytest.mark.parametrize("emitter", [BEHIND, EAST, FAR], ids=["straight", "by mirrors", "round the edge"])
@pytest.mark.parametrize("openness", [0.0, 0.3])
def test_once_it_has_moved_a_stream_is_that_of_a_scene_whose_door_is_so(levels, emitter, openness):
    moved = listen(opened(levels), emitter=emitter)
    hear(moved, 20)
    set_door(moved, openness)
    answer_doors(moved)
    answer(moved)
    still = listen(opened(levels.with_doors((openness,))), emitter=emitter)
    hear(still, 20)
    hear(moved, 60), hear(still, 60)
    assert error_db(hear(moved, 20), hear(still, 20)) < -60  # delays come to their ends ever more slowly


def test_a_hello_may_have_doors_open_or_shut_and_nothing_else_is_ever_heard(levels):
    session = opened(levels, doors={"between": 0.0})
    assert session.doors == {"between": 0.0}
    session.receive(ListenerPose(pose_id=1, position=BEFORE, yaw=0.0))
    session.receive(AddEmitter(id="a", clip="clip", position=BEHIND, loop=True))
    assert session.take_request() is None
    answer_doors(session)
    answer(session)
    heard = hear(session, 60)
    expected = hear(listen(opened(levels.with_doors((0.0,)))), 60)
    assert_allclose(heard, expected, atol=1e-7)


@pytest.mark.parametrize("whole", [False, True], ids=["in a moment", "with all ways"])
@pytest.mark.parametrize("rate", [RATE, 48_000])
def test_reverberation_is_that_of_the_door_as_it_is(reverberant, whole, rate):
    """Also before the ways round edges are known: the listener sees the emitter past the door."""
    levels, place = reverberant.at_rate(rate), (3.5, 1.0, 1.5)
    moved = listen(opened(reverberant, sample_rate=rate), WEST, place)
    hear(moved, 20)
    set_door(moved, 0.5)
    answer_doors(moved, whole=whole)
    answer(moved)
    assert moved.levels.bundle.openness == (0.5,)
    still, shut = (listen(opened(levels.with_doors((share,)), sample_rate=rate), WEST, place) for share in (0.5, 0.0))
    hear(still, 20), hear(shut, 20)
    heard, expected, other = (hear(each, 80)[:, 40 * BLOCK :] for each in (moved, still, shut))
    assert error_db(heard, expected) < -40
    assert error_db(other, expected) > -30


def test_no_late_part_of_another_state_is_kept(reverberant):
    """Nor one that was asked for before the door moved, and came after."""
    session = listen(opened(reverberant, quality=replace(QUALITY, late_reach_m=2.0)), WEST, EAST)
    session.receive(ListenerPose(pose_id=2, position=(1.6, 1.0, 1.5), yaw=0.0))
    late = session.take_request()
    assert late.openness == (1.0,)
    assert late.asked[0].like is not None
    set_door(session, 0.0)
    answer_doors(session)
    session.accept(compute_irs(reverberant, late, session.renderer))
    request = session.take_request()
    assert request.openness == (0.0,)
    assert request.asked[0].like is None


def test_a_door_that_moves_asks_no_more_often_than_a_pose(levels):
    """So that it cannot upset what a busy server has left for each stream."""
    session = listen(opened(levels))
    session.set_ir_interval(1.0)
    session.receive(ListenerPose(pose_id=2, position=(2.6, 2.45, 1.5), yaw=0.0))
    answer(session)
    asked = 0
    for block in range(40):  # 0.43 s
        set_door(session, block / 40)
        answer_doors(session)
        asked += session.take_request() is not None
        session.render_block()
    assert asked == 0


def test_on_a_busy_server_doors_are_followed_ten_times_a_second(levels):
    """However fast they are moved, and to the end."""
    session = listen(opened(levels))
    session.set_ir_interval(1.0)
    asked = []
    for block in range(90):  # 0.96 s
        set_door(session, min(1.0, block / 80))
        for request in session.take_door_requests():
            asked.append(request.before)
            session.adopt_doors(request.prepare())
        session.render_block()
    assert 9 <= sum(before is not None for before in asked) <= 11
    hear(session, 12)
    answer_doors(session)
    assert session.levels.bundle.openness == (1.0,)


@pytest.mark.parametrize("planned", [False, True])
def test_a_snapshot_keeps_the_doors(levels, planned):
    session = listen(opened(levels, planned=planned))
    set_door(session, 0.25)
    answer_doors(session)
    kept = session.snapshot(session="s", handled=3)
    assert kept.hello.doors == {"between": 0.25}
    again = opened(levels, planned=planned, doors=kept.hello.doors)
    again.restore(kept)
    assert again.doors == {"between": 0.25}


@pytest.mark.parametrize("door", ["attic", "Between"])
def test_a_door_that_there_is_not_is_refused_and_the_stream_goes_on(levels, field, filters, door):
    session = listen(opened(levels))
    (error,) = set_door(session, 0.0, door)
    assert isinstance(error, Error)
    assert (error.code, error.field) == ("unknown_door", "door")
    assert "between" in error.message
    assert np.any(hear(session, 10))
    with pytest.raises(RequestError, match="no door 'attic'"):
        opened(levels, doors={"attic": 0.0})
    plain = Session(
        Hello(protocol=PROTOCOL, scene="flat"),
        FieldsByLevel([field]),
        filters,
        lambda _: NOISE,
        quality=replace(QUALITY, level="standard"),
    )
    assert [each.code for each in set_door(plain, 0.0, door)] == ["unknown_door"]
    assert plain.doors is None
    assert plain.take_door_requests() == []


@pytest.mark.parametrize("hurried", [True, False])
@pytest.mark.parametrize("place", ["levels", "reverberant"])
def test_a_door_that_is_slammed_makes_no_click(request, place, hurried):
    """What is one tone stays one, to -90 dB above 4 kHz."""
    session = listen(opened(request.getfixturevalue(place), clip=TONE))
    hear(session, 60)
    parts = [hear(session, 10)]
    for openness in (0.0, 1.0, 0.4, 0.0, 1.0):
        set_door(session, openness)
        answer_doors(session, whole=not hurried)
        answer(session)
        parts.append(hear(session, 12))
    heard = np.concatenate(parts, axis=1)
    power = np.abs(np.fft.rfft(heard * np.kaiser(heard.shape[1], 20))) ** 2
    high = np.fft.rfftfreq(heard.shape[1], 1 / RATE) > 4_000
    assert 10 * np.log10(power[:, high].sum() / power.sum()) < -90
    assert level_db(parts[1][:, 6 * BLOCK :]) < level_db(parts[0]) - 12


def test_doors_that_move_every_block_are_followed(levels):
    """As fast as a client can send, also while the whole ways are under way."""
    session, waiting = listen(opened(levels)), []
    rng = np.random.default_rng(4)
    for block in range(120):
        set_door(session, float(rng.choice([0.0, -0.0, 1.0, 1 + 1e-7, rng.uniform()])))
        for request in session.take_door_requests():
            if request.before is None:
                waiting.append(request)
            else:
                session.adopt_doors(request.prepare())
        if block % 7 == 0 and waiting:
            session.adopt_doors(waiting.pop().prepare())
        answer(session)
        samples = session.render_block().samples
        assert np.isfinite(samples).all()
        assert np.abs(samples).max() < 1
    assert len(waiting) <= 1
    for request in waiting:
        session.adopt_doors(request.prepare())
    set_door(session, 0.0)
    answer_doors(session)
    answer(session)
    still = listen(opened(levels.with_doors((0.0,))))
    hear(still, 120)
    hear(session, 60), hear(still, 60)
    assert error_db(hear(session, 10), hear(still, 10)) < -60


def test_two_streams_have_each_their_own_doors(levels):
    one, other = listen(opened(levels)), listen(opened(levels))
    hear(one, 40), hear(other, 40)
    before = level_db(hear(other, 40))
    set_door(one, 0.0)
    answer_doors(one)
    answer(one)
    hear(one, 40)
    assert level_db(hear(one, 40)) < before - 20
    assert answer_doors(other) == 0
    assert level_db(hear(other, 40)) == pytest.approx(before, abs=0.5)


def test_listeners_of_one_stream_have_the_same_doors(levels):
    audience = Audience(listen(opened(levels)), StreamTimes())
    assert audience.receive(SetDoor(door="between", openness=0.5)) == []
    late = opened(levels)
    audience.join(NewListener(_added("b"), late, "kemar"), QUALITY)
    assert late.doors == {"between": 0.5}
    assert audience.receive(SetDoor(door="between", openness=0.0)) == []
    assert [member.session.doors for member in audience.members] == [{"between": 0.0}] * 2
    (error,) = audience.receive(SetDoor(door="attic", openness=0.0))
    assert error.code == "unknown_door"


def _added(identifier):
    from server.protocol.client_messages import AddListener

    return AddListener(id=identifier, position=WEST)


def test_a_plan_is_made_for_the_doors_as_they_are(levels):
    """A hidden emitter is screened; through the open door nothing screens it."""
    session = listen(opened(levels, planned=True))
    answer(session)
    for openness in (0.0, 1.0):
        set_door(session, openness)
        answer_doors(session)
        request = session.take_plan_request()
        assert request is not None
        assert request.situation.place.surroundings is levels.bundle.moving.at((openness,))
        session.adopt(request.plan())


class TestFollowing:
    """What is asked for, and in which order."""

    @pytest.fixture
    def doors(self, levels):
        session = opened(levels)
        return FollowedDoors(levels.bundle.moving, levels, session._direct_sound, {})

    def test_nothing_is_asked_while_nothing_moves(self, doors):
        assert doors.is_heard
        assert doors.take_requests() == []

    def test_a_move_asks_for_both_and_for_each_once(self, doors):
        doors.set("between", 0.5)
        soon, whole = doors.take_requests()
        assert (soon.before is None, whole.before is None) == (False, True)
        assert doors.take_requests() == []
        doors.set("between", 0.25)
        assert doors.take_requests() == []
        assert doors.accept(soon.prepare())
        (again,) = doors.take_requests()
        assert again.openness == (0.25,)

    def test_a_whole_answer_of_an_old_state_brings_its_ways(self, doors):
        doors.set("between", 0.5)
        soon, whole = doors.take_requests()
        doors.accept(soon.prepare())
        doors.set("between", 0.25)
        old = whole.prepare()
        assert not doors.accept(old)
        soon, whole = doors.take_requests()
        assert soon.before is old.surroundings
        assert whole.openness == (0.25,)

    def test_what_comes_after_the_whole_is_not_heard(self, doors):
        doors.set("between", 0.5)
        soon, whole = doors.take_requests()
        late = soon.prepare()
        assert doors.accept(whole.prepare())
        assert not doors.accept(late)
        assert doors.take_requests() == []

    @pytest.mark.parametrize("which", [0, 1])
    def test_a_request_that_fails_leaves_the_doors_as_they_are_heard(self, doors, which):
        doors.set("between", 0.5)
        requests = doors.take_requests()
        doors.give_up(requests[which])
        doors.accept(requests[1 - which].prepare())
        for request in doors.take_requests():
            doors.accept(request.prepare())
        assert doors.take_requests() == []
        doors.set("between", 0.75)
        assert doors.take_requests()


def test_slides_are_heard_as_swings_are(tmp_path):
    levels = FieldsByLevel.load(write_two_rooms(tmp_path / "scene", SLIDE, openness=0.0))
    session = listen(opened(levels))
    hear(session, 40)
    before = level_db(hear(session, 40))
    set_door(session, 1.0)
    answer_doors(session)
    answer(session)
    hear(session, 40)
    assert level_db(hear(session, 40)) > before + 20


@pytest.mark.parametrize("openness", [math.nan, math.inf, -0.1, 1.1, True, "1", None])
def test_an_openness_that_is_none_is_refused(openness):
    with pytest.raises(ValueError, match="openness"):
        SetDoor(door="between", openness=openness)
