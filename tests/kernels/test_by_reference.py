"""Named tuples handed to compiled code by reference."""

from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy.testing import assert_array_equal

from server.kernels.by_reference import Reference, reference_at, value_of


class Things(NamedTuple):
    count: int
    table: np.ndarray
    share: float
    order: np.ndarray


def things(share=-0.0):
    return Things(-(2**62), np.arange(6, dtype=np.float32).reshape(2, 3), share, np.array([5, -7]))


@numba.njit
def turn(of):
    """Reads and writes every kind of field."""
    of.table[1, 2] += np.float32(of.order[1])
    of.order[0] = of.table.shape[0] * 10 + of.table.shape[1]
    return of.count, of.share, of.table[1, 2], of.order.size


def test_reference_has_the_fields_of_the_tuple_in_compiled_code():
    own = things(share=5e-324)
    assert turn(Reference(own)) == (-(2**62), 5e-324, -2.0, 2)
    assert_array_equal(own.table, [[0, 1, 2], [3, 4, -2]])
    assert own.order.tolist() == [23, -7]


@pytest.mark.parametrize("share", [0.0, -0.0, np.inf, -np.inf, np.nan, 5e-324])
def test_reference_hands_on_floats_to_the_bit(share):
    found = turn(Reference(things(share)))[1]
    assert np.float64(found).view(np.int64) == np.float64(share).view(np.int64)


def test_reference_has_the_fields_of_the_tuple_in_python():
    own = things()
    reference = Reference(own)
    assert reference.table is own.table
    assert reference.count == own.count
    with pytest.raises(AttributeError):
        reference.nothing  # noqa: B018


def test_reference_keeps_what_it_refers_to_alive():
    reference = Reference(things())
    others = [np.full(6, 9, np.float32) for _ in range(100)]
    assert turn(reference)[2] == -2.0
    assert all((other == 9).all() for other in others)


def test_reference_at_an_address_is_that_reference():
    @numba.njit
    def turn_at(address, like):
        return turn(reference_at(address, like))

    one, other = things(share=0.25), things(share=0.5)
    like, reference = Reference(one), Reference(other)
    assert turn_at(reference.address, like) == (-(2**62), 0.5, -2.0, 2)
    assert one.order.tolist() == [5, -7]
    assert other.order.tolist() == [23, -7]


class Pair(NamedTuple):
    first: int
    second: int


class Nested(NamedTuple):
    """A flag before other fields, tuples of one kind and of several, one in another."""

    flag: bool
    pair: Pair
    of: Things
    last: float


@pytest.mark.parametrize("flag", [False, True])
def test_a_tuple_in_a_tuple_has_its_fields(flag):
    @numba.njit
    def read(nested):
        turn_of = nested.of
        turn_of.order[0] = nested.pair.second
        return nested.flag, nested.pair.first, turn_of.count, turn_of.share, turn_of.table[0, 2], nested.last

    own = Nested(flag, Pair(3, -4), things(share=0.5), 0.125)
    assert read(Reference(own)) == (flag, 3, -(2**62), 0.5, 2.0, 0.125)
    assert own.of.order.tolist() == [-4, -7]


@pytest.mark.parametrize("flag", [False, True])
def test_value_of_a_reference_is_the_tuple_as_it_is_now(flag):
    @numba.njit
    def take(nested, times):
        total = 0.0
        for _ in range(times):
            taken, pair, of, last = value_of(nested)
            of.table[0, 0] += np.float32(1)
            total += taken * pair.first + of.share + last
        return total

    own = Nested(flag, Pair(3, -4), things(share=0.5), 0.125)
    reference = Reference(own)
    assert take(reference, 1000) == 1000 * (3 * flag + 0.625)
    assert own.of.table[0, 0] == 1000
    with pytest.raises(TypingError):
        take(own, 1)


def test_a_field_that_is_not_there_does_not_compile():
    @numba.njit
    def nothing(of):
        return of.nothing

    with pytest.raises(TypingError):
        nothing(Reference(things()))
