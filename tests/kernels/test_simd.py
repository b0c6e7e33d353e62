"""Every intrinsic of vectors against NumPy and exact fractions, in four, eight and sixteen lanes."""

import os
import subprocess
import sys
from fractions import Fraction
from functools import cache
from itertools import product
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import carray
from numba.core.errors import TypingError
from numpy.testing import assert_allclose, assert_array_equal

from server.kernels import simd

ALL_LANES = (4, 8, 16)
EACH = pytest.mark.parametrize("lanes", ALL_LANES)
TINIEST, SMALLEST_NORMAL, LARGEST = (np.float32(value) for value in (1e-45, 2.0**-126, 3.4028235e38))
EDGES = np.array(
    [0.0, -0.0, 1.0, -1.0, TINIEST, -TINIEST, 1e-40, SMALLEST_NORMAL, LARGEST, -LARGEST, np.inf, -np.inf, np.nan, 0.1],
    np.float32,
)
PAIRS = np.array(list(product(EDGES, EDGES)), np.float32).T
OTHERS = np.random.default_rng(0).permutation(PAIRS[0])


def bits_of(values):
    return np.asarray(values, np.float32).view(np.uint32)


def assert_same(found, expected):
    """To the bit, zeros' signs too; what is not a number is any such."""
    expected = np.asarray(expected, np.float32)
    assert_array_equal(np.isnan(found), np.isnan(expected))
    known = ~np.isnan(expected)
    assert_array_equal(bits_of(found)[known], bits_of(expected)[known])


def padded(values, lanes):
    """As whole vectors."""
    return np.resize(np.asarray(values, np.float32), -(-np.size(values) // lanes) * lanes)


RESULTS = (
    "add",
    "subtract",
    "multiply",
    "divide",
    "multiply_add",
    "multiply_subtract",
    "at_least",
    "choose_below",
    "rotate",
    "with_first",
    "swap_halves",
    "square_root",
    "exponential",
    "cosine",
    "sine",
    "logarithm",
    "first_halves",
    "second_halves",
    "mix_bits",
)


@cache
def lane_by_lane(lanes):
    """Of a, b, c, d what every intrinsic makes, one row each of `out`, and one flag a vector."""
    load = simd.lanes(lanes).load

    @numba.njit(error_model="numpy")
    def run(a, b, c, d, out, flags):
        size, to = a.size, out.ctypes.data
        for n in range(0, size, lanes):
            w, x = load(a.ctypes.data, n), load(b.ctypes.data, n)
            y, z = load(c.ctypes.data, n), load(d.ctypes.data, n)
            simd.store(to, n, simd.add(w, x))
            simd.store(to, size + n, simd.subtract(w, x))
            simd.store(to, 2 * size + n, simd.multiply(w, x))
            simd.store(to, 3 * size + n, simd.divide(w, x))
            simd.store(to, 4 * size + n, simd.multiply_add(w, x, y))
            simd.store(to, 5 * size + n, simd.multiply_subtract(w, x, y))
            simd.store(to, 6 * size + n, simd.at_least(w, x))
            simd.store(to, 7 * size + n, simd.choose_below(w, x, y, z))
            simd.store(to, 8 * size + n, simd.rotate(w))
            simd.store(to, 9 * size + n, simd.with_first(w, x))
            simd.store(to, 10 * size + n, simd.swap_halves(w))
            simd.store(to, 11 * size + n, simd.square_root(w))
            simd.store(to, 12 * size + n, simd.exponential(w))
            cosine, sine = simd.cosine_sine(w)
            simd.store(to, 13 * size + n, cosine)
            simd.store(to, 14 * size + n, sine)
            simd.store(to, 15 * size + n, simd.logarithm(w))
            simd.store(to, 16 * size + n, simd.first_halves(w, x))
            simd.store(to, 17 * size + n, simd.second_halves(w, x))
            simd.store(to, 18 * size + n, simd.mix_bits(w, x))
            flags[n // lanes] = simd.any_above(w, x)

    return run


def results(lanes, a, b=0.0, c=0.0, d=0.0):
    """Arguments in whole vectors, then what every intrinsic makes of them, by name."""
    given = np.broadcast_arrays(*(np.asarray(values, np.float32) for values in (a, b, c, d)))
    given = [padded(values, lanes) for values in given]
    out, flags = np.empty((len(RESULTS), given[0].size), np.float32), np.empty(given[0].size // lanes, np.bool_)
    lane_by_lane(lanes)(*given, out, flags)
    return *given, dict(zip(RESULTS, out, strict=True)) | {"any_above": flags}


@cache
def memory(lanes):
    made = simd.lanes(lanes)
    load, load_broadcast, broadcast = made.load, made.load_broadcast, made.broadcast
    load_twice, load_opposed = made.load_twice, made.load_opposed

    @numba.njit
    def run(values, at, one, out):
        source, to = values.ctypes.data, out.ctypes.data
        simd.store(to, 0, load(source, at))
        simd.store(to, lanes, load_broadcast(source, at))
        simd.store(to, 2 * lanes, broadcast(one))
        simd.store(to, 3 * lanes, load_twice(source, at))
        simd.store(to, 4 * lanes, load_opposed(source, at))
        like = broadcast(one)
        simd.store(to, 5 * lanes, simd.load_as(like, source, at))
        simd.store(to, 6 * lanes, simd.load_broadcast_as(like, source, at))
        simd.store(to, 7 * lanes, simd.broadcast_as(broadcast(np.float32(0)), one))

    return run


MADE = (
    "load",
    "load_broadcast",
    "broadcast",
    "load_twice",
    "load_opposed",
    "load_as",
    "load_broadcast_as",
    "broadcast_as",
)


def made_at(lanes, values, at, one=0.0):
    out = np.empty((len(MADE), lanes), np.float32)
    memory(lanes)(values, at, np.float32(one), out)
    return dict(zip(MADE, out, strict=True))


def odd_length(lanes):
    """More than two vectors, with every edge."""
    return np.resize(EDGES, 2 * lanes + 13)


# What makes vectors.


@EACH
def test_load_takes_as_many_floats_from_any_index(lanes):
    values = odd_length(lanes)
    for at in (0, 1, 3, lanes + 1, values.size - lanes):
        assert_same(made_at(lanes, values, at)["load"], values[at : at + lanes])
    assert_same(made_at(lanes, values[5:], -5)["load"], values[:lanes])


@EACH
def test_load_broadcast_repeats_one_float_of_memory(lanes):
    values = odd_length(lanes)
    for at in range(EDGES.size):
        assert_same(made_at(lanes, values, at)["load_broadcast"], np.full(lanes, values[at]))


@EACH
def test_broadcast_repeats_a_number(lanes):
    for number in EDGES:
        assert_same(made_at(lanes, odd_length(lanes), 0, number)["broadcast"], np.full(lanes, number))


@EACH
def test_load_twice_has_half_a_vector_in_either_half(lanes):
    values = odd_length(lanes)
    for at in (0, 1, values.size - lanes):
        assert_same(made_at(lanes, values, at)["load_twice"], np.tile(values[at : at + lanes // 2], 2))


@EACH
def test_load_opposed_has_half_a_vector_after_its_negatives(lanes):
    values = odd_length(lanes)
    for at in (0, 1, values.size - lanes):
        half = values[at : at + lanes // 2]
        assert_same(made_at(lanes, values, at)["load_opposed"], np.concatenate([-half, half]))


@EACH
def test_store_writes_a_vector_and_nothing_beside_it(lanes):
    load = simd.lanes(lanes).load

    @numba.njit
    def copy(source, to, at):
        simd.store(to.ctypes.data, at, load(source.ctypes.data, at))

    source = odd_length(lanes)
    for at in (0, 1, source.size - lanes):
        to = np.full(source.size, 7, np.float32)
        copy(source, to, at)
        assert_same(to[at : at + lanes], source[at : at + lanes])
        assert (np.delete(to, slice(at, at + lanes)) == 7).all()


def test_lanes_of_one_count_are_one_type_and_those_of_another_are_another():
    assert simd.lanes(8) is simd.lanes(8)
    assert simd.Vector(8) == simd.Vector(8)
    assert simd.Vector(8) != simd.Vector(16)
    narrow, wide = simd.lanes(4).broadcast, simd.lanes(8).broadcast

    @numba.njit
    def mixed(number):
        return simd.any_above(simd.add(narrow(number), wide(number)), narrow(number))

    with pytest.raises(TypingError):
        mixed(np.float32(1))


@EACH
def test_load_as_is_load_of_as_many_lanes(lanes):
    values = odd_length(lanes)
    for at in (0, 3, values.size - lanes):
        assert_same(made_at(lanes, values, at, LARGEST)["load_as"], values[at : at + lanes])


@EACH
def test_load_broadcast_as_is_load_broadcast_of_as_many_lanes(lanes):
    values = odd_length(lanes)
    for at in range(EDGES.size):
        assert_same(made_at(lanes, values, at, LARGEST)["load_broadcast_as"], np.full(lanes, values[at]))


@EACH
def test_broadcast_as_is_broadcast_of_as_many_lanes(lanes):
    for number in EDGES:
        assert_same(made_at(lanes, odd_length(lanes), 0, number)["broadcast_as"], np.full(lanes, number))


# What reads memory otherwise.


def test_pointer_is_an_address_as_carray_takes_it():
    @numba.njit
    def element(address, index):
        return carray(simd.pointer(address), (3,), np.float64)[index]

    values = np.array([1.5, np.inf, -2.5])
    assert [element(values.ctypes.data, index) for index in range(3)] == values.tolist()


def test_prefetch_reads_nothing_and_may_be_given_any_address():
    @numba.njit
    def fetch(address):
        simd.prefetch(address)
        return address

    values = np.arange(3.0)
    for address in (0, 1, -1, values.ctypes.data, values.ctypes.data + 3):
        assert fetch(address) == address
    assert_array_equal(values, [0, 1, 2])
    assert "prefetch" in "".join(fetch.inspect_llvm().values())


def test_load_int_reads_sixty_four_bits():
    @numba.njit
    def read(values, index):
        return simd.load_int(values.ctypes.data, index)

    values = np.array([0, -1, 2**63 - 1, -(2**63), 2**31])
    assert [read(values, index) for index in range(values.size)] == values.tolist()
    assert read(values[2:], -1) == -1
    after_four_bytes = np.frombuffer(b"\0" * 4 + values.tobytes() + b"\0" * 4, np.int64)
    assert read(after_four_bytes.view(np.int32)[1:], 2) == 2**63 - 1


@EACH
def test_load_shorts_reads_integers_of_sixteen_bits_as_floats(lanes):
    load_shorts = simd.lanes(lanes).load_shorts

    @numba.njit
    def read(values, index, found):
        simd.store(found.ctypes.data, 0, load_shorts(values.ctypes.data, index))

    values = np.resize(np.array([0, -1, 2**15 - 1, -(2**15), 256, -256, 77, 3, 5], np.int16), lanes + 1)
    found = np.zeros(lanes, np.float32)
    for index in (0, 1):
        read(values, index, found)
        assert found.tolist() == values[index : index + lanes].tolist()


def test_load_short_int_reads_thirty_two_bits_with_their_sign():
    @numba.njit
    def read(values, index):
        return simd.load_short_int(values.ctypes.data, index)

    values = np.array([0, -1, 2**31 - 1, -(2**31), 65536], np.int32)
    assert [read(values, index) for index in range(values.size)] == values.tolist()
    assert read(values[2:], -1) == -1


# Arithmetic, as IEEE 754 has it.


def assert_arithmetic(lanes, name, expected):
    a, b, _, _, found = results(lanes, *PAIRS)
    with np.errstate(all="ignore"):
        assert_same(found[name], expected(a, b))


@EACH
def test_add_is_that_of_numpy_at_every_edge(lanes):
    assert_arithmetic(lanes, "add", np.add)


@EACH
def test_subtract_is_that_of_numpy_at_every_edge(lanes):
    assert_arithmetic(lanes, "subtract", np.subtract)


@EACH
def test_multiply_is_that_of_numpy_at_every_edge(lanes):
    assert_arithmetic(lanes, "multiply", np.multiply)


@EACH
def test_divide_is_that_of_numpy_at_every_edge(lanes):
    assert_arithmetic(lanes, "divide", np.divide)


def rounded(exact):
    """The single nearest to a fraction, of two the even one."""
    near = np.float32(float(exact))
    around = [np.nextafter(near, np.float32(-np.inf)), near, np.nextafter(near, np.float32(np.inf))]
    return min(around, key=lambda value: (abs(Fraction(float(value)) - exact), int(bits_of(value)) & 1))


def fused(a, b, c):
    """a b + c of numbers, exact and then rounded."""
    exact = [
        rounded(Fraction(float(x)) * Fraction(float(y)) + Fraction(float(z))) for x, y, z in zip(a, b, c, strict=True)
    ]
    return np.array(exact, np.float32)


def three_numbers():
    """That lose what is seen if the product is rounded, whose sum is a tie, that underflow, and others."""
    some = np.float32(2) ** np.random.default_rng(1).integers(-20, 20, (3, 200)).astype(np.float32)
    some *= np.random.default_rng(2).standard_normal((3, 200)).astype(np.float32)
    special = [
        (1 + 2**-12, 1 + 2**-12, -(1 + 2**-11)),
        (1 + 2**-23, 1 - 2**-24, -1.0),
        (2.0**-75, 2.0**-75, TINIEST),
        (2.0**-75, 2.0**-75, 0.5),
        (SMALLEST_NORMAL, 0.5, -TINIEST),
    ]
    return np.concatenate([some, np.array(special, np.float32).T], axis=1)


@EACH
def test_multiply_add_rounds_once(lanes):
    a, b, c, _, found = results(lanes, *three_numbers())
    expected = fused(a, b, c)
    assert_array_equal(found["multiply_add"], expected)
    assert np.any(expected != a * b + c)


@EACH
def test_multiply_subtract_takes_the_product_away_and_rounds_once(lanes):
    a, b, c, _, found = results(lanes, *three_numbers())
    expected = fused(-a, b, c)
    assert_array_equal(found["multiply_subtract"], expected)
    assert np.any(expected != c - a * b)


@EACH
@pytest.mark.parametrize("name", ["multiply_add", "multiply_subtract"])
def test_multiply_add_of_what_is_infinite_or_no_number_is_that_of_numpy(lanes, name):
    a, b, c, _, found = results(lanes, *PAIRS, OTHERS)
    beyond = ~(np.isfinite(a) & np.isfinite(b) & np.isfinite(c))
    with np.errstate(all="ignore"):
        products = a.astype(np.float64) * b
        expected = c + products if name == "multiply_add" else c - products
    assert_same(found[name][beyond], expected[beyond])


@EACH
def test_square_root_is_that_of_numpy(lanes):
    values = np.concatenate([EDGES, np.geomspace(1e-45, 3e38, 1_001)])
    a, _, _, _, found = results(lanes, values)
    with np.errstate(invalid="ignore"):
        assert_same(found["square_root"], np.sqrt(a))


# Choices.


@EACH
def test_at_least_is_the_greater_and_leaves_what_is_no_number(lanes):
    a, limit, _, _, found = results(lanes, *PAIRS)
    assert_same(found["at_least"], np.where(a < limit, limit, a))


@EACH
def test_choose_below_takes_the_first_where_less_and_the_other_of_what_is_no_number(lanes):
    a, limit, below, otherwise, found = results(lanes, *PAIRS, OTHERS, OTHERS[::-1])
    assert_same(found["choose_below"], np.where(a < limit, below, otherwise))


@EACH
def test_any_above_sees_each_lane_and_no_number_above_none(lanes):
    a = np.zeros((2 * lanes + 1, lanes), np.float32)
    a[np.arange(lanes), np.arange(lanes)] = TINIEST
    a[np.arange(lanes, 2 * lanes), np.arange(lanes)] = np.nan
    *_, found = results(lanes, a.ravel(), 0.0)
    assert found["any_above"].tolist() == [True] * lanes + [False] * (lanes + 1)
    a, limit, _, _, found = results(lanes, *PAIRS)
    assert_array_equal(found["any_above"], (a > limit).reshape(-1, lanes).any(axis=1))


# Lanes that change places.


@EACH
def test_rotate_puts_the_last_first(lanes):
    a, _, _, _, found = results(lanes, odd_length(lanes))
    assert_same(found["rotate"], np.roll(a.reshape(-1, lanes), 1, axis=1).ravel())


@EACH
def test_with_first_takes_one_lane_of_the_other(lanes):
    first, a, _, _, found = results(lanes, *PAIRS)
    expected = a.copy()
    expected[::lanes] = first[::lanes]
    assert_same(found["with_first"], expected)


@EACH
def test_swap_halves_puts_the_second_first(lanes):
    a, _, _, _, found = results(lanes, odd_length(lanes))
    assert_same(found["swap_halves"], np.roll(a.reshape(-1, lanes), lanes // 2, axis=1).ravel())


@EACH
def test_first_halves_and_second_halves_are_those_of_two_vectors(lanes):
    a, b, _, _, found = results(lanes, odd_length(lanes), odd_length(lanes)[::-1])
    (a, b), half = (values.reshape(-1, lanes) for values in (a, b)), lanes // 2
    assert_same(found["first_halves"], np.hstack([a[:, :half], b[:, :half]]).ravel())
    assert_same(found["second_halves"], np.hstack([a[:, half:], b[:, half:]]).ravel())


def test_second_halves_and_first_halves_give_two_vectors_back():
    a, b, _, _, found = results(8, np.arange(8), np.arange(8, 16))
    *_, back = results(8, found["first_halves"], found["second_halves"])
    assert_same(back["first_halves"], [*a[:4], *a[4:]])
    assert_same(back["second_halves"], [*b[:4], *b[4:]])


@pytest.mark.parametrize("lanes", [4, 8])
def test_join_puts_one_vector_after_the_other(lanes):
    load = simd.lanes(lanes).load

    @numba.njit
    def run(values, out):
        x = values.ctypes.data
        simd.store(out.ctypes.data, 0, simd.join(load(x, lanes), load(x, 0)))

    values, out = EDGES[: 2 * lanes].copy() if lanes == 4 else np.resize(EDGES, 16), np.empty(2 * lanes, np.float32)
    run(values, out)
    assert_same(out, np.roll(values, lanes))


@EACH
def test_mix_bits_multiplies_and_folds_sixty_four_bits_of_each_two_lanes(lanes):
    rng = np.random.default_rng(4)
    given = rng.integers(0, 2**32, (2, 6 * lanes), np.uint32)
    given &= ~np.uint32(1 << 23)  # finite, so that no bit of what is no number is lost on the way
    a, b, _, _, found = results(lanes, *given.view(np.float32))
    digest, words = a.view(np.uint64), b.view(np.uint64)
    expected = (digest ^ words) * np.uint64(simd.DIGEST_FACTOR)
    assert_array_equal(found["mix_bits"].view(np.uint64), expected ^ expected >> np.uint64(32))


def of_rows(lanes, rows, body):
    """A compiled function of (values, out) from text, since a tuple of so many is written out."""
    source = "def run(values, out):\n    x, y = values.ctypes.data, out.ctypes.data\n"
    source += f"    rows = ({', '.join(f'load(x, {lanes * row})' for row in range(rows))},)\n{body}"
    scope = {
        "load": simd.lanes(lanes).load,
        "store": simd.store,
        "transpose": simd.transpose,
        "sum_each": simd.sum_each,
    }
    exec(source, scope)
    return numba.njit(scope["run"])


@EACH
def test_transpose_makes_columns_of_rows(lanes):
    body = "    columns = transpose(rows)\n" + "".join(
        f"    store(y, {lanes * column}, columns[{column}])\n" for column in range(lanes)
    )
    values = np.arange(lanes**2, dtype=np.float32).reshape(lanes, lanes)
    values[0, 1], values[1, 0], values[2, 3] = np.nan, -0.0, TINIEST
    out = np.empty_like(values)
    of_rows(lanes, lanes, body)(values, out)
    assert_same(out, values.T)


def test_transpose_of_fewer_rows_than_lanes_is_one_of_each_group():
    body = "    columns = transpose(rows)\n" + "".join(
        f"    store(y, {16 * column}, columns[{column}])\n" for column in range(8)
    )
    values = np.random.default_rng(5).standard_normal((8, 2, 8), dtype=np.float32)
    out = np.empty_like(values)
    of_rows(16, 8, body)(values, out)
    assert_same(out, values.transpose(2, 1, 0))


@EACH
def test_sum_each_has_the_sum_of_every_row(lanes):
    run = of_rows(lanes, lanes // 2, "    store(y, 0, sum_each(rows))\n")
    values = np.random.default_rng(3).integers(-1000, 1000, (lanes // 2, lanes)).astype(np.float32)
    out = np.empty(lanes // 2, np.float32)
    run(values, out)
    assert_array_equal(out, values.sum(axis=1))  # of whole numbers, so in any order
    values[:, 0] = np.resize([TINIEST, np.inf, np.nan], lanes // 2)
    values[0, 1:] = TINIEST
    run(values, out)
    with np.errstate(invalid="ignore"):
        assert_same(out, values.sum(axis=1))


@pytest.mark.parametrize("function", [simd.transpose, simd.sum_each])
def test_transpose_and_sums_take_no_other_number_of_rows(function):
    load = simd.lanes(8).load

    @numba.njit
    def three(values):
        x = values.ctypes.data
        rows = load(x, 0), load(x, 8), load(x, 16)
        return function(rows) is None

    with pytest.raises(TypingError):
        three(np.zeros(24, np.float32))


# Functions.


@EACH
def test_exponential_is_right_to_the_last_digits(lanes):
    a, _, _, _, found = results(lanes, np.linspace(-87, 88, 100_003))
    assert_allclose(found["exponential"], np.exp(a.astype(np.float64)), rtol=3e-7)


@EACH
def test_exponential_of_anything_is_finite_and_of_nothing_nothing(lanes):
    values = [-np.inf, np.inf, 1e30, -1e30, np.nan, 0.0, -0.0, TINIEST, -LARGEST, -87.0, 88.0]
    *_, found = results(lanes, values)
    exponentials = found["exponential"][: len(values)]
    assert np.isfinite(np.delete(exponentials, 4)).all()
    assert np.isnan(exponentials[4])
    assert exponentials[0] == exponentials[3] == exponentials[9] < 1e-37
    assert exponentials[1] == exponentials[2] == exponentials[10] > 1e38
    assert (exponentials[5:8] == 1).all()


@EACH
def test_logarithm_is_right_to_the_last_digits(lanes):
    a, _, _, _, found = results(lanes, np.exp(np.linspace(-87, 88, 100_003)))
    expected = np.log(a.astype(np.float64))
    assert_allclose(found["logarithm"], expected, rtol=2e-7, atol=1e-7)
    near_one = np.linspace(0.7, 1.5, 100_003)
    a, _, _, _, found = results(lanes, near_one)
    assert_allclose(found["logarithm"], np.log(a.astype(np.float64)), rtol=2e-7, atol=1e-9)


@EACH
def test_logarithm_of_nothing_is_that_of_the_smallest_number(lanes):
    values = [0.0, -0.0, -1.0, -np.inf, TINIEST, SMALLEST_NORMAL, 1.0, np.nan]
    *_, found = results(lanes, values)
    logarithms = found["logarithm"][: len(values)]
    assert_allclose(logarithms[:6], np.log(np.float64(SMALLEST_NORMAL)), rtol=2e-7)
    assert logarithms[6] == 0
    assert np.isnan(logarithms[7])


@EACH
def test_cosine_sine_are_right_for_hundreds_of_turns(lanes):
    a, _, _, _, found = results(lanes, np.linspace(-1000, 1000, 100_003))
    assert_allclose(found["cosine"], np.cos(a.astype(np.float64)), atol=3e-7)
    assert_allclose(found["sine"], np.sin(a.astype(np.float64)), atol=3e-7)


@EACH
def test_cosine_sine_of_next_to_nothing_and_of_no_number(lanes):
    values = [0.0, -0.0, TINIEST, -1e-40, np.nan, np.inf, -np.inf]
    *_, found = results(lanes, values)
    assert (found["cosine"][:4] == 1).all()
    assert_same(found["sine"][:4], values[:4])
    for name in ("cosine", "sine"):
        assert np.isnan(found[name][4:7]).all()


# Other processors.

ON_ANOTHER = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
import test_simd
rng = np.random.default_rng(4)
given = (rng.standard_normal((4, 480)) * 10.0 ** rng.integers(-30, 30, (4, 480))).astype(np.float32)
made = [test_simd.results(lanes, *given)[-1] for lanes in test_simd.ALL_LANES]
np.save(sys.argv[2], np.stack([each[name] for each in made for name in test_simd.RESULTS]))
"""


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="processors of one kind")
def test_registers_of_any_width_make_the_same(tmp_path):
    """Of a processor without AVX, which has four lanes and no instruction that multiplies and adds."""
    made = {}
    for name in ("host", "nehalem"):
        file = tmp_path / f"{name}.npy"
        environment = os.environ | ({} if name == "host" else {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""})
        command = [sys.executable, "-c", ON_ANOTHER, str(Path(__file__).parent), str(file)]
        subprocess.run(command, check=True, env=environment, cwd=Path(__file__).parents[2])
        made[name] = np.load(file)
    assert_same(made["nehalem"], made["host"])


@pytest.mark.parametrize(("features", "lanes"), [("", 8), ("+avx2,-avx512f", 8), ("+avx2,+avx512f", 16)])
def test_the_widest_vectors_are_those_of_the_processor_that_code_is_compiled_for(features, lanes):
    command = [sys.executable, "-c", "from server.kernels import simd; print(simd.WIDE_LANES)"]
    environment = os.environ | {"NUMBA_CPU_FEATURES": features}
    done = subprocess.run(
        command, check=True, env=environment, cwd=Path(__file__).parents[2], capture_output=True, text=True
    )
    assert int(done.stdout) == lanes
