"""A mode of the processor that treats denormal numbers as zeros in compiled code. They are inaudible, and multiplying
by one takes some CPUs a hundred times as long as by any other number.

The mode belongs to a thread. It is set and reset within one compiled call. Other code on the thread is therefore not
affected, and the same call gives the same samples on every thread. On processors other than x86-64 and ARM64 nothing
changes.
"""

import platform
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_WORD32, _WORD64 = ir.IntType(32), ir.IntType(64)
_MACHINE = platform.machine().lower()
_X86 = _MACHINE in {"x86_64", "amd64"}
_ARM = _MACHINE in {"aarch64", "arm64"}
# guard: denormal products are zero
_FLUSH_X86 = 0x8040
"""Bits of the MXCSR register: flush results to zero (bit 15), and treat denormal operands as zero (bit 6)."""
_FLUSH_ARM = 1 << 24
"""The bit of the FPCR register that does both."""


def _read(builder: Any) -> Any:
    """Read the control register, as 64 bits."""
    if _X86:
        place = builder.alloca(_WORD32)
        store = builder.module.declare_intrinsic(
            "llvm.x86.sse.stmxcsr", fnty=ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer()])
        )
        builder.call(store, [builder.bitcast(place, ir.IntType(8).as_pointer())])
        return builder.zext(builder.load(place), _WORD64)
    if _ARM:
        return builder.asm(ir.FunctionType(_WORD64, []), "mrs $0, fpcr", "=r", [], side_effect=True)
    return ir.Constant(_WORD64, 0)


def _write(builder: Any, word: Any) -> None:
    if _X86:
        place = builder.alloca(_WORD32)
        builder.store(builder.trunc(word, _WORD32), place)
        load = builder.module.declare_intrinsic(
            "llvm.x86.sse.ldmxcsr", fnty=ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer()])
        )
        builder.call(load, [builder.bitcast(place, ir.IntType(8).as_pointer())])
    elif _ARM:
        builder.asm(ir.FunctionType(ir.VoidType(), [_WORD64]), "msr fpcr, $0", "r", [word], side_effect=True)


@intrinsic
def flush_to_zero(_context: Any) -> Any:
    """Switch the mode on; returns the value that `restore` takes to switch it off."""

    def generate(_context: Any, builder: Any, _signature: Any, _args: Any) -> Any:
        before = _read(builder)
        _write(builder, builder.or_(before, ir.Constant(_WORD64, _FLUSH_X86 if _X86 else _FLUSH_ARM)))
        return before

    return types.int64(), generate


@intrinsic
def restore(_context: Any, _before: Any) -> Any:
    """Switch the mode off."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        _write(builder, args[0])
        return context.get_dummy_value()

    return types.void(types.int64), generate
