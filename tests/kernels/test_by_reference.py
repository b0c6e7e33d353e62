"""Named tuples handed to compiled code by reference."""

from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy.testing import assert_array_equal

from server.kernels.by_reference import Reference, reference_at


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


def test_a_field_that_is_not_there_does_not_compile():
    @numba.njit
    def nothing(of):
        return of.nothing

    with pytest.raises(TypingError):
        nothing(Reference(things()))
