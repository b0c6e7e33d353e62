"""One session that hears several quality levels, one after another."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.field.fields_by_level import FieldsByLevel
from server.field.kinds.catalogue import kind_of
from server.planning.places import place_of_field
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, RemoveEmitter, SetEffects
from server.protocol.server_messages import EmitterAdded, LevelChanged
from server.rendering.convolver import Sharing
from server.responses.ir_request import compute_irs
from server.scene.manifest import QualityLevel
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

RATE, BLOCK = 24_000, 256
HERE, THERE = (2.0, 2.0, 1.5), (6.0, 3.0, 1.5)
HELLO = Hello(protocol=PROTOCOL, scene="flat")
CLIP = 0.005 * np.random.default_rng(3).standard_normal(3_000).astype(np.float32)  # no limiter acts
GOOD, FAST = QualityStep("good", None, Sharing.NOTHING, 2.0), QualityStep("fast", None, Sharing.NOTHING, 1.0)


class Room:
    """A field of a level of its own: one IR wherever one stands."""

    channels, sample_rate = 2, RATE

    def __init__(self, field, name, ir, **level):
        self.bundle, self.level, self._ir = field.bundle, QualityLevel(name=name, field="arithmetic", **level), ir
        self.kind = kind_of(self.level)

    @property
    def ir_samples(self):
        return self._ir.shape[1]

    def through(self, filters):  # noqa: ARG002  all heads hear the same
        return self

    def impulse_responses(self, listeners, *_, **__):
        return np.tile(self._ir, (len(listeners), 1, 1))


def decaying(seed, samples):
    decay = np.exp(-np.arange(samples) / 900)
    return (0.1 * decay * np.random.default_rng(seed).standard_normal((2, samples))).astype(np.float32)


@pytest.fixture
def levels(field):
    return FieldsByLevel(
        [Room(field, "good", decaying(1, 4_000)), Room(field, "fast", decaying(2, 2_000), shared_tail=True)]
    )


@pytest.fixture
def open_session(levels, filters):
    def start(clip=CLIP, quality=GOOD):
        return Session(HELLO, levels, filters, lambda _: clip, quality=quality, window=10_000)

    return start


def add(session, **changes):
    session.receive(AddEmitter(**{"id": "talker", "clip": "noise", "position": THERE, **changes}))


def answer(session, levels):
    request = session.take_request()
    return [] if request is None else session.accept(compute_irs(levels, request, session.renderer))


def hear(session, blocks):
    return np.concatenate([session.render_block().samples for _ in range(blocks)], axis=1).astype(float)


def changes(events):
    return [(event.level, event.reason) for event in events if isinstance(event, LevelChanged)]


def test_a_level_is_heard_from_when_it_says_so(open_session, levels):
    """Noise through one room, then the other: each to the sample what the convolution with its IR is."""
    session, silent = open_session(), open_session()
    for number, each in enumerate((session, silent)):
        add(each, loop=False)
        request = each.take_request()
        response = compute_irs(levels, request, each.renderer)
        assert each.accept(response) == [EmitterAdded(id="talker", sample_clock=0)]
        if number == 1:  # the direct sound alone
            each.renderer.set_reverberation_gain("talker", 0.0)
    assert session.set_quality(FAST, "load") == []
    assert session.quality == GOOD
    (event,) = answer(session, levels)
    assert event == LevelChanged(level="fast", reason="load", ir_rate_hz=None, shared_tail=False, sample_clock=0)
    assert session.quality == FAST
    heard = hear(session, 40) - hear(silent, 40)
    expected = [np.convolve(CLIP, ear.astype(float)) for ear in levels["fast"]._ir]
    assert_allclose(heard[:, : len(expected[0])], expected, atol=1e-7)


def test_levels_that_switch_while_a_tone_sounds_do_not_splatter(open_session, levels):
    time_s = np.arange(24_000) / RATE
    session = open_session(0.01 * np.sin(2 * np.pi * 1_000 * time_s).astype(np.float32))
    add(session)
    answer(session, levels)
    hear(session, 60)
    heard, events = [], []
    for number in range(16):
        to = QualityStep("fast", None, Sharing.TAIL, 1.0) if number % 2 == 0 else GOOD
        events += session.set_quality(to, "chosen")
        heard.append(hear(session, 2))  # the IRs take a while
        events += answer(session, levels)
        heard.append(hear(session, 18))
    assert changes(events) == [("fast", "chosen"), ("good", "chosen")] * 8
    wet = np.concatenate(heard, axis=1)
    power = np.abs(np.fft.rfft(wet * np.kaiser(wet.shape[1], 20))) ** 2
    high = np.fft.rfftfreq(wet.shape[1], 1 / RATE) > 4_000
    assert 10 * np.log10(power[:, high].sum() / power.sum()) < -90


def test_a_step_that_shares_more_does_so_before_its_responses_have_arrived(open_session, levels):
    """A core that is full may compute none of the cheaper level, and would stay full."""
    session = open_session()
    add(session)
    answer(session, levels)
    convolver = next(iter(session.renderer._mixers)).convolver
    assert convolver._sharing is Sharing.NOTHING
    assert session.set_quality(QualityStep("fast", None, Sharing.REVERBERATION, 1.0), "load") == []
    assert convolver._sharing is Sharing.REVERBERATION
    session.set_quality(GOOD, "recovered")
    assert convolver._sharing is Sharing.NOTHING
    session.set_quality(QualityStep("fast", None, Sharing.TAIL, 1.0), "load")
    answer(session, levels)
    session.set_quality(GOOD, "recovered")
    assert convolver._sharing is Sharing.TAIL, "what is heard shares until better responses have arrived"
    answer(session, levels)
    assert convolver._sharing is Sharing.NOTHING


def test_a_rate_alone_changes_at_once(open_session, levels):
    session = open_session()
    add(session)
    answer(session, levels)
    slower = QualityStep("good", 5.0, Sharing.NOTHING, 2.0)
    (event,) = session.set_quality(slower, "load")
    assert (event.level, event.reason, event.ir_rate_hz) == ("good", "load", 5.0)
    assert session.take_request() is None  # nothing it has is out of date
    assert session.set_quality(slower, "load") == []


def test_without_emitters_there_is_nothing_to_wait_for(open_session):
    session = open_session()
    assert changes(session.set_quality(FAST, "chosen")) == [("fast", "chosen")]
    add(session)
    assert session.take_request().level == "fast"
    session.set_quality(GOOD, "chosen")
    assert changes(session.receive(RemoveEmitter(id="talker"))) == [("good", "chosen")]


def test_where_nothing_has_a_response_there_is_nothing_to_wait_for(levels, filters, field):
    off = {"early_reflections": False, "late_reverberation": False}
    hello = Hello(protocol=PROTOCOL, scene="flat", effects=off)
    session = Session(hello, levels, filters, lambda _: CLIP, quality=GOOD, window=10_000, place=place_of_field(field))
    add(session)
    assert changes(session.set_quality(FAST, "chosen")) == []  # nobody knows yet whether it will have one
    assert changes(session.adopt(session.take_plan_request().plan())) == [("fast", "chosen")]
    assert changes(session.set_quality(GOOD, "chosen")) == [("good", "chosen")]
    assert session.take_request() is None
    session.receive(SetEffects(effects=dict.fromkeys(off)))
    session.adopt(session.take_plan_request().plan())
    assert changes(session.set_quality(FAST, "chosen")) == []
    assert changes(answer(session, levels)) == [("fast", "chosen")]


def test_an_answer_of_a_level_nobody_wants_any_more_is_not_heard(open_session, levels):
    session = open_session()
    add(session)
    answer(session, levels)
    session.set_quality(FAST, "load")
    request = session.take_request()
    assert request.level == "fast"
    assert session.set_quality(GOOD, "recovered") == []  # it never was anything else
    assert session.accept(compute_irs(levels, request, session.renderer)) == []
    assert session.quality == GOOD
    assert session.take_request().level == "good"


def test_responses_come_no_faster_than_they_may_but_a_new_emitter_gets_its_first_at_once(open_session, levels):
    session, asked_at = open_session(), []
    session.set_ir_interval(0.2)
    add(session)
    for number in range(1, 405):
        session.receive(ListenerPose(pose_id=number, position=HERE, yaw=0.01 * number))
        if (request := session.take_request()) is not None:
            asked_at.append(session.sample_clock / RATE)
            session.accept(compute_irs(levels, request, session.renderer))
        session.render_block()
    gaps = np.diff(asked_at)
    assert gaps.min() >= 0.2 - 1e-9
    assert gaps.max() <= 0.2 + 2 * BLOCK / RATE
    assert session.awaits_irs
    add(session, id="another")
    assert session.take_request() is not None


def test_a_new_level_does_not_wait_for_its_turn(open_session, levels):
    session = open_session()
    session.set_ir_interval(10.0)
    add(session)
    answer(session, levels)
    session.set_quality(FAST, "chosen")
    assert changes(answer(session, levels)) == [("fast", "chosen")]
