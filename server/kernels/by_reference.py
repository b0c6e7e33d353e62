"""Named tuples of many arrays, passed to compiled code by reference.

Numba passes a tuple by value: every array of it, field by field, at every call. With tens of arrays this takes longer
than the work itself, and longer still to compile. In compiled code a `Reference` is one address with the attributes of
the tuple, the same as in Python.
"""

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import typeof, types
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.core.typing.typeof import typeof_impl
from numba.extending import NativeValue, intrinsic, models, register_model, unbox

_WORD = ir.IntType(64)


class Reference:
    """A reference to a named tuple of contiguous arrays, floats and ints, and of such tuples. It keeps the tuple alive.

    Compiled code can also take `address` and turn it back into a reference with `reference_at`.
    """

    def __init__(self, value: NamedTuple) -> None:
        self.value = value
        self.kind = ReferenceType(typeof(value))
        self._numba_type_ = self.kind  # numba finds a type by this name in a quarter of the time
        words = _words(value)
        self._words = np.array(words, np.int64)
        self.address = int(self._words.ctypes.data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.value, name)


def _words(field: Any) -> list[int]:
    if isinstance(field, tuple):
        return [word for part in field for word in _words(part)]
    if isinstance(field, np.ndarray):
        # Numba's layout of arrays, one word each: two owner fields (here 0), size, item size, address, shape, strides.
        return [0, 0, field.size, field.itemsize, field.ctypes.data, *field.shape, *field.strides]
    return [int(np.float64(field).view(np.int64)) if isinstance(field, float) else int(field)]


def _word_count(kind: Any) -> int:
    if isinstance(kind, types.BaseTuple):
        return sum(map(_word_count, kind.types))
    return 5 + 2 * kind.ndim if isinstance(kind, types.Array) else 1


class ReferenceType(types.Type):
    def __init__(self, to: Any) -> None:
        self.to = to
        super().__init__(f"Reference({to.name})")

    def index(self, name: str) -> int:
        return int(self.to.fields.index(name))

    def offset(self, name: str) -> int:
        """Offset of a field in bytes."""
        return 8 * sum(_word_count(kind) for kind in self.to.types[: self.index(name)])


@register_model(ReferenceType)
class _ReferenceModel(models.PrimitiveModel):
    def __init__(self, manager: Any, front_end_type: Any) -> None:
        super().__init__(manager, front_end_type, _WORD)


@typeof_impl.register(Reference)
def _type_of_reference(value: Reference, _context: Any) -> ReferenceType:
    return value.kind


@unbox(ReferenceType)
def _unbox_reference(_kind: Any, obj: Any, context: Any) -> NativeValue:
    address = context.pyapi.object_getattr_string(obj, "address")
    native = context.pyapi.long_as_longlong(address)
    context.pyapi.decref(address)
    return NativeValue(native, is_error=context.builder.icmp_signed("!=", context.pyapi.err_occurred(), _null(context)))


def _null(context: Any) -> Any:
    return ir.Constant(context.pyapi.pyobj, None)


@infer_getattr
class _ReferenceAttributes(AttributeTemplate):
    key = ReferenceType

    def generic_resolve(self, kind: ReferenceType, name: str) -> Any:
        return kind.to.types[kind.index(name)] if name in kind.to.fields else None


@lower_getattr_generic(ReferenceType)
def _lower_attribute(context: Any, builder: Any, kind: ReferenceType, value: Any, name: str) -> Any:
    field = kind.to.types[kind.index(name)]
    address = builder.add(value, ir.Constant(_WORD, kind.offset(name)))
    return impl_ret_borrowed(context, builder, field, _loaded(context, builder, field, address))


def _loaded(context: Any, builder: Any, kind: Any, address: Any) -> Any:
    """The value whose words are at an address."""
    if not isinstance(kind, types.BaseTuple):
        return builder.load(builder.inttoptr(address, context.get_value_type(kind).as_pointer()))
    parts = []
    for part in kind.types:
        parts.append(_loaded(context, builder, part, address))
        address = builder.add(address, ir.Constant(_WORD, 8 * _word_count(part)))
    return context.make_tuple(builder, kind, parts)


@intrinsic
def value_of(_context: Any, reference: Any) -> Any:
    """Return the tuple itself. Where its fields are read in a loop, they stay in registers then."""

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        loaded = _loaded(context, builder, reference.to, args[0])
        return impl_ret_borrowed(context, builder, reference.to, loaded)

    return (reference.to(reference), generate) if isinstance(reference, ReferenceType) else None


@intrinsic
def reference_at(_context: Any, _address: Any, like: Any) -> Any:
    """Return the reference at `address`, of the same type as `like`."""

    def generate(_context: Any, _builder: Any, _signature: Any, args: Any) -> Any:
        return args[0]

    return like(types.int64, like), generate
