import gc
import json
import math
import weakref

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from numpy.testing import assert_allclose

from server.acoustics.geometry import Pose
from server.core.errors import RequestError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    DirectivityPattern,
    Hello,
    ListenerPose,
    ListenerStart,
    MoveEmitter,
    Ping,
    RemoveEmitter,
    SetGain,
    StopEmitter,
)
from server.protocol.server_messages import EmitterAdded, Error
from server.protocol.snapshot import Snapshot
from server.rendering.convolver import Sharing
from server.responses.full_response import FullResponse
from server.responses.ir_request import compute_irs
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

# Quiet enough that no limiter acts.
CLIP = 0.005 * np.random.default_rng(3).standard_normal(3_000).astype(np.float32)
HELLO = Hello(protocol=PROTOCOL, scene="flat")
FULL = QualityStep("standard", None, Sharing.NOTHING, 1.0)
HERE, THERE = (2.0, 2.0, 1.5), (6.0, 3.0, 1.5)


def load_clip(name):
    if name != "noise":
        raise RequestError("unknown_clip", "no such clip", field="clip", status=404)
    return CLIP


@pytest.fixture
def session(field, filters):
    return Session(HELLO, FieldsByLevel([field]), filters, load_clip, quality=FULL, window=1_000)


def add(session, identifier="talker", **changes):
    return session.receive(AddEmitter(**{"id": identifier, "clip": "noise", "position": THERE, **changes}))


def answer(session, field):
    """Compute what the session wants, at once, and hand it in."""
    request = session.take_request()
    return [] if request is None else session.accept(compute_irs(FieldsByLevel([field]), request, session.renderer))


def codes(events):
    return [event.code for event in events if isinstance(event, Error)]


def dead(field):
    """Nothing follows the direct sound any more."""
    field.impulse_responses = lambda listeners, *_, **__: np.zeros((len(listeners), 2, field.ir_samples), np.float32)
    return field


def hear(session, blocks):
    """(2, n)"""
    return np.concatenate([session.render_block().samples for _ in range(blocks)], axis=1).astype(float)


def level_db(samples):
    return 10 * np.log10(np.mean(samples**2))


def test_sound_is_the_clip_along_the_direct_path_and_convolved_with_the_fields_ir(field, filters):
    def heard(field):
        session = Session(
            Hello(protocol=PROTOCOL, scene="flat"),
            FieldsByLevel([field]),
            filters,
            load_clip,
            quality=FULL,
            window=1_000,
        )
        session.receive(ListenerPose(pose_id=1, position=HERE, yaw=0.5))
        add(session, loop=False, gain_db=-6.0)
        assert answer(session, field) == [EmitterAdded(id="talker", sample_clock=0)]
        return hear(session, 40)

    ir = field.impulse_responses([HERE], [THERE], [0.5])[0]
    whole, direct = heard(field), heard(dead(field))
    assert np.any(direct)
    expected = [np.convolve(CLIP * 10 ** (-6 / 20), ear)[: whole.shape[1]] for ear in ir.astype(float)]
    assert_allclose(whole - direct, [np.pad(ear, (0, whole.shape[1] - len(ear))) for ear in expected], atol=1e-7)


def test_the_direct_sound_follows_poses_that_no_ir_was_computed_for(session, field):
    session.receive(ListenerPose(pose_id=1, position=(5.0, 3.0, 1.5), yaw=0.0))
    add(session, gain_db=-6.0)
    answer(session, dead(field))
    near = hear(session, 100)
    session.receive(ListenerPose(pose_id=2, position=(2.0, 3.0, 1.5), yaw=0.0))
    session.take_request()  # and never answered
    block = session.render_block()
    assert (block.pose_id, block.reverberation_pose_id) == (2, 1)
    hear(session, 30)
    far = hear(session, 100)
    # From one metre to four.
    assert level_db(near[:, 2_000:]) - level_db(far) == pytest.approx(12.04, abs=0.5)
    session.receive(ListenerPose(pose_id=3, position=(2.0, 3.0, 1.5), yaw=math.pi / 2))
    hear(session, 10)
    left, right = hear(session, 100)
    assert level_db(right) > level_db(left) + 6


def test_an_emitter_is_moved_and_turned(session, field):
    session.receive(ListenerPose(pose_id=1, position=(2.0, 2.5, 1.5), yaw=0.0))
    add(session, position=(4.0, 2.5, 1.5), yaw=math.pi, directivity=DirectivityPattern(pattern="cardioid"))
    answer(session, dead(field))
    hear(session, 10)
    facing = hear(session, 100)
    session.receive(MoveEmitter(id="talker", position=(4.0, 2.5, 1.5), yaw=0.0, pose_id=2))
    hear(session, 10)
    away = hear(session, 100)
    assert level_db(away) < level_db(facing) - 40
    # Without a front it keeps the one it had.
    session.receive(MoveEmitter(id="talker", position=(3.0, 2.5, 1.5), pose_id=3))
    hear(session, 30)
    assert level_db(hear(session, 100)) < level_db(facing) - 30
    session.receive(MoveEmitter(id="talker", position=(1.0, 2.5, 1.5), pose_id=4))
    hear(session, 30)
    assert level_db(hear(session, 100)) == pytest.approx(level_db(facing) + 6, abs=3)  # from behind


def test_a_gain_scales_direct_sound_and_reverberation_alike(session, field):
    add(session)
    answer(session, field)
    hear(session, 100)
    before = hear(session, 100)
    session.receive(SetGain(id="talker", gain_db=-20.0))
    hear(session, 100)
    assert level_db(before) - level_db(hear(session, 100)) == pytest.approx(20, abs=0.5)


def test_what_is_sent_live_sounds_as_the_same_clip_does(field, filters):
    def heard(message, blocks):
        session = Session(
            Hello(protocol=PROTOCOL, scene="flat"),
            FieldsByLevel([field]),
            filters,
            load_clip,
            quality=FULL,
            window=1_000,
        )
        session.receive(message)
        answer(session, field)
        for sequence, block in enumerate(blocks):
            assert session.receive(DryBlock("a", sequence, block)) == []
        return hear(session, 40)

    dry = np.concatenate([CLIP, CLIP])
    live = heard(AddEmitter(id="a", live=True, position=THERE), np.split(dry, [500, 501, 3_000]))
    clip = heard(AddEmitter(id="a", clip="noise", position=THERE), [])
    samples = 5_000  # before it ends
    assert_allclose(live[:, :samples], clip[:, :samples], atol=1e-8)


def test_a_session_that_played_live_sound_is_freed_at_once(field, filters):
    """Its renderer has megabytes, and the collector of cycles comes seldom."""
    session = Session(HELLO, FieldsByLevel([field]), filters, load_clip, quality=FULL, window=1_000)
    add(session, "voice", clip=None, live=True)
    answer(session, field)
    session.receive(DryBlock("voice", 0, CLIP))
    hear(session, 3)
    renderer = weakref.ref(session.renderer)
    gc.disable()
    try:
        del session
        assert renderer() is None
    finally:
        gc.enable()


def test_live_blocks_have_to_come_in_order(session, field):
    session.receive(AddEmitter(id="a", live=True, position=THERE))
    answer(session, field)
    assert session.receive(DryBlock("a", 7, CLIP)) == []
    assert codes(session.receive(DryBlock("a", 7, CLIP))) == ["stale_block"]
    assert session.receive(DryBlock("a", 9, CLIP)) == []
    (status,) = session.live_statuses()
    assert (status.id, status.samples_queued) == ("a", 2 * CLIP.size)


@pytest.mark.parametrize("name", ["field", "mirrored_field"])
def test_who_stands_still_hears_the_scenes_whole_response(name, filters, request):
    field = request.getfixturevalue(name)
    session = Session(HELLO, FieldsByLevel([field]), filters, load_clip, quality=FULL, window=1_000)
    session.receive(ListenerPose(pose_id=1, position=HERE, yaw=0.5))
    add(session, loop=False)
    answer(session, field)
    heard = hear(session, 40)
    ir = FullResponse(field, filters).impulse_responses([HERE], [THERE], [0.5])[0].astype(float)
    expected = [np.pad(np.convolve(CLIP, ear), (0, 10_000))[: heard.shape[1]] for ear in ir]
    assert_allclose(heard, expected, atol=1e-6)


def test_a_full_window_drops_blocks_but_not_time(field, filters):
    def run(acknowledged):
        session = Session(
            Hello(protocol=PROTOCOL, scene="flat"), FieldsByLevel([field]), filters, load_clip, quality=FULL, window=4
        )
        add(session)
        answer(session, field)
        blocks = []
        for _ in range(10):
            block = session.render_block()
            if block is not None:
                blocks.append(block)
                if acknowledged:
                    session.receive(Acknowledge(sequence=block.sequence))
        session.receive(Acknowledge(sequence=blocks[-1].sequence))
        return session, session.render_block()

    patient, expected = run(acknowledged=True)
    silent, resumed = run(acknowledged=False)
    assert (silent.blocks_dropped, patient.blocks_dropped) == (6, 0)
    assert (resumed.sequence, resumed.sample_clock) == (4, 10 * 256)
    np.testing.assert_array_equal(resumed.samples, expected.samples)


ABOUT_EMITTERS = {"add_emitter", "move_emitter", "set_gain", "remove_emitter", "dry_block"}


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (ListenerPose(pose_id=9, position=(99.0, 2.0, 1.5)), "position_out_of_bounds"),
        (ListenerPose(pose_id=0, position=HERE), "stale_pose"),
        (MoveEmitter(id="talker", position=(2.0, 2.0, -1.0), pose_id=9), "position_out_of_bounds"),
        (MoveEmitter(id="nobody", position=HERE, pose_id=9), "unknown_emitter"),
        (RemoveEmitter(id="nobody"), "unknown_emitter"),
        (AddEmitter(id="talker", clip="noise", position=HERE), "duplicate_emitter"),
        (AddEmitter(id="new", clip="nothing", position=HERE), "unknown_clip"),
        (AddEmitter(id="new", clip="noise", position=(0.0, 0.0, 9.0)), "position_out_of_bounds"),
        (AddEmitter(id="talker", live=True, position=HERE), "duplicate_emitter"),
        (SetGain(id="nobody", gain_db=-6.0), "unknown_emitter"),
        (DryBlock("nobody", 0, CLIP), "unknown_emitter"),
        (DryBlock("talker", 0, CLIP), "not_live"),
        (Acknowledge(sequence=4_000), "unknown_sequence"),
        (Hello(protocol=PROTOCOL, scene="flat"), "unexpected_hello"),
        (Ping(id=1), "unexpected_ping"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.type,
)
def test_a_bad_message_changes_nothing_and_the_stream_goes_on(session, field, message, code):
    add(session)
    answer(session, field)
    session.render_block()
    refused = session.receive(message)
    assert codes(refused) == [code]
    assert refused[0].emitter == (message.id if message.type in ABOUT_EMITTERS else None)
    assert session.take_request() is None
    block = session.render_block()
    assert np.any(block.samples)
    assert not block.is_exchange
    # The pose id of a refused pose is not used up.
    assert session.receive(ListenerPose(pose_id=9, position=HERE)) == []


def test_emitters_are_limited(field, filters):
    session = Session(
        Hello(protocol=PROTOCOL, scene="flat"), FieldsByLevel([field]), filters, load_clip, quality=FULL, max_emitters=2
    )
    assert codes(add(session, "a") + add(session, "b") + add(session, "c")) == ["too_many_emitters"]


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"protocol": 2}, "unsupported_protocol"),
        ({"protocol": 4}, "unsupported_protocol"),
        ({"sample_rate": 32_000}, "unsupported_sample_rate"),
        ({"listener": ListenerStart(position=(-5.0, 0.0, 0.0))}, "position_out_of_bounds"),
    ],
)
def test_a_hello_that_cannot_be_served_is_refused(field, filters, changes, code):
    with pytest.raises(RequestError) as refusal:
        Session(
            Hello(**{"protocol": PROTOCOL, "scene": "flat", **changes}),
            FieldsByLevel([field]),
            filters,
            load_clip,
            quality=FULL,
        )
    assert refusal.value.code == code


def test_a_listener_starts_where_the_scene_says_unless_hello_says_otherwise(field, filters):
    for hello, expected in [
        (Hello(protocol=PROTOCOL, scene="flat"), Pose.from_yaw((2.0, 2.5, 1.5), math.pi / 2)),
        (
            Hello(protocol=PROTOCOL, scene="flat", listener=ListenerStart(position=HERE, yaw=1.0)),
            Pose.from_yaw(HERE, 1.0),
        ),
    ]:
        session = Session(hello, FieldsByLevel([field]), filters, load_clip, quality=FULL)
        add(session)
        assert session.take_request().listener == expected


def test_laws_hold_whatever_a_client_says_in_whatever_order(field, filters):
    class AnyOrder(RuleBasedStateMachine):
        @initialize()
        def begin(self):
            self.session = Session(
                Hello(protocol=PROTOCOL, scene="flat", block_size=128),
                FieldsByLevel([field]),
                filters,
                load_clip,
                quality=FULL,
                window=6,
            )
            self.pose_id = self.sequence = 0
            self.request = None
            self.blocks = []

        @rule(identifier=st.sampled_from("abc"))
        def add(self, identifier):
            add(self.session, identifier)

        @rule(identifier=st.sampled_from("abc"))
        def remove(self, identifier):
            self.session.receive(RemoveEmitter(id=identifier))

        @rule(x=st.floats(0.0, 9.0), yaw=st.floats(-4, 4))
        def turn(self, x, yaw):
            if not self.session.receive(ListenerPose(pose_id=self.pose_id + 1, position=(x, 2.0, 1.5), yaw=yaw)):
                self.pose_id += 1

        @rule(identifier=st.sampled_from("abc"))
        def move(self, identifier):
            if not self.session.receive(MoveEmitter(id=identifier, position=HERE, pose_id=self.pose_id + 1)):
                self.pose_id += 1

        @rule(identifier=st.sampled_from("abc"))
        def add_live(self, identifier):
            self.session.receive(AddEmitter(id=identifier, live=True, position=HERE))

        @rule(identifier=st.sampled_from("abc"), frames=st.integers(1, 5_000), value=st.floats(width=32))
        def speak(self, identifier, frames, value):
            self.sequence += 1
            self.session.receive(DryBlock(identifier, self.sequence, np.full(frames, value, np.float32)))

        @rule(identifier=st.sampled_from("abc"), gain_db=st.floats(-80, 24))
        def make_louder(self, identifier, gain_db):
            self.session.receive(SetGain(id=identifier, gain_db=gain_db))

        @rule()
        def ask(self):
            self.request = self.session.take_request() or self.request

        @rule(succeeds=st.booleans())
        def answer(self, succeeds):
            if self.request is None:
                return
            request, self.request = self.request, None
            if succeeds:
                self.session.accept(compute_irs(FieldsByLevel([field]), request, self.session.renderer))
            else:
                self.session.give_up(request)

        @rule(sequence=st.integers(0, 20))
        def acknowledge(self, sequence):
            self.session.receive(Acknowledge(sequence=sequence))

        @rule()
        def render(self):
            block = self.session.render_block()
            if block is not None:
                self.blocks.append(block)

        @invariant()
        def blocks_are_finite_and_in_order(self):
            assert all(np.isfinite(block.samples).all() for block in self.blocks[-1:])
            assert [block.sequence for block in self.blocks] == list(range(len(self.blocks)))
            assert all(a.sample_clock < b.sample_clock for a, b in zip(self.blocks, self.blocks[1:], strict=False))
            assert all(
                a.pose_id <= b.pose_id and a.reverberation_pose_id <= b.reverberation_pose_id
                for a, b in zip(self.blocks, self.blocks[1:], strict=False)
            )
            assert all(block.reverberation_pose_id <= block.pose_id <= self.pose_id for block in self.blocks)

    run_state_machine_as_test(AnyOrder, settings=settings(max_examples=60, stateful_step_count=40))


def test_a_shared_tail_is_the_operators_choice(field, filters):
    hello = Hello(protocol=PROTOCOL, scene="flat")
    for wanted in (False, True):
        session = Session(hello, FieldsByLevel([field]), filters, load_clip, quality=FULL, shared_tail=wanted)
        assert session.renderer._mixers.preparer(2)._sharing is (Sharing.TAIL if wanted else Sharing.NOTHING)


def kept(session):
    """Its state, as it comes back from where it was kept."""
    return Snapshot.parse(session.snapshot(session="s", handled=7).model_dump_json().encode())


def test_a_restored_session_is_in_the_state_of_the_lost_one(session, field, filters):
    add(session, directivity=DirectivityPattern(pattern="cardioid", order=2.0), yaw=1.0)
    add(session, "once", loop=False, gain_db=-6.0)
    session.receive(AddEmitter(id="me", live=True, position=HERE))
    session.receive(DryBlock("me", 41, np.zeros(100, np.float32)))
    session.receive(ListenerPose(pose_id=3, position=(3.0, 2.0, 1.2), orientation=(0.1, 0.2, 0.3, 0.9)))
    session.receive(MoveEmitter(id="talker", pose_id=5, position=(5.0, 3.0, 1.0)))
    session.receive(SetGain(id="talker", gain_db=-3.0))
    answer(session, field)
    hear(session, 5)
    snapshot = kept(session)
    assert (snapshot.sample_clock, snapshot.sequence, snapshot.pose_id, snapshot.handled) == (5 * 256, 5, 5, 7)
    assert [each.since for each in snapshot.emitters] == [0, 0, 0]

    again = Session(snapshot.hello, FieldsByLevel([field]), filters, load_clip, quality=FULL)
    assert again.restore(snapshot) == []
    # Numbers that were normalised once more may differ in their last digit.
    first, second = (json.loads(each.model_dump_json()) for each in (snapshot, kept(again)))
    assert flat(second) == pytest.approx(flat(first), abs=1e-12)
    assert codes(again.receive(ListenerPose(pose_id=5, position=HERE))) == ["stale_pose"]
    assert codes(again.receive(DryBlock("me", 41, np.zeros(9, np.float32)))) == ["stale_block"]
    assert codes(add(again)) == ["duplicate_emitter"]
    block = again.render_block()
    assert (block.sequence, block.sample_clock, block.pose_id, block.reverberation_pose_id) == (5, 5 * 256, 5, 5)


def flat(value, path=""):
    """A JSON document as one dictionary, with the place of each value."""
    if isinstance(value, dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return {name: each for key, child in pairs for name, each in flat(child, f"{path}/{key}").items()}
    return {path: value}


@pytest.mark.parametrize("loop", [True, False])
def test_clips_of_a_restored_session_are_where_they_would_be(session, field, filters, loop):
    add(session, loop=loop)
    answer(session, field)
    hear(session, 3)
    snapshot = kept(session)
    again = Session(snapshot.hello, FieldsByLevel([field]), filters, load_clip, quality=FULL, window=1_000)
    again.restore(snapshot)
    again.continue_at(snapshot.sample_clock + 2 * 256, 20)
    assert again.sample_clock == 5 * 256
    lost, silent = hear(session, 2 + 1), hear(again, 1)  # the response comes a block later
    assert lost.any()
    assert not silent.any()
    assert answer(again, field) == []  # the client knows that they are there
    first, *_, last = (again.render_block() for _ in range(25))
    assert (first.sequence, first.sample_clock) == (21, 6 * 256)
    expected = hear(session, 25)
    assert np.abs(first.samples[:, :16]).max() < 0.01 * np.abs(expected).max()
    assert_allclose(last.samples, expected[:, -256:], atol=1e-4 * max(np.abs(expected).max(), 0.01))


def test_an_emitter_that_cannot_be_restored_is_told_and_the_others_go_on(session, field, filters):
    add(session, "a")
    add(session, "b")
    snapshot = kept(session)

    def forget(name):
        raise RequestError("unknown_clip", f"there is no clip {name!r}", field="clip", status=404)

    again = Session(snapshot.hello, FieldsByLevel([field]), filters, forget, quality=FULL)
    errors = again.restore(snapshot)
    assert codes(errors) == ["unknown_clip"] * 2
    assert [error.emitter for error in errors] == ["a", "b"]
    assert again.render_block() is not None


def test_a_snapshot_that_this_version_cannot_read_is_an_unknown_one():
    for data in (b"{}", b"?", b'{"session": "a", "hello": {"type": "hello", "protocol": 3, "scene": "flat"}}'):
        with pytest.raises(RequestError) as refusal:
            Snapshot.parse(data)
        assert refusal.value.code == "unknown_resume_token"


@pytest.mark.parametrize("is_told_before", [True, False])
def test_a_clip_of_a_restored_session_stops_when_it_was_to_and_is_told_once(session, field, filters, is_told_before):
    """Be its end in the gap or after it."""
    add(session)
    answer(session, dead(field))
    hear(session, 2)
    session.receive(StopEmitter(id="talker", stop_at=4 * 256, fade_s=0.005))
    before = [
        event for _ in range(100 if is_told_before else 1) for event in (hear(session, 1), session.follow_clock())[1]
    ]
    assert [event.type for event in before] == ["emitter_ended"] * is_told_before
    snapshot = kept(session)
    again = Session(snapshot.hello, FieldsByLevel([field]), filters, load_clip, quality=FULL, window=1_000)
    again.restore(snapshot)
    after = []
    for _ in range(100):
        answer(again, field)
        block = again.render_block()
        assert block.sample_clock <= 12 * 256 or not block.samples.any()
        after += again.follow_clock()
    assert [event.type for event in after] == ["emitter_ended"] * (not is_told_before)


def test_a_gain_on_its_way_has_arrived_in_a_restored_session(session, field):
    add(session, gain_db=0.0)
    answer(session, field)
    hear(session, 1)
    session.receive(SetGain(id="talker", gain_db=-12.0, ramp_s=1.0))
    hear(session, 2)
    assert kept(session).emitters[0].emitter.gain_db == -12.0
