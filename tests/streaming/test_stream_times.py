"""How long responses are waited for, against the moments at which they were called for and came."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.streaming.stream_times import _MOST_WAITING, PoseTimes, ResponseWait


@given(st.lists(st.tuples(st.sampled_from(["calls", "rests", "comes", "restarts", "asks"]), st.integers(1, 9))))
def test_the_longest_wait_is_that_of_the_answers_and_of_what_still_waits(steps):
    wait, now_s, since_s, ended_s = ResponseWait(), 0.0, None, []
    for step, passed_s in steps:
        now_s += passed_s
        match step:
            case "calls":
                wait.note(True, now_s)
                since_s = now_s if since_s is None else since_s
            case "rests":
                wait.note(False, now_s)
                since_s = None
            case "comes":
                wait.end(now_s)
                ended_s += [] if since_s is None else [now_s - since_s]
                since_s = None
            case "restarts":
                wait.restart(now_s)
                ended_s, since_s = [], None if since_s is None else now_s
            case "asks":
                so_far_s = [] if since_s is None else [now_s - since_s]
                assert wait.take_longest_s(now_s) == max([*ended_s, *so_far_s], default=None)
                ended_s = []
        assert wait.since_s == since_s


def test_a_pose_takes_effect_with_the_first_block_that_has_it_or_a_newer_one():
    times = PoseTimes()
    for pose_id, now_s in ((1, 0.0), (2, 0.1), (3, 0.4)):
        times.arrive(pose_id, now_s)
    times.take_effect(2, 0.5)
    assert times.durations.count == 2
    assert times.durations.total_s == pytest.approx(0.5 + 0.4)
    times.take_effect(3, 0.6)
    assert times.durations.count == 3


def test_poses_that_never_take_effect_count_with_their_wait_so_far():
    times, every_s = PoseTimes(), 1 / 32
    for number in range(2 * _MOST_WAITING):
        times.arrive(number, number * every_s)
    assert times.durations.count == _MOST_WAITING
    assert times.durations.quantiles_s(0.01) == [pytest.approx(_MOST_WAITING * every_s, rel=0.03)]
    assert len(times._waiting) == _MOST_WAITING
