"""Vectors of eight float32 for compiled code: what a loop over contiguous samples becomes when it must.

LLVM vectorises simple loops by itself, but keeps no accumulators in registers and gives up where it cannot prove that
arrays do not overlap. The inner loops of the convolver, and of decoding, decide what a host can carry, so they say
what they mean. `Float32x8` is one LLVM vector: one register with AVX, two with SSE or NEON.

Memory is addressed as (byte address, index of a float32): inside a compiled function, of an array, by `.ctypes.data`.
"""

import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

LANES = 8

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_INT32 = ir.IntType(32)
_INT64 = ir.IntType(64)
_INTEGERS = ir.VectorType(_INT32, LANES)

# Split so that small multiples of the first parts are exact (Cody and Waite 1980).
_LN_2 = (0.693359375, math.log(2) - 0.693359375)
# (exp(x) - 1 - x) / x**2, the highest power first: nearest to exp within half of ln 2, relative, to 1.05e-7.
_EXPONENTIAL = [8.31250137619232e-3, 4.1890331599848334e-2, 0.16667115387827203, 0.49999230308875753]
_QUARTER_TURN = (1.5703125, 4.83751296997070312e-4, math.pi / 2 - 1.5703125 - 4.83751296997070312e-4)

_LAST_FIRST = [7, 0, 1, 2, 3, 4, 5, 6]
# Lanes of two vectors, 0-7 and 8-15: the first of one and the rest of the other; and what the steps of a transposition
# bring together.
_FIRST_THEN = [0, 9, 10, 11, 12, 13, 14, 15]
_LOW_1, _HIGH_1 = [0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15]
_LOW_2, _HIGH_2 = [0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]
_LOW_4, _HIGH_4 = [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]


class Float32x8(types.Type):
    def __init__(self) -> None:
        super().__init__("Float32x8")


float32x8 = Float32x8()


@register_model(Float32x8)
class _Float32x8Model(models.PrimitiveModel):
    def __init__(self, manager: Any, front_end_type: Any) -> None:
        super().__init__(manager, front_end_type, _VECTOR)


def _pointer(builder: Any, address: Any, index: Any, to: Any, size: int) -> Any:
    return builder.inttoptr(builder.add(address, builder.mul(index, ir.Constant(_INT64, size))), to.as_pointer())


def _shuffle(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT32, len(lanes)), lanes))


@intrinsic
def pointer(_context: Any, _address: Any) -> Any:
    """An address as `numba.carray` takes it."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), generate


@intrinsic
def load(_context: Any, _address: Any, _index: Any) -> Any:
    """The eight floats from `index` on."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.load(_pointer(builder, *args, _VECTOR, 4), align=4)

    return float32x8(types.int64, types.int64), generate


@intrinsic
def store(_context: Any, _address: Any, _index: Any, _value: Any) -> Any:
    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(builder, args[0], args[1], _VECTOR, 4), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, float32x8), generate


@intrinsic
def prefetch(_context: Any, _address: Any) -> Any:
    """Have the cache line at an address be near when it is read soon."""

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
    """One int64; `index` counts int64."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.load(_pointer(builder, *args, _INT64, 8), align=8)

    return types.int64(types.int64, types.int64), generate


@intrinsic
def load_short_int(_context: Any, _address: Any, _index: Any) -> Any:
    """One int32; `index` counts int32."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.sext(builder.load(_pointer(builder, *args, _INT32, 4), align=4), _INT64)

    return types.int64(types.int64, types.int64), generate


@intrinsic
def broadcast(_context: Any, _value: Any) -> Any:
    """One float32 in every lane."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.insert_element(undefined, args[0], ir.Constant(_INT32, 0))
        return _shuffle(builder, first, undefined, [0] * LANES)

    return float32x8(types.float32), generate


@intrinsic
def load_broadcast(_context: Any, _address: Any, _index: Any) -> Any:
    """The float at `index` in every lane."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        value = builder.load(_pointer(builder, *args, ir.FloatType(), 4), align=4)
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.insert_element(undefined, value, ir.Constant(_INT32, 0))
        return _shuffle(builder, first, undefined, [0] * LANES)

    return float32x8(types.int64, types.int64), generate


def _binary(instruction: str) -> Callable[..., Any]:
    @intrinsic
    def operation(_context: Any, _a: Any, _b: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return getattr(builder, instruction)(*args)

        return float32x8(float32x8, float32x8), generate

    return operation


add = _binary("fadd")
subtract = _binary("fsub")
multiply = _binary("fmul")
divide = _binary("fdiv")


def _fused(negate_product: bool) -> Callable[..., Any]:
    @intrinsic
    def operation(_context: Any, _a: Any, _b: Any, _c: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
            fused = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f32")
            a, b, c = args
            return builder.call(fused, (builder.fneg(a) if negate_product else a, b, c))

        return float32x8(float32x8, float32x8, float32x8), generate

    return operation


multiply_add = _fused(negate_product=False)
"""a b + c, rounded once."""
multiply_subtract = _fused(negate_product=True)
"""c - a b, rounded once."""


def _constant(value: float) -> Any:
    return ir.Constant(_VECTOR, [value] * LANES)


def _call(builder: Any, name: str, *args: Any) -> Any:
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), args)


def _polynomial(builder: Any, x: Any, coefficients: list[float]) -> Any:
    """The highest power first."""
    value = _constant(coefficients[0])
    for coefficient in coefficients[1:]:
        value = _call(builder, "fma", value, x, _constant(coefficient))
    return value


def _nearest_multiple(builder: Any, x: Any, parts: tuple[float, ...], inverse: float) -> tuple[Any, Any]:
    """How often the period, a sum of `parts`, goes into x, as integers modulo 2**22, and the remainder."""
    # Added to 1.5 * 2**23, a number is rounded to an integer, which then is in the low bits.
    shifted = _call(builder, "fma", x, _constant(inverse), _constant(12582912.0))
    times = builder.fneg(builder.fsub(shifted, _constant(12582912.0)))
    for part in parts:
        x = _call(builder, "fma", times, _constant(part), x)
    return builder.bitcast(shifted, _INTEGERS), x


@intrinsic
def at_least(_context: Any, _x: Any, _limit: Any) -> Any:
    """max(x, limit); what is not a number stays so."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        x, limit = args
        return builder.select(builder.fcmp_ordered("<", x, limit), limit, x)

    return float32x8(float32x8, float32x8), generate


@intrinsic
def choose_below(_context: Any, _x: Any, _limit: Any, _below: Any, _else: Any) -> Any:
    """`below` in lanes where x < limit, `else` in the others."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        x, limit, below, otherwise = args
        return builder.select(builder.fcmp_ordered("<", x, limit), below, otherwise)

    return float32x8(float32x8, float32x8, float32x8, float32x8), generate


@intrinsic
def any_above(_context: Any, _x: Any, _limit: Any) -> Any:
    """Whether x > limit in any lane."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        lanes = builder.bitcast(builder.fcmp_ordered(">", *args), ir.IntType(LANES))
        return builder.icmp_unsigned("!=", lanes, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(float32x8, float32x8), generate


@intrinsic
def rotate(_context: Any, _x: Any) -> Any:
    """The last value first."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _shuffle(builder, args[0], args[0], _LAST_FIRST)

    return float32x8(float32x8), generate


@intrinsic
def with_first(_context: Any, _first: Any, _x: Any) -> Any:
    """x but for its first value, which is that of the other."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _shuffle(builder, *args, _FIRST_THEN)

    return float32x8(float32x8, float32x8), generate


@intrinsic
def square_root(_context: Any, _x: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _call(builder, "sqrt", *args)

    return float32x8(float32x8), generate


@intrinsic
def exponential(_context: Any, _x: Any) -> Any:
    """exp(x) to 2.2e-7; of less than -87 or more than 88 that of these."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        low, high = _constant(-87.0), _constant(88.0)
        x = builder.select(builder.fcmp_ordered("<", args[0], low), low, args[0])
        x = builder.select(builder.fcmp_ordered(">", x, high), high, x)
        halvings, rest = _nearest_multiple(builder, x, _LN_2, 1 / math.log(2))
        # Its halves side by side: one after the other, powers would wait for each other.
        square = builder.fmul(rest, rest)
        high = _polynomial(builder, rest, _EXPONENTIAL[:2])
        value = _call(builder, "fma", square, high, _polynomial(builder, rest, _EXPONENTIAL[2:]))
        value = _call(builder, "fma", square, value, builder.fadd(rest, _constant(1.0)))
        bits = builder.shl(halvings, ir.Constant(_INTEGERS, [23] * LANES))
        scale = builder.add(bits, ir.Constant(_INTEGERS, [127 << 23] * LANES))
        return builder.fmul(value, builder.bitcast(scale, _VECTOR))

    return float32x8(float32x8), generate


@intrinsic
def cosine_sine(_context: Any, _x: Any) -> Any:
    """cos(x) and sin(x) to 2e-7, of x within some hundred turns."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        quarters, rest = _nearest_multiple(builder, args[0], _QUARTER_TURN, 2 / math.pi)
        square = builder.fmul(rest, rest)
        even = _polynomial(builder, square, [1 / 40320, -1 / 720, 1 / 24, -0.5, 1.0])
        odd = builder.fmul(_polynomial(builder, square, [1 / 362880, -1 / 5040, 1 / 120, -1 / 6, 1.0]), rest)
        one, two = ir.Constant(_INTEGERS, [1] * LANES), ir.Constant(_INTEGERS, [2] * LANES)
        zero = ir.Constant(_INTEGERS, [0] * LANES)
        is_odd = builder.icmp_signed("!=", builder.and_(quarters, one), zero)

        def signed(value: Any, quarters: Any) -> Any:
            is_negative = builder.icmp_signed("!=", builder.and_(quarters, two), zero)
            return builder.select(is_negative, builder.fneg(value), value)

        cosine = signed(builder.select(is_odd, odd, even), builder.add(quarters, one))
        sine = signed(builder.select(is_odd, even, odd), quarters)
        return context.make_tuple(builder, signature.return_type, (cosine, sine))

    return types.UniTuple(float32x8, 2)(float32x8), generate


@intrinsic
def transpose(_context: Any, _rows: Any) -> Any:
    """Eight vectors as the rows of a matrix; its columns."""
    rows_type = types.UniTuple(float32x8, LANES)

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        rows = cgutils.unpack_tuple(builder, args[0], LANES)
        # Pairs of rows, then of pairs, then of fours; within halves of a register but for the last step.
        pairs = [_shuffle(builder, rows[i], rows[i + 1], lanes) for i in (0, 2, 4, 6) for lanes in (_LOW_1, _HIGH_1)]
        fours = [
            _shuffle(builder, pairs[i + j], pairs[i + j + 2], lanes)
            for i in (0, 4)
            for j in (0, 1)
            for lanes in (_LOW_2, _HIGH_2)
        ]
        columns = [_shuffle(builder, fours[i], fours[i + 4], lanes) for lanes in (_LOW_4, _HIGH_4) for i in range(4)]
        return context.make_tuple(builder, rows_type, columns)

    return rows_type(rows_type), generate
