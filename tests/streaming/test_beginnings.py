"""Laws of turns to begin, by a clock that stands still until it is moved."""

import heapq
import itertools

import pytest

from server.streaming.beginnings import Beginnings
from server.streaming.headroom import LEAST_PACE

AHEAD_S, PATIENCE_S, WORK_S = 0.05, 0.6, 0.03
LOOK_S = 0.011
"""Between two looks, and a little more."""


class Door:
    """Beginnings with a clock, on which work takes exactly as long as is said."""

    def __init__(self, spare_cores=1.0):
        self.now_s = 0.0
        self.is_behind = False
        self.began_s: dict[int, float] = {}
        self.gave_up_s: dict[int, float] = {}
        self._calls = []
        self._numbers = itertools.count()
        self.turns = Beginnings(
            spare_cores=spare_cores,
            most_ahead_s=AHEAD_S,
            patience_s=PATIENCE_S,
            is_behind=lambda: self.is_behind,
            call_later=lambda seconds, call: heapq.heappush(
                self._calls, (self.now_s + seconds, next(self._numbers), call)
            ),
            time_s=lambda: self.now_s,
        )

    def come(self, number, work_s=WORK_S, is_wanted=lambda: True):
        self.turns.enter(
            work_s,
            lambda: self.began_s.__setitem__(number, self.now_s),
            lambda: self.gave_up_s.__setitem__(number, self.now_s),
            is_wanted=is_wanted,
        )

    def run(self, until_s):
        while self._calls and self._calls[0][0] <= until_s:
            self.now_s, _, call = heapq.heappop(self._calls)
            call()
        self.now_s = until_s


def test_who_comes_alone_begins_at_once_whatever_it_takes():
    door = Door(spare_cores=0.0)
    door.come(0, work_s=5.0)
    assert door.began_s == {0: 0.0}


@pytest.mark.parametrize("spare", [1.0, 0.5, 0.25])
def test_all_begin_in_the_order_they_came_at_the_pace_of_what_others_leave(spare):
    door = Door(spare)
    for number in range(8):
        door.come(number, work_s=WORK_S * spare)
    door.run(2.0)
    assert list(door.began_s) == list(range(8))
    for number, began_s in door.began_s.items():
        assert began_s == pytest.approx(max(0.0, number * WORK_S - AHEAD_S), abs=LOOK_S)


def test_a_turn_comes_when_it_was_expected():
    door = Door(0.7)
    expected_s = []
    for number in range(12):
        expected_s.append(door.turns.turn_in_s)
        door.come(number)
    door.run(2.0)
    for number, began_s in door.began_s.items():
        assert began_s == pytest.approx(max(0.0, expected_s[number] - AHEAD_S), abs=LOOK_S)


def test_nobody_begins_while_first_work_waits_and_whoever_waits_too_long_is_told():
    door = Door()
    door.is_behind = True
    for number in range(3):
        door.come(number)
    door.run(PATIENCE_S - LOOK_S)
    assert not door.began_s
    assert not door.gave_up_s
    door.run(PATIENCE_S + LOOK_S)
    assert sorted(door.gave_up_s) == [0, 1, 2]
    door.is_behind = False
    door.come(3)
    assert door.began_s == {3: door.now_s}, "those who gave up take no time"


def test_who_has_left_takes_no_time_of_others():
    door = Door()
    for number in range(2):
        door.come(number, work_s=0.1, is_wanted=lambda: False)
    door.come(2)
    assert list(door.gave_up_s) == [0, 1]
    assert door.began_s == {2: 0.0}


def test_a_full_server_lets_streams_begin_slowly_but_not_never():
    door = Door(spare_cores=0.0)
    door.come(0, work_s=0.04)
    door.come(1, work_s=0.04)
    door.run(1.0)
    assert door.began_s[1] == pytest.approx(0.04 / LEAST_PACE - AHEAD_S, abs=LOOK_S)
