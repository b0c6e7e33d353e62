"""Vectors of float32 for compiled code, for loops over contiguous samples that must be vectorised.

LLVM vectorises simple loops by itself, but it keeps no accumulators in registers and gives up where it cannot prove
that arrays do not overlap. The inner loops of the convolver and the decoder determine how many sessions a host can
serve, so they use vectors explicitly. A vector is an LLVM vector: of eight lanes, it is one register with AVX and two
with SSE or NEON.

`lanes` returns the functions that make vectors with a given number of lanes. Those whose names end in `_as` make
vectors like another one; all other functions take vectors of any size. Memory is addressed as (byte address, index of
a float32); inside a compiled function, the address of an array is its `.ctypes.data`.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic, models, register_model

_FLOAT = ir.FloatType()
_INT32 = ir.IntType(32)
_INT64 = ir.IntType(64)

# Split so that small multiples of the first part are exact (Cody and Waite 1980).
_LN_2 = (0.693359375, math.log(2) - 0.693359375)
# (exp(x) - 1 - x) / x**2, the highest power first. For x within half of ln 2, the resulting exp(x) has a relative error
# of at most 1.05e-7.
_EXPONENTIAL = [8.31250137619232e-3, 4.1890331599848334e-2, 0.16667115387827203, 0.49999230308875753]
# (ln(1 + x) - x + x**2 / 2) / x**3, the highest power first: a weighted least-squares fit. For 1 + x within half an
# octave of 1, the resulting ln(1 + x) has a relative error of at most 3.6e-8.
_LOGARITHM = [
    0.08511602133512497,
    -0.1418604999780655,
    0.1494355946779251,
    -0.16589199006557465,
    0.199615478515625,
    -0.2500094175338745,
    0.3333394229412079,
]
_ROOT_HALF_BITS = 0x3F3504F3
"""The bits of the square root of 1/2."""
DIGEST_FACTOR = 0xFF51AFD7ED558CCD
"""The factor of `mix_bits`, which MurmurHash3 has found to mix well (Appleby 2011)."""
_SMALLEST_NORMAL = 2.0**-126
_GROUP = 4
"""Lanes within which a vector is rearranged in the fewest instructions, on every processor."""
_QUARTER_TURN = (1.5703125, 4.83751296997070312e-4, math.pi / 2 - 1.5703125 - 4.83751296997070312e-4)


_features = get_host_cpu_features().flatten() if config.CPU_FEATURES is None else config.CPU_FEATURES
HAS_WIDE_REGISTERS: Final = "+avx512f" in _features.split(",")
"""Whether a register holds sixteen float32, and there are 32 of them (AVX-512), on this processor or on that for which
NUMBA_CPU_FEATURES says to compile. Elsewhere there are sixteen of eight (AVX), or 32 of four (NEON)."""


class Vector(types.Type):
    """The numba type of a vector of `lanes` float32."""

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(f"Float32x{lanes}")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, front_end_type: Any) -> None:
        super().__init__(manager, front_end_type, _floats(front_end_type.lanes))


def _floats(lanes: int) -> Any:
    return ir.VectorType(_FLOAT, lanes)


def _same(first: Any, *others: Any) -> Vector | None:
    """The vector type that all values have. If they differ or are no vectors it is None, which tells numba that there
    is no such function."""
    return first if isinstance(first, Vector) and all(other == first for other in others) else None


def _pointer(builder: Any, address: Any, index: Any, to: Any, size: int) -> Any:
    return builder.inttoptr(builder.add(address, builder.mul(index, ir.Constant(_INT64, size))), to.as_pointer())


def _load(builder: Any, address: Any, index: Any, lanes: int) -> Any:
    return builder.load(_pointer(builder, address, index, _floats(lanes), 4), align=4)


def _shuffle(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT32, len(lanes)), lanes))


def _in_every_lane(builder: Any, value: Any, lanes: int) -> Any:
    undefined = ir.Constant(_floats(lanes), ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_INT32, 0))
    return _shuffle(builder, first, undefined, [0] * lanes)


# Functions that make vectors.


class Lanes(NamedTuple):
    """The functions that make vectors with a given number of lanes."""

    load: Any
    """`load(address, index)`: the floats from `index` on."""
    load_shorts: Any
    """`load_shorts(address, index)`: int16 from `index` on, as floats; `index` counts int16."""
    load_broadcast: Any
    """`load_broadcast(address, index)`: the float at `index` in every lane."""
    broadcast: Any
    """`broadcast(value)`: one float32 in every lane."""
    load_twice: Any
    """`load_twice(address, index)`: half as many floats from `index` on, repeated in both halves."""
    load_opposed: Any
    """`load_opposed(address, index)`: half as many floats from `index` on in the second half, and their negatives in
    the first half."""


@cache
def lanes(count: int) -> Lanes:
    """The functions that make vectors of `count` lanes, which must be a power of two."""
    vector, half = Vector(count), count // 2

    @intrinsic
    def load(_context: Any, _address: Any, _index: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return _load(builder, *args, count)

        return vector(types.int64, types.int64), generate

    @intrinsic
    def load_shorts(_context: Any, _address: Any, _index: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            shorts = ir.VectorType(ir.IntType(16), count)
            values = builder.load(_pointer(builder, *args, shorts, 2), align=2)
            return builder.sitofp(values, _floats(count))

        return vector(types.int64, types.int64), generate

    @intrinsic
    def load_broadcast(_context: Any, _address: Any, _index: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            value = builder.load(_pointer(builder, *args, _FLOAT, 4), align=4)
            return _in_every_lane(builder, value, count)

        return vector(types.int64, types.int64), generate

    @intrinsic
    def broadcast(_context: Any, _value: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return _in_every_lane(builder, args[0], count)

        return vector(types.float32), generate

    @intrinsic
    def load_twice(_context: Any, _address: Any, _index: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            values = _load(builder, *args, half)
            return _shuffle(builder, values, values, [*range(half), *range(half)])

        return vector(types.int64, types.int64), generate

    @intrinsic
    def load_opposed(_context: Any, _address: Any, _index: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            values = _load(builder, *args, half)
            return _shuffle(builder, builder.fneg(values), values, list(range(count)))

        return vector(types.int64, types.int64), generate

    return Lanes(load, load_shorts, load_broadcast, broadcast, load_twice, load_opposed)


LANES = 8
"""The number of lanes in most loops."""
_usual = lanes(LANES)
load, load_shorts, load_broadcast, broadcast = _usual[:4]

WIDE_LANES: Final = 16 if HAS_WIDE_REGISTERS else LANES
"""The number of lanes of one register, for loops in which no lane depends on another. Where there are 32 registers of
eight lanes, or of four, more lanes would not help."""


@intrinsic
def load_as(_context: Any, like: Any, _address: Any, _index: Any) -> Any:
    """`load` of a vector that has as many lanes as `like`."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _load(builder, *args[1:], like.lanes)

    return (like(like, types.int64, types.int64), generate) if _same(like) else None


@intrinsic
def load_broadcast_as(_context: Any, like: Any, _address: Any, _index: Any) -> Any:
    """`load_broadcast` of a vector that has as many lanes as `like`."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        value = builder.load(_pointer(builder, *args[1:], _FLOAT, 4), align=4)
        return _in_every_lane(builder, value, like.lanes)

    return (like(like, types.int64, types.int64), generate) if _same(like) else None


@intrinsic
def broadcast_as(_context: Any, like: Any, _value: Any) -> Any:
    """`broadcast` of a vector that has as many lanes as `like`."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _in_every_lane(builder, args[1], like.lanes)

    return (like(like, types.float32), generate) if _same(like) else None


# Other functions that read memory.


@intrinsic
def pointer(_context: Any, _address: Any) -> Any:
    """An address as a pointer for `numba.carray`."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), generate


@intrinsic
def prefetch(_context: Any, _address: Any) -> Any:
    """Prefetch the cache line at an address."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        to = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [to, _INT32, _INT32, _INT32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        to_read_data_at_all_levels = [ir.Constant(_INT32, value) for value in (0, 3, 1)]
        builder.call(function, [builder.inttoptr(args[0], to), *to_read_data_at_all_levels])
        return context.get_dummy_value()

    return types.void(types.int64), generate


@intrinsic
def load_int(_context: Any, _address: Any, _index: Any) -> Any:
    """Load one int64 at an address that is a multiple of four; `index` counts int64."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.load(_pointer(builder, *args, _INT64, 8), align=4)

    return types.int64(types.int64, types.int64), generate


@intrinsic
def load_short_int(_context: Any, _address: Any, _index: Any) -> Any:
    """Load one int32; `index` counts int32."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.sext(builder.load(_pointer(builder, *args, _INT32, 4), align=4), _INT64)

    return types.int64(types.int64, types.int64), generate


# Functions of vectors, all with the same number of lanes.


@intrinsic
def store(_context: Any, _address: Any, _index: Any, value: Any) -> Any:
    """Write a vector to memory from `index` on."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(builder, args[0], args[1], _floats(value.lanes), 4), align=4)
        return context.get_dummy_value()

    return (types.void(types.int64, types.int64, value), generate) if _same(value) else None


def _binary(instruction: str) -> Callable[..., Any]:
    @intrinsic
    def operation(_context: Any, a: Any, b: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return getattr(builder, instruction)(*args)

        return (a(a, b), generate) if _same(a, b) else None

    return operation


add = _binary("fadd")
subtract = _binary("fsub")
multiply = _binary("fmul")
divide = _binary("fdiv")


def _fused(negate_product: bool) -> Callable[..., Any]:
    @intrinsic
    def operation(_context: Any, a: Any, b: Any, c: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            factor, other, term = args
            return _call(builder, "fma", builder.fneg(factor) if negate_product else factor, other, term)

        return (a(a, b, c), generate) if _same(a, b, c) else None

    return operation


multiply_add = _fused(negate_product=False)
"""a b + c, rounded once."""
multiply_subtract = _fused(negate_product=True)
"""c - a b, rounded once."""


def _call(builder: Any, name: str, *args: Any) -> Any:
    """Call an LLVM function on vectors."""
    kind = args[0].type
    function = ir.FunctionType(kind, [kind] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, function, f"llvm.{name}.v{kind.count}f32"), args)


def _constant(like: Any, value: float) -> Any:
    return ir.Constant(like.type, [value] * like.type.count)


def _integer(like: Any, value: int) -> Any:
    return ir.Constant(_integers(like), [value] * like.type.count)


def _integers(like: Any) -> Any:
    return ir.VectorType(_INT32, like.type.count)


def _polynomial(builder: Any, x: Any, coefficients: list[float]) -> Any:
    """Evaluate a polynomial; coefficients with the highest power first."""
    value = _constant(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = _call(builder, "fma", value, x, _constant(x, coefficient))
    return value


def _nearest_multiple(builder: Any, x: Any, parts: tuple[float, ...], inverse: float) -> tuple[Any, Any]:
    """Divide x by a period, given as a sum of `parts`: returns the nearest integer quotient modulo 2**22, and the
    remainder."""
    # Adding 1.5 * 2**23 rounds a number to an integer, which is then in the low bits.
    shifted = _call(builder, "fma", x, _constant(x, inverse), _constant(x, 12582912.0))
    times = builder.fneg(builder.fsub(shifted, _constant(x, 12582912.0)))
    for part in parts:
        x = _call(builder, "fma", times, _constant(x, part), x)
    return builder.bitcast(shifted, _integers(x)), x


@intrinsic
def at_least(_context: Any, x: Any, limit: Any) -> Any:
    """max(x, limit); NaN stays NaN."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        value, least = args
        return builder.select(builder.fcmp_ordered("<", value, least), least, value)

    return (x(x, limit), generate) if _same(x, limit) else None


@intrinsic
def choose_below(_context: Any, x: Any, limit: Any, below: Any, otherwise: Any) -> Any:
    """`below` in lanes where x < limit, `otherwise` in the others."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        value, most, then, other = args
        return builder.select(builder.fcmp_ordered("<", value, most), then, other)

    return (x(x, limit, below, otherwise), generate) if _same(x, limit, below, otherwise) else None


@intrinsic
def any_above(_context: Any, x: Any, limit: Any) -> Any:
    """Whether x > limit in any lane."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        bits = ir.IntType(x.lanes)
        found = builder.bitcast(builder.fcmp_ordered(">", *args), bits)
        return builder.icmp_unsigned("!=", found, ir.Constant(bits, 0))

    return (types.boolean(x, limit), generate) if _same(x, limit) else None


@intrinsic
def rotate(_context: Any, x: Any) -> Any:
    """Rotate the lanes by one: the last value becomes the first."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _shuffle(builder, args[0], args[0], [x.lanes - 1, *range(x.lanes - 1)])

    return (x(x), generate) if _same(x) else None


@intrinsic
def with_first(_context: Any, first: Any, x: Any) -> Any:
    """`x` with its first value replaced by that of `first`."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _shuffle(builder, *args, [0, *range(x.lanes + 1, 2 * x.lanes)])

    return (x(first, x), generate) if _same(first, x) else None


@intrinsic
def swap_halves(_context: Any, x: Any) -> Any:
    """Swap the halves: the second half becomes the first."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        half = x.lanes // 2
        return _shuffle(builder, args[0], args[0], [*range(half, x.lanes), *range(half)])

    return (x(x), generate) if _same(x) else None


@intrinsic
def join(_context: Any, a: Any, b: Any) -> Any:
    """A vector of twice as many lanes: those of `a`, then those of `b`."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _shuffle(builder, *args, list(range(2 * a.lanes)))

    return (Vector(2 * a.lanes)(a, b), generate) if _same(a, b) else None


@intrinsic
def first_halves(_context: Any, a: Any, b: Any) -> Any:
    """The first halves of two vectors, one after the other."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        half = a.lanes // 2
        return _shuffle(builder, *args, [*range(half), *range(a.lanes, a.lanes + half)])

    return (a(a, b), generate) if _same(a, b) else None


@intrinsic
def second_halves(_context: Any, a: Any, b: Any) -> Any:
    """The second halves of two vectors, one after the other."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        half = a.lanes // 2
        return _shuffle(builder, *args, [*range(half, a.lanes), *range(a.lanes + half, 2 * a.lanes)])

    return (a(a, b), generate) if _same(a, b) else None


@intrinsic
def mix_bits(_context: Any, digest: Any, words: Any) -> Any:
    """A step of a digest, for the bits of each two lanes as an int64: `digest` is combined with `words`, and multiplied
    by an odd number; then its upper half is combined with its lower one. For given words each step is invertible."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        kind = ir.VectorType(_INT64, digest.lanes // 2)
        old, word = (builder.bitcast(value, kind) for value in args)
        factor, half = (ir.Constant(kind, [value] * kind.count) for value in (DIGEST_FACTOR, 32))
        new = builder.mul(builder.xor(old, word), factor)
        return builder.bitcast(builder.xor(new, builder.lshr(new, half)), args[0].type)

    return (digest(digest, words), generate) if _same(digest, words) else None


@intrinsic
def square_root(_context: Any, x: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _call(builder, "sqrt", *args)

    return (x(x), generate) if _same(x) else None


@intrinsic
def exponential(_context: Any, x: Any) -> Any:
    """exp(x) to 2.2e-7; x is limited to the range from -87 to 88."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        (value,) = args
        low, high = _constant(value, -87.0), _constant(value, 88.0)
        value = builder.select(builder.fcmp_ordered("<", value, low), low, value)
        value = builder.select(builder.fcmp_ordered(">", value, high), high, value)
        halvings, rest = _nearest_multiple(builder, value, _LN_2, 1 / math.log(2))
        # The two halves of the polynomial are evaluated side by side, because powers one after the other would wait for
        # each other.
        square = builder.fmul(rest, rest)
        high = _polynomial(builder, rest, _EXPONENTIAL[:2])
        value = _call(builder, "fma", square, high, _polynomial(builder, rest, _EXPONENTIAL[2:]))
        value = _call(builder, "fma", square, value, builder.fadd(rest, _constant(rest, 1.0)))
        bits = builder.shl(halvings, _integer(rest, 23))
        scale = builder.add(bits, _integer(rest, 127 << 23))
        return builder.fmul(value, builder.bitcast(scale, value.type))

    return (x(x), generate) if _same(x) else None


@intrinsic
def logarithm(_context: Any, x: Any) -> Any:
    """ln(x) to 2e-7 of the larger of 1 and |ln(x)|; x is at least 2**-126 and finite."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        (value,) = args
        smallest = _constant(value, _SMALLEST_NORMAL)
        value = builder.select(builder.fcmp_ordered("<", value, smallest), smallest, value)
        bits = builder.bitcast(value, _integers(value))
        doublings = builder.ashr(builder.sub(bits, _integer(value, _ROOT_HALF_BITS)), _integer(value, 23))
        mantissa = builder.bitcast(builder.sub(bits, builder.shl(doublings, _integer(value, 23))), value.type)
        rest = builder.fsub(mantissa, _constant(value, 1.0))
        higher = _call(builder, "fma", _polynomial(builder, rest, _LOGARITHM), rest, _constant(value, -0.5))
        times = builder.sitofp(doublings, value.type)
        small = _call(builder, "fma", builder.fmul(rest, rest), higher, builder.fmul(times, _constant(value, _LN_2[1])))
        found = _call(builder, "fma", times, _constant(value, _LN_2[0]), builder.fadd(rest, small))
        return builder.select(builder.fcmp_unordered("uno", value, value), value, found)

    return (x(x), generate) if _same(x) else None


@intrinsic
def cosine_sine(_context: Any, x: Any) -> Any:
    """cos(x) and sin(x) to 2e-7, for x within some hundred turns."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        quarters, rest = _nearest_multiple(builder, args[0], _QUARTER_TURN, 2 / math.pi)
        square = builder.fmul(rest, rest)
        even = _polynomial(builder, square, [1 / 40320, -1 / 720, 1 / 24, -0.5, 1.0])
        odd = builder.fmul(_polynomial(builder, square, [1 / 362880, -1 / 5040, 1 / 120, -1 / 6, 1.0]), rest)
        zero, one, two = (_integer(rest, number) for number in range(3))
        is_odd = builder.icmp_signed("!=", builder.and_(quarters, one), zero)

        def signed(value: Any, quarters: Any) -> Any:
            is_negative = builder.icmp_signed("!=", builder.and_(quarters, two), zero)
            return builder.select(is_negative, builder.fneg(value), value)

        cosine = signed(builder.select(is_odd, odd, even), builder.add(quarters, one))
        sine = signed(builder.select(is_odd, even, odd), quarters)
        return context.make_tuple(builder, signature.return_type, (cosine, sine))

    return (types.UniTuple(x, 2)(x), generate) if _same(x) else None


@intrinsic
def transpose(_context: Any, rows: Any) -> Any:
    """Transpose a square matrix, whose rows are vectors: there must be one for each lane. If there are fewer, lanes are
    in groups of as many as there are rows, and the matrix of each group is transposed."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return context.make_tuple(builder, rows, _transposed(builder, cgutils.unpack_tuple(builder, args[0])))

    count = _count(rows)
    return (rows(rows), generate) if count >= _GROUP and rows.dtype.lanes % count == 0 else None


def _count(rows: Any) -> int:
    """The number of vectors in a tuple; 0 if it is no tuple of vectors."""
    return rows.count if isinstance(rows, types.UniTuple) and _same(rows.dtype) else 0


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Transpose by pairing rows, then pairs of rows, and so on; up to the last steps within groups of four lanes, where
    it takes the fewest instructions."""
    count, every = len(rows), rows[0].type.count

    def paired(a: Any, b: Any, lanes: list[int], step: int) -> list[Any]:
        """Combine two vectors: the given lanes of each, and the lanes `step` after them."""
        return [_shuffle(builder, a, b, [lane + further for lane in lanes]) for further in (0, step)]

    fours = range(0, count, _GROUP)
    lanes = range(0, every, _GROUP)
    one = [lane for four in lanes for lane in (four, every + four, four + 1, every + four + 1)]
    two = [lane for four in lanes for lane in (four, four + 1, every + four, every + four + 1)]
    rows = [vector for i in range(0, count, 2) for vector in paired(rows[i], rows[i + 1], one, 2)]
    rows = [vector for i in fours for j in (0, 1) for vector in paired(rows[i + j], rows[i + j + 2], two, 2)]
    width = _GROUP
    while width < count:
        blocks = range(0, count, 2 * width)
        lanes = [
            lane
            for block in range(0, every, 2 * width)
            for start in (block, every + block)
            for lane in range(start, start + width)
        ]
        rows = [
            _shuffle(builder, rows[i + k], rows[i + width + k], [lane + further for lane in lanes])
            for i in blocks
            for further in (0, width)
            for k in range(width)
        ]
        width *= 2
    return rows


@intrinsic
def sum_each(_context: Any, rows: Any) -> Any:
    """Sum the lanes of each vector of a tuple, whose length is half the number of lanes; the sums are the lanes of a
    vector of that length."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        vectors = cgutils.unpack_tuple(builder, args[0])
        count = 2 * len(vectors)
        width = count
        while len(vectors) > 1:  # each vector holds partial sums of twice as many rows as before
            width //= 2
            low = [lane for lane in range(2 * count) if lane // width % 2 == 0]
            high = [lane + width for lane in low]
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [builder.fadd(_shuffle(builder, a, b, low), _shuffle(builder, a, b, high)) for a, b in pairs]
        (row,) = vectors
        even, odd = list(range(0, count, 2)), list(range(1, count, 2))
        return builder.fadd(_shuffle(builder, row, row, even), _shuffle(builder, row, row, odd))

    return (Vector(_count(rows))(rows), generate) if _count(rows) and 2 * _count(rows) == rows.dtype.lanes else None
