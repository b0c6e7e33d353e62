import pytest

from server.core.errors import RequestError
from server.streaming.pacing import SendWindow, StreamClock


def test_blocks_are_due_a_lead_before_they_play():
    clock = StreamClock(origin_s=100.0, block_s=0.01, lead=8)
    assert clock.due_s(8) == 100.0
    assert clock.deadline_s(8) == pytest.approx(100.08)
    assert clock.ahead_s(8, 100.0) == pytest.approx(0.08)


def test_due_times_hang_from_the_origin_however_long_the_stream():
    clock = StreamClock(origin_s=5.0, block_s=256 / 24_000, lead=8)
    blocks = 10 * 60 * 24_000 // 256
    assert clock.due_s(blocks + 8) == pytest.approx(5.0 + 600.0, abs=1e-9)


def test_after_a_stall_the_next_block_is_due_within_a_block_and_the_rest_follow_at_their_pace():
    clock = StreamClock(origin_s=0.0, block_s=0.01, lead=4)
    clock.slip(10, now_s=7.003)
    # A whole number of blocks after the origin, as before.
    assert clock.due_s(10) == pytest.approx(7.01)
    assert clock.due_s(11) == pytest.approx(7.02)


def test_a_window_closes_when_full_and_opens_with_an_acknowledgement():
    window = SendWindow(3)
    assert list(window.take_sequences(2)) == [0, 1]
    assert list(window.take_sequences(2)) == [2]
    assert list(window.take_sequences(2)) == []
    window.acknowledge(1)
    assert window.unacknowledged == 1
    assert list(window.take_sequences(2)) == [3, 4]


def test_acknowledgements_are_cumulative_and_never_go_back():
    window = SendWindow(8)
    window.take_sequences(5)
    window.acknowledge(4)
    window.acknowledge(2)
    assert window.unacknowledged == 0


def test_a_block_that_was_not_sent_cannot_have_arrived():
    window = SendWindow(8)
    with pytest.raises(RequestError) as refusal:
        window.acknowledge(0)
    assert refusal.value.code == "unknown_sequence"


def test_a_window_may_begin_with_a_later_block():
    window = SendWindow(3, first=40)
    assert list(window.take_sequences(5)) == [40, 41, 42]
    window.acknowledge(12)
    assert window.is_full
    window.acknowledge(41)
    assert (window.unacknowledged, window.sent, window.next_sequence) == (1, 3, 43)
    with pytest.raises(RequestError):
        window.acknowledge(43)
