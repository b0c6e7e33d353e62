"""Several listeners of one stream: each hears what a stream of its own would give it, and none disturbs another."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.planning.places import place_of_field
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    Hello,
    ListenerPose,
    MoveEmitter,
    RemoveEmitter,
    RemoveListener,
    SetEffects,
    SetGain,
    StopEmitter,
)
from server.protocol.server_messages import EmitterAdded, EmitterEnded, EmitterRemoved, Error, ListenerRemoved
from server.protocol.snapshot import Snapshot
from server.rendering.convolver import Sharing
from server.rendering.renderer import render_all
from server.responses.ir_request import compute_irs
from server.streaming.audience import Audience, Member, NewListener, Roster
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from server.streaming.stream_times import StreamTimes
from tests.engine_stage import BLOCK_S, Stage

CLIP = (0.05 * np.random.default_rng(8).standard_normal(2_000)).astype(np.float32)
FULL = QualityStep("standard", None, Sharing.NOTHING, 1.0)
WEST, EAST = (1.0, 2.5, 1.5), (7.0, 2.5, 1.5)
HELLO = Hello(protocol=PROTOCOL, scene="flat", listener={"position": WEST})


class Room:
    """An audience in the flat whose responses are computed at once, and what each listener has heard. With a `place`
    their effects are planned."""

    def __init__(self, field, filters, *, place=None):
        self.levels, self.filters, self.place = FieldsByLevel([field]), filters, place
        self.audience = Audience(self.session(), StreamTimes())
        self.roster = Roster(8)
        self.heard = {None: []}
        self.told = []

    def session(self, hello=HELLO, **options):
        options |= {"quality": FULL, "window": 10**6, "max_emitters": 4, "place": self.place}
        return Session(hello, self.levels, self.filters, lambda _: CLIP, **options)

    def join(self, identifier, position=EAST, hello=HELLO):
        message = AddListener(id=identifier, position=position)
        session = self.session(hello, listener=message.pose, index=self.roster.enter(identifier))
        self.told.append(self.audience.join(NewListener(message, session, "kemar"), FULL))
        self.heard.setdefault(identifier, [])
        return session

    def send(self, message):
        answers = self.audience.receive(message)
        self.told += answers
        return answers

    def answer(self, *whose):
        for member in self.audience.members:
            if whose and member.id not in whose:
                continue
            if (wanted := member.session.take_plan_request()) is not None:
                self.told += self.audience.adopt(member, wanted.plan())
            if (request := member.session.take_request()) is not None:
                response = compute_irs(self.levels, request, member.session.renderer)
                self.told += self.audience.accept(member, response)

    def play(self, blocks, *, answers=True):
        made = []
        for _ in range(blocks):
            if answers:
                self.answer()
            self.audience.begin_block()
            clock = self.audience.first.session.sample_clock
            rendered = render_all(self.audience.renderers(1))
            for member, block in zip(self.audience.members, rendered, strict=True):
                (made_block,) = member.session.finish_blocks(clock, [block])
                made.append(made_block)
                self.heard[member.id].append(made_block.samples)
            self.told += self.audience.follow_clock()
        return made

    def of(self, identifier=None):
        return np.concatenate(self.heard[identifier], axis=1)


@pytest.fixture
def room(field, filters):
    return Room(field, filters)


def talker(identifier="a", **changes):
    return AddEmitter(**{"id": identifier, "clip": "noise", "position": (4.0, 3.0, 1.5), **changes})


def alone(field, filters, where, acts, blocks):
    """What a stream of one listener who stands at `where` gives, with messages before some of its blocks."""
    single = Room(field, filters)
    single.audience = Audience(
        single.session(HELLO.model_copy(update={"listener": None}), listener=where), StreamTimes()
    )
    for number in range(blocks):
        for message in acts.get(number, ()):
            single.send(message)
        single.play(1)
    return single.of()


def test_two_listeners_hear_what_two_streams_would_have_given_them(room, field, filters):
    acts = {
        0: [talker(), talker("b", position=(2.0, 1.0, 1.2), gain_db=-6.0, start_at=700)],
        6: [SetGain(id="a", gain_db=-12.0, ramp_s=0.05)],
        9: [MoveEmitter(id="b", position=(3.0, 1.0, 1.2), pose_id=5)],
        15: [StopEmitter(id="a", fade_s=0.02)],
        22: [RemoveEmitter(id="b")],
    }
    room.join("guest")
    for number in range(110):
        for message in acts.get(number, ()):
            assert not [each for each in room.send(message) if isinstance(each, Error)]
        room.play(1)
    for identifier, where in ((None, WEST), ("guest", EAST)):
        pose = AddListener(id="x", position=where).pose
        expected = alone(field, filters, pose, acts, 110)
        assert np.abs(expected).max() > 1e-3
        assert_array_equal(room.of(identifier), expected)
    assert not np.array_equal(room.of(), room.of("guest"))
    kinds = [type(each) for each in room.told]
    assert (kinds.count(EmitterAdded), kinds.count(EmitterRemoved), kinds.count(EmitterEnded)) == (2, 1, 1)


def test_a_pose_moves_the_listener_it_names_and_no_other(room, field, filters):
    room.join("guest")
    room.send(talker())
    room.play(10)
    turn = {"position": (6.0, 2.0, 1.5), "yaw": 1.0}
    assert room.send(ListenerPose(pose_id=3, listener="guest", **turn)) == []
    assert room.send(ListenerPose(pose_id=4, index=1, **turn)) == []
    made = room.play(20)
    assert {(block.listener, block.pose_id) for block in made} == {(0, 0), (1, 4)}
    assert_array_equal(room.of(), alone(field, filters, AddListener(id="x", position=WEST).pose, {0: [talker()]}, 30))


@pytest.mark.parametrize(
    ("message", "code", "listener"),
    [
        (ListenerPose(pose_id=9, position=WEST, listener="nobody"), "unknown_listener", "nobody"),
        (ListenerPose(pose_id=9, position=WEST, index=9), "unknown_listener", None),
        (ListenerPose(pose_id=9, position=(99.0, 0.0, 1.0), listener="guest"), "position_out_of_bounds", "guest"),
        (ListenerPose(pose_id=1, position=EAST, listener="guest"), "stale_pose", "guest"),
        (Acknowledge(sequence=0, listener="nobody"), "unknown_listener", "nobody"),
        (Acknowledge(sequence=10**6, listener="guest"), "unknown_sequence", "guest"),
        (RemoveListener(id="nobody"), "unknown_listener", "nobody"),
        (MoveEmitter(id="a", position=WEST, pose_id=2), "stale_pose", None),
        (talker(), "duplicate_emitter", None),
    ],
)
def test_what_is_refused_changes_nothing_for_anybody(room, message, code, listener):
    other = Room(room.levels.default, room.filters)
    for each in (room, other):
        each.join("guest")
        each.send(talker())
        each.send(ListenerPose(pose_id=2, position=(6.5, 2.5, 1.5), listener="guest"))
        each.play(6)
    (refusal,) = room.send(message)
    assert (refusal.code, refusal.listener) == (code, listener)
    for each in (room, other):
        each.play(12)
    for identifier in (None, "guest"):
        assert_array_equal(room.of(identifier), other.of(identifier))


def test_one_who_comes_later_fades_in_and_disturbs_nobody(room, field, filters):
    room.send(talker())
    room.send(talker("b", live=True, clip=None, position=(5.0, 1.0, 1.5)))
    live = 0.1 * np.random.default_rng(2).standard_normal(30 * 256).astype(np.float32)
    room.send(DryBlock("b", 0, live[: 20 * 256]))
    room.play(12)
    session = room.join("guest")
    assert session.sample_clock == 12 * 256
    made = room.play(40)
    assert {block.sample_clock for block in made if block.listener == 1} == set(range(12 * 256, 52 * 256, 256))
    whole = Room(field, filters)
    whole.join("guest")
    whole.send(talker())
    whole.send(talker("b", live=True, clip=None, position=(5.0, 1.0, 1.5)))
    whole.send(DryBlock("b", 0, live[: 20 * 256]))
    whole.play(52)
    assert_array_equal(room.of(), whole.of())
    late, early = room.of("guest"), whole.of("guest")[:, 12 * 256 :]
    assert np.abs(late[:, 0]).max() < 1e-6
    steps = np.abs(np.diff(late[:, :512])).max()
    assert steps <= 1.5 * np.abs(np.diff(early)).max()
    after = 30 * 256  # everything that was sent to the responses before it came has rung out
    assert_allclose(late[:, after:], early[:, after:], atol=1e-6)
    assert np.abs(early[:, after:]).max() > 1e-3


def test_one_who_comes_during_a_ramp_hears_the_gain_of_the_others(room, field, filters):
    whole = Room(field, filters)
    whole.join("guest")
    for each in (room, whole):
        each.send(talker())
        each.play(5)
        each.send(SetGain(id="a", gain_db=-40.0, ramp_s=1.0))
        each.play(10)
    room.join("guest")
    for each in (room, whole):
        each.play(60)
    expected = whole.of("guest")[:, 15 * 256 :]
    assert_allclose(room.of("guest")[:, 30 * 256 :], expected[:, 30 * 256 :], atol=2e-6)
    assert np.abs(expected[:, 30 * 256 : 40 * 256]).max() > 1e-3


def test_one_who_comes_later_hears_with_the_effects_that_are_wished_by_then(field, filters):
    place, hello = place_of_field(field), HELLO.model_copy(update={"effects": {"air_absorption": False}})
    wishes = {"late_reverberation": False, "hrtf": False, "air_absorption": None}
    rooms = {}
    for comes_at in (0, 12):
        room = rooms[comes_at] = Room(field, filters, place=place)
        room.audience = Audience(room.session(hello), StreamTimes())
        room.send(talker())
        for number in range(70):
            if number == comes_at:
                room.join("guest", hello=hello)
            if number == 6:
                assert room.send(SetEffects(effects=wishes, output="mono")) == []
            room.play(1)
        (guest,) = (member.session for member in room.audience.members[1:])
        kept = guest.snapshot(session="5e", handled=0).hello
        assert (kept.effects, kept.output) == ({"late_reverberation": False, "hrtf": False}, "mono")
    early, late = rooms[0].of("guest")[:, 12 * 256 :], rooms[12].of("guest")
    after = 40 * 256
    assert np.abs(early[:, after:]).max() > 1e-3
    assert_allclose(late[:, after:], early[:, after:], atol=1e-3 * np.abs(early).max())


def test_one_who_leaves_leaves_the_others_untouched(room, field, filters):
    room.join("guest")
    room.join("third", (2.0, 4.0, 1.5))
    room.send(talker())
    room.play(8)
    sent = room.audience.totals()[0]["sent"]
    (left,) = room.send(RemoveListener(id="guest"))
    assert left == ListenerRemoved(id="guest", index=1)
    assert room.audience.totals()[0]["sent"] == sent == 24
    room.play(12)
    for identifier, where in ((None, WEST), ("third", (2.0, 4.0, 1.5))):
        pose = AddListener(id="x", position=where).pose
        assert_array_equal(room.of(identifier), alone(field, filters, pose, {0: [talker()]}, 20))
    assert len(room.of("guest")[0]) == 8 * 256


def test_a_sound_begins_for_all_when_the_last_of_them_has_a_response(room):
    room.join("guest")
    room.send(talker(loop=False))
    room.answer(None)
    room.play(3, answers=False)
    assert not room.of().any()
    assert not any(isinstance(each, EmitterAdded) for each in room.told)
    room.answer("guest")
    assert room.told[-1] == EmitterAdded(id="a", sample_clock=3 * 256)
    room.play(20)
    first = [int(np.flatnonzero(room.of(name)[0])[0]) for name in (None, "guest")]
    assert min(first) >= 3 * 256


@pytest.mark.parametrize("is_removed", [False, True])
def test_one_whose_response_fails_keeps_nobody_waiting(room, is_removed):
    room.join("guest")
    room.send(talker())
    room.answer(None)
    guest = room.audience.members[1]
    request = guest.session.take_request()
    if is_removed:
        told = room.send(RemoveListener(id="guest"))
    else:
        told = room.audience.give_up(guest, request)
        assert [each.listener for each in told if isinstance(each, Error)] == ["guest"]
    assert EmitterAdded(id="a", sample_clock=0) in told
    room.play(5, answers=False)
    assert room.of().any()
    if not is_removed:
        assert not room.of("guest").any()
        room.send(ListenerPose(pose_id=1, position=EAST, yaw=0.1, listener="guest"))
        room.play(20)
        assert room.of("guest")[:, -256:].any()
    assert sum(isinstance(each, EmitterAdded) for each in [*room.told, *told]) == (2 if is_removed else 1)


@pytest.mark.parametrize("fails_for", [None, "guest"])
def test_a_short_sound_ends_though_one_never_hears_it(room, fails_for):
    room.join("guest")
    for number in range(6):  # more than there is room for at once
        assert room.send(talker(str(number), loop=False, remove_when_ended=True)) == []
        room.answer("guest" if fails_for is None else None)
        failing = next(member for member in room.audience.members if member.id == fails_for)
        room.told += room.audience.give_up(failing, failing.session.take_request())
        room.play(100, answers=False)
        assert not any(member.session.emitters for member in room.audience.members)
    ended = [(each.id, each.removed) for each in room.told if isinstance(each, EmitterEnded)]
    assert ended == [(str(number), True) for number in range(6)]
    assert not room.of(fails_for).any()
    assert room.of("guest" if fails_for is None else None).any()


def test_an_emitter_that_has_no_room_for_one_is_there_for_none(room, monkeypatch):
    room.join("guest")
    guest = room.audience.members[1].session

    def full(*_args, **_options):
        raise RequestError("too_many_emitters", "full")

    monkeypatch.setattr(guest, "share_emitter", full)
    (refusal,) = room.send(talker())
    assert (refusal.code, refusal.emitter) == ("too_many_emitters", "a")
    assert not room.audience.first.session.emitters
    monkeypatch.undo()
    assert room.send(talker()) == []


def test_windows_are_those_of_each_listener(field, filters):
    room = Room(field, filters)
    session = room.join("guest")
    first = room.audience.first.session
    first.window, session.window = type(first.window)(3), type(first.window)(3)
    for _ in range(5):
        room.audience.begin_block()
        rendered = render_all(room.audience.renderers(1))
        clock = first.sample_clock - 256
        room.send(Acknowledge(sequence=max(0, first.window.next_sequence - 1))) if first.window.sent else None
        for member, block in zip(room.audience.members, rendered, strict=True):
            member.session.finish_blocks(clock, [block])
    assert (first.window.sent, session.window.sent) == (5, 3)
    assert not room.audience.has_no_room
    assert (first.blocks_dropped, session.blocks_dropped) == (0, 2)


def test_a_snapshot_has_all_listeners_and_restores_them(room, field, filters):
    room.join("guest")
    room.join("third", (2.0, 4.0, 1.5))
    room.send(talker())
    room.play(6)
    room.send(ListenerPose(pose_id=7, position=(6.0, 1.0, 1.5), yaw=0.5, listener="guest"))
    data = room.audience.snapshot(session="5e", handled=3).model_dump_json().encode()
    snapshot = Snapshot.parse(data)
    assert (snapshot.pose_id, snapshot.hello.listeners) == (7, 3)
    assert [(kept.listener.id, kept.index) for kept in snapshot.listeners] == [("guest", 1), ("third", 2)]
    assert snapshot.listeners[0].listener.position == (6.0, 1.0, 1.5)
    again = Room(field, filters)
    first = again.session(snapshot.hello)
    assert first.restore(snapshot) == []
    again.audience = Audience(first, StreamTimes())
    for kept in snapshot.listeners:
        session = again.session(listener=kept.listener.pose, index=again.roster.enter(kept.listener.id, kept.index))
        new = NewListener(kept.listener, session, "kemar")
        again.audience.join(new, FULL, sequence=first.window.next_sequence)
        again.heard[kept.listener.id] = []
    made = again.play(60)
    assert {(block.listener, block.sequence) for block in made[:3]} == {(0, 6), (1, 6), (2, 6)}
    room.play(60)
    for identifier in (None, "guest", "third"):
        expected = room.of(identifier)[:, 6 * 256 :]
        loudest = np.abs(expected[:, 35 * 256 :]).max()
        # Who has walked keeps filters of a place just before, from which the new ones do not differ audibly.
        limit = 2e-3 if identifier == "guest" else 1e-5
        assert_allclose(again.of(identifier)[:, 35 * 256 :], expected[:, 35 * 256 :], atol=limit * loudest)
        assert loudest > 1e-3


@pytest.mark.parametrize("has_plans", [False, True])
def test_who_comes_and_goes_in_a_loop_leaves_no_work_behind(field, filters, has_plans):
    """While the workers have time for nothing."""
    stage, place = Stage(field, filters), place_of_field(field) if has_plans else None
    stream, _ = stage.open(place=place)
    stream.offer(talker())
    stage.run(3 * BLOCK_S)

    def come_and_go(number):
        message = AddListener(id="guest", position=EAST)
        options = {"window": 1_000, "place": place, "listener": message.pose, "index": number}
        session = Session(HELLO, stream.levels, filters, lambda _: CLIP, quality=stream.ladder.step, **options)
        stream.offer(NewListener(message, session, "kemar"))
        stage.run(2 * BLOCK_S)
        yield stream.audience.members[1]
        stream.offer(RemoveListener(id="guest"))
        stage.run(2 * BLOCK_S)

    for number in range(1, 51):
        assert all(len(member.pending) for member in come_and_go(number))
    assert len(stage.workers.urgent) == 51
    assert sum(not future.done() for future, *_ in stage.workers.work) == 1
    assert stream.audience.departed_work == 0
    begun = []
    for number in range(51, 54):
        for _ in come_and_go(number):
            begun.append(stage.workers.work[-1])
            begun[-1][0].set_running_or_notify_cancel()
    assert stream.audience.departed_work == 3
    for future, function, arguments in begun:
        future.set_result(function(*arguments))
    assert stream.audience.departed_work == 0
    stage.run(2 * BLOCK_S)
    assert [member.id for member in stream.audience.members] == [None]


def test_a_roster_gives_a_number_again_only_after_all_others():
    roster = Roster(3)
    assert [roster.enter("a"), roster.enter("b")] == [1, 2]
    for name, code in (("a", "duplicate_listener"), ("c", "too_many_listeners")):
        with pytest.raises(RequestError) as caught:
            roster.enter(name)
        assert caught.value.code == code
    roster.leave("a")
    assert roster.enter("a") == 3
    with pytest.raises(RequestError) as caught:
        roster.leave("nobody")
    assert caught.value.code == "unknown_listener"
    numbers = []
    for _ in range(300):
        roster.leave("a")
        numbers.append(roster.enter("a"))
    assert len(set(numbers[:253])) == 253
    assert set(numbers) == set(range(1, 256)) - {2}


def test_first_responses_of_emitters_say_nothing_of_what_later_requests_cost(field, filters):
    member = Member(Room(field, filters).session())
    for cost_s in (0.008, 0.006):
        member.note_request(cost_s, is_first=True)
        assert member.request_s == pytest.approx(cost_s)
    member.note_request(0.002, is_first=False)
    assert member.request_s == pytest.approx(0.002)
    member.note_request(0.007, is_first=True)  # of another emitter, beside those that are there
    assert 0.002 < member.request_s < 0.007
