"""Counters at their ends, and hours of streaming."""

import math
import struct

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from server.core.errors import RequestError
from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.client_messages import Acknowledge, ListenerPose, parse_client_message
from server.streaming.pacing import SendWindow, StreamClock
from tests.hard_cases.listening import HERE, RATE, SIZE, Listening, ahead, convolved, hear, play, played, renderer, room
from tests.signals import error_db, noise

LONG = 2**32 // SIZE - 2
"""Blocks: in the third from now the sample clock passes 2^32, after two days at 24 kHz."""


def old(listening):
    listening.session.renderer._blocks_rendered = LONG
    return listening


def test_the_sample_clock_goes_on_past_two_to_the_thirty_two(measured, field, filters):
    listening = old(Listening(field, filters))
    listening.add()
    clocks = []
    for _ in range(5):
        listening.answer()
        data = listening.session.render_block().serialize("f32")
        clocks.append(AudioBlock.parse(data, "f32").sample_clock)
    assert clocks == [2**32 + SIZE * step for step in range(-2, 3)]
    measured("clock past its end", clocks[-1] - 2**32, 1, "samples", at_least=True)


def test_sound_is_the_same_after_two_days_as_at_the_beginning(measured, field, filters):
    outputs = []
    for age in (lambda one: one, old):
        listening = age(Listening(field, filters))
        listening.add()
        outputs.append(listening.hear(20))
    measured("largest difference", np.abs(outputs[0] - outputs[1]).max(), 0.0)


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**40), st.integers(0, 2**32 - 1))
def test_a_block_of_any_age_survives_the_wire(clock, sequence, pose_id):
    block = AudioBlock(sequence, clock, pose_id, pose_id, np.zeros((2, 4), np.float32))
    back = AudioBlock.parse(block.serialize("f32"), "f32")
    assert (back.sample_clock, back.sequence, back.pose_id) == (clock, sequence % 2**32, pose_id)


def test_a_pose_id_may_be_the_last_there_is_and_none_comes_after_it(field, filters):
    listening = Listening(field, filters)
    assert listening.say(ListenerPose(pose_id=2**32 - 1, position=HERE)) == []
    assert listening.session.render_block().pose_id == 2**32 - 1
    assert listening.say(ListenerPose(pose_id=2**32 - 1, position=HERE)) == ["stale_pose"]
    for number in (2**32, 2**64, -1):
        with pytest.raises(RequestError, match="pose_id"):
            parse_client_message(f'{{"type": "listener", "pose_id": {number}, "position": [2, 2, 1.5]}}')


def test_sequences_of_live_blocks_end_where_their_numbers_do():
    last = DryBlock.parse(DryBlock("a", 2**32 - 1, np.zeros(4, np.float32)).serialize("f32"))
    assert last.sequence == 2**32 - 1
    with pytest.raises(struct.error):
        DryBlock("a", 2**32, np.zeros(4, np.float32)).serialize("f32")


def test_a_block_due_after_thirty_days_is_due_to_the_microsecond(measured):
    """Due times are measured from the origin, so that no error adds to the next."""
    block_s = SIZE / RATE
    clock = StreamClock(origin_s=1e6, block_s=block_s, lead=8)
    block = round(30 * 86_400 / block_s)
    exact_s = 10**6 + (block - 8) * SIZE / RATE
    measured("error", abs(clock.due_s(block) - exact_s), 1e-6, "s")


@given(st.integers(0, 2**33), st.floats(0, 1e6))
def test_a_stall_of_any_length_leaves_the_clock_on_its_grid(measured, block, stall_s):
    block_s = 0.01
    clock = StreamClock(origin_s=0.0, block_s=block_s, lead=8)
    now_s = clock.due_s(block) + stall_s
    clock.slip(block, now_s)
    late_s = now_s - clock.due_s(block)
    tolerance_s = 1e-8 * max(1.0, now_s)
    measured("late after it", late_s, tolerance_s, "s")
    measured("early after it", -late_s, block_s + tolerance_s, "s")
    blocks = clock.due_s(block) / block_s
    measured("off the grid", abs(blocks - round(blocks)) * block_s, tolerance_s, "s")


@given(st.lists(st.one_of(st.none(), st.integers(0, 40), st.integers(0, 2**33)), max_size=60), st.integers(1, 9))
@example([None, None, 1, 0], 1)
def test_a_window_never_opens_further_than_it_is_wide(measured, script, at_once):
    window = SendWindow(8)
    for acknowledged in script:
        if acknowledged is None:
            window.take_sequences(at_once)
        else:
            before = window.unacknowledged
            try:
                window.acknowledge(acknowledged)
            except RequestError:
                assert acknowledged >= window.sent
            assert window.unacknowledged <= before  # one that comes late takes nothing back
        measured("blocks on their way", window.unacknowledged, 8)
        assert window.unacknowledged >= 0


def test_blocks_never_sent_cannot_have_arrived(field, filters):
    listening = Listening(field, filters)
    listening.hear(3)
    assert listening.say(Acknowledge(sequence=2**32 - 1)) == ["unknown_sequence"]
    assert listening.say(Acknowledge(sequence=2)) == []
    assert listening.session.window.unacknowledged == 0


def test_minutes_of_streaming_leave_no_error_behind(measured):
    """Two minutes in the smallest blocks: 45 000 of them, many rounds of every ring."""
    engine, clip, ir = renderer(block_size=64), noise(1, 5_003), room(2)
    play(engine, clip, ir)
    first = hear(engine, 200)
    for _ in range(45_000):
        engine.process()
    clock = engine.sample_clock
    last = hear(engine, 200)
    expected = convolved(played(clip, 200 * 64), ir, 200 * 64)
    measured("error at first", error_db(first, expected), -120, "dB")
    start = clock % clip.size
    dry = np.resize(np.roll(clip, -start), 200 * 64 + ir.shape[1])
    before = np.resize(np.roll(clip, -((clock - ir.shape[1]) % clip.size)), ir.shape[1] + 200 * 64)
    expected = convolved(before, ir, before.size)[:, ir.shape[1] :]
    assert dry.size == before.size
    measured("error at last", error_db(last, expected), -120, "dB")


def test_minutes_along_a_path_at_rest_are_the_same_to_the_last(measured, filters):
    engine = renderer(filters)
    play(engine, noise(1, 3 * SIZE), path=ahead())
    first = hear(engine, 60)[:, 30 * SIZE :]
    for _ in range(12_000 - 60 + 30):
        engine.process()
    last = hear(engine, 30)
    measured("largest difference", np.abs(first - last).max(), 1e-6)


def test_a_clock_that_is_asked_for_the_past_or_the_future_answers(measured):
    clock = StreamClock(origin_s=0.0, block_s=0.01, lead=8)
    for block in (-(2**40), 0, 2**53):
        assert math.isfinite(clock.due_s(block))
    measured("between due and deadline", abs(clock.deadline_s(5) - clock.due_s(5) - 0.08), 1e-12, "s")
