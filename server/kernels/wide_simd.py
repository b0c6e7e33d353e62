"""Vectors of sixteen float32 for compiled code: one register with AVX-512, two of those of `server.kernels.simd`
elsewhere. Only for loops that load more than they keep: elsewhere two of each would not fit into the registers.

Eight complex numbers are one vector, real parts in its first half and imaginary ones in the second, so that a product
takes two steps: by the real parts of one factor twice, and by its imaginary parts crosswise, with opposed signs.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from server.kernels.simd import _pointer, _shuffle, float32x8

LANES = 16

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_HALF = ir.VectorType(ir.FloatType(), LANES // 2)
_FIRST_HALF = range(LANES // 2)
_INT32 = ir.IntType(32)


class Float32x16(types.Type):
    def __init__(self) -> None:
        super().__init__("Float32x16")


float32x16 = Float32x16()


@register_model(Float32x16)
class _Float32x16Model(models.PrimitiveModel):
    def __init__(self, manager: Any, front_end_type: Any) -> None:
        super().__init__(manager, front_end_type, _VECTOR)


def _in_every_lane(builder: Any, value: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    return _shuffle(builder, builder.insert_element(undefined, value, ir.Constant(_INT32, 0)), undefined, [0] * LANES)


@intrinsic
def load_16(_context: Any, _address: Any, _index: Any) -> Any:
    """The sixteen floats from `index` on."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.load(_pointer(builder, *args, _VECTOR, 4), align=4)

    return float32x16(types.int64, types.int64), generate


@intrinsic
def load_broadcast_16(_context: Any, _address: Any, _index: Any) -> Any:
    """The float at `index` in every lane."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _in_every_lane(builder, builder.load(_pointer(builder, *args, ir.FloatType(), 4), align=4))

    return float32x16(types.int64, types.int64), generate


@intrinsic
def store_16(_context: Any, _address: Any, _index: Any, _value: Any) -> Any:
    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(builder, args[0], args[1], _VECTOR, 4), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, float32x16), generate


@intrinsic
def broadcast_16(_context: Any, _value: Any) -> Any:
    """One float32 in every lane."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _in_every_lane(builder, args[0])

    return float32x16(types.float32), generate


@intrinsic
def load_twice(_context: Any, _address: Any, _index: Any) -> Any:
    """The eight floats from `index` on in either half."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        half = builder.load(_pointer(builder, *args, _HALF, 4), align=4)
        return _shuffle(builder, half, half, [*_FIRST_HALF, *_FIRST_HALF])

    return float32x16(types.int64, types.int64), generate


@intrinsic
def load_opposed(_context: Any, _address: Any, _index: Any) -> Any:
    """The eight floats from `index` on in the second half, and what they are the negatives of in the first."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        half = builder.load(_pointer(builder, *args, _HALF, 4), align=4)
        return _shuffle(builder, builder.fneg(half), half, list(range(LANES)))

    return float32x16(types.int64, types.int64), generate


@intrinsic
def swap_halves(_context: Any, _a: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _shuffle(builder, *args, *args, [*range(LANES // 2, LANES), *_FIRST_HALF])

    return float32x16(float32x16), generate


@intrinsic
def add_16(_context: Any, _a: Any, _b: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.fadd(*args)

    return float32x16(float32x16, float32x16), generate


@intrinsic
def multiply_16(_context: Any, _a: Any, _b: Any) -> Any:
    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.fmul(*args)

    return float32x16(float32x16, float32x16), generate


@intrinsic
def multiply_add_16(_context: Any, _a: Any, _b: Any, _c: Any) -> Any:
    """a b + c, rounded once."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
        fused = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f32")
        return builder.call(fused, args)

    return float32x16(float32x16, float32x16, float32x16), generate


@intrinsic
def sum_each(_context: Any, _rows: Any) -> Any:
    """The sums of eight vectors, one after the other."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        rows = cgutils.unpack_tuple(builder, args[0], 8)
        width = LANES
        while len(rows) > 1:  # each holds partial sums of ever more of them, in ever fewer lanes
            width //= 2
            low = [lane for lane in range(2 * LANES) if lane // width % 2 == 0]
            high = [lane + width for lane in low]
            pairs = zip(rows[::2], rows[1::2], strict=True)
            rows = [builder.fadd(_shuffle(builder, a, b, low), _shuffle(builder, a, b, high)) for a, b in pairs]
        (row,) = rows
        even, odd = list(range(0, LANES, 2)), list(range(1, LANES, 2))
        return builder.fadd(_shuffle(builder, row, row, even), _shuffle(builder, row, row, odd))

    return float32x8(types.UniTuple(float32x16, 8)), generate
