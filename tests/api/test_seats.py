"""Silent connections push each other out, and never one that does something."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.api.connection_limits import ConnectionLimits
from server.api.seats import Seats, address_key
from server.api.settings import Settings


def seats(total, per_address, reserve=0):
    limits = ConnectionLimits.of(Settings(max_connections=total, max_connections_per_address=per_address))
    return Seats(dataclasses.replace(limits, reserve_connections=reserve))


class Door:
    """Takes seats and writes down whose were claimed."""

    def __init__(self, *counts):
        self.seats = seats(*counts)
        self.claimed = []

    def take(self, name, address="192.0.2.1"):
        return self.seats.take(address, lambda: self.claimed.append(name))


def test_the_newcomer_of_an_address_gets_the_seat_that_was_idle_for_longest():
    door = Door(10, 3)
    first, _, _ = (door.take(name) for name in "abc")
    first.use()
    first.rest()
    assert door.take("d") is not None
    assert door.claimed == ["b"]
    assert len(door.seats) == 3


def test_a_seat_in_use_is_nobody_elses():
    door = Door(10, 2)
    for name in "ab":
        door.take(name).use()
    assert door.take("c") is None
    assert door.claimed == []


def test_one_address_never_takes_all():
    door = Door(4, 3)
    for name in "abcdef":
        taken = door.take(name)
        if taken is not None:
            taken.use()
    assert door.take("other", "192.0.2.2") is not None


def test_where_all_are_taken_the_longest_idle_of_any_address_goes():
    door = Door(4, 3)
    for number, name in enumerate("abcd"):
        door.take(name, f"192.0.2.{number}")
    assert door.take("e", "192.0.2.9") is not None
    assert door.claimed == ["a"]


def test_where_all_are_in_use_there_are_a_few_in_reserve():
    door = Door(2, 2, 2)
    used = [door.take(name) for name in "ab"]
    for seat in used:
        seat.use()
    reserve = [door.take(name) for name in "cd"]
    assert [seat.is_reserve for seat in (*used, *reserve)] == [False, False, True, True]
    assert door.take("e").is_reserve  # silent ones push each other out here, too
    assert door.claimed == ["c"]
    used[0].leave()
    assert not door.take("f").is_reserve


def test_a_seat_that_was_left_is_free_once():
    door = Door(2, 2)
    seat = door.take("a")
    seat.leave()
    seat.leave()
    seat.use()
    seat.rest()
    assert len(door.seats) == 0
    assert [door.take(name) is not None for name in "bcd"] == [True, True, True]
    assert door.claimed == ["b"]


@pytest.mark.parametrize(
    ("address", "key"),
    [
        ("192.0.2.1", "192.0.2.1"),
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("2001:db8::1:2:3:4", "2001:db8::/64"),
        ("2001:db8:0:0:ffff::1", "2001:db8::/64"),
        ("2001:db8:0:1::1", "2001:db8:0:1::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", ""),
    ],
)
def test_an_ipv6_network_is_one_address(address, key):
    assert address_key(address) == key


ACTIONS = st.lists(
    st.tuples(st.sampled_from(["take", "use", "rest", "leave"]), st.integers(0, 30), st.integers(0, 3)), max_size=80
)


@given(ACTIONS)
def test_limits_hold_and_seats_in_use_are_never_claimed(actions):
    """Against a model: who sits where, and whether anything is under way there."""
    door = seats(6, 3, 2)
    sitting, in_use, taken = {}, set(), []

    def end(number):
        assert number not in in_use
        del sitting[number]

    for action, which, address in actions:
        if action == "take":
            number = len(taken)
            seat = door.take(str(address), lambda number=number: end(number))
            taken.append(seat)
            if seat is not None:
                sitting[number] = (address, seat)
        elif sitting:
            number = list(sitting)[which % len(sitting)]
            _, seat = sitting[number]
            getattr(seat, action)()
            {"use": in_use.add, "rest": in_use.discard, "leave": in_use.discard}[action](number)
            if action == "leave":
                del sitting[number]
        regular = [each for each, seat in sitting.values() if not seat.is_reserve]
        assert len(regular) <= 6
        assert len(sitting) - len(regular) <= 2
        assert all(regular.count(each) <= 3 for each in regular)
        assert len(door) == len(sitting)
