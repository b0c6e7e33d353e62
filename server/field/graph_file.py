"""What is in an ONNX file, read before ONNX Runtime loads it: operators, nodes, tensors and where their weights are.

A bundle's graphs must have all weights inside. ONNX Runtime would look for others relative to the process' working
directory, where they are not covered by the bundle's hashes. And they must use only operators that the runtime is known
to run well here: the fewer of its kernels a stranger's file can reach, the fewer faults of theirs matter.

The server does not use the `onnx` package, so this module reads the protobuf itself
(https://protobuf.dev/programming-guides/encoding/), by the field numbers of
https://github.com/onnx/onnx/blob/main/onnx/onnx.proto; it skips the weights without reading them.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

_EXPORTED: Final = """
    Abs Add ArgMin Atan Cast Clip Concat Conv Cos Div DynamicQuantizeLinear Einsum Expand Floor Gather GatherND Gelu
    Gemm GreaterOrEqual Identity LeakyRelu Less Log MatMul MatMulInteger Max Min Mul Neg Not Pow Reciprocal
    ReduceLogSumExp ReduceMean ReduceMin ReduceProd ReduceSum Relu Reshape Scan Sin Slice Softmax Split Sqrt Squeeze
    Sub Transpose Unsqueeze Where
"""
"""What `nafir-train export` writes, of all kinds of fields in all precisions."""
_RELATIVES: Final = """
    And ArgMax Ceil Constant Elu Equal Erf Exp Flatten GatherElements Greater LayerNormalization LessOrEqual Or ReduceL1
    ReduceL2 ReduceMax ReduceSumSquare Round Shape Sigmoid Sign Softplus Sum Tan Tanh
"""
"""What other exporters, and newer versions, choose for the same arithmetic."""
OPERATORS: Final = frozenset(f"{_EXPORTED}{_RELATIVES}".split())
"""Operators that a graph may use, all of the standard's own domain."""
MOST_NODES: Final = 20_000
MOST_FIELDS: Final = 2_000_000
"""Most fields of the file that are read, so that a file of nothing but fields takes seconds and not hours."""
_MOST_DIMS = 64
MOST_ELEMENTS: Final = 2**26
"""Most numbers in one tensor of weights: 256 MB as float32."""
_VARINT, _EIGHT_BYTES, _LENGTH, _FOUR_BYTES = 0, 1, 2, 5
_DEEPEST = 100  # the same limit as in protobuf's own readers
_STANDARD = ("", "ai.onnx")
_DIMS, _EXTERNAL_DATA, _DATA_LOCATION, _EXTERNAL = 1, 13, 14, 1
_OP_TYPE, _DOMAIN = 4, 7
_PARTS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {},
}
"""The fields of each type of message that may contain tensors or nodes, and the message type of each field."""


@dataclass(frozen=True)
class GraphFile:
    """What a file says of itself. `operators` have their domain before them if it is not the standard's own."""

    operators: frozenset[str]
    nodes: int
    most_elements: int
    """Of its tensors, the number of elements of the largest."""
    refers_to_other_files: bool
    """Whether any tensor is stored in another file."""

    @classmethod
    def read(cls, model: bytes) -> "GraphFile":
        """Raises ValueError for bytes that are no protobuf, for graphs nested deeper than `_DEEPEST`, and for more
        nodes, fields or axes than any graph has."""
        operators: set[str] = set()
        nodes, fields, most_elements, refers = 0, 0, 0, False
        waiting = [(memoryview(model), "model", 0)]
        while waiting:
            message, kind, depth = waiting.pop()
            if depth > _DEEPEST:
                raise ValueError(f"its graphs are nested deeper than {_DEEPEST}")
            dims: list[int] = []
            # A field that is given twice counts twice: which one a reader takes is not to be relied on.
            named: dict[int, set[str]] = {_OP_TYPE: set(), _DOMAIN: set()}
            for number, value in _fields(message):
                fields += 1
                if fields > MOST_FIELDS:
                    raise ValueError(f"it has more than {MOST_FIELDS} fields")
                if number in _PARTS[kind] and isinstance(value, memoryview):
                    waiting.append((value, _PARTS[kind][number], depth + 1))
                elif kind == "node" and number in named and isinstance(value, memoryview):
                    named[number].add(bytes(value).decode("utf-8", "backslashreplace"))
                elif kind == "tensor":
                    refers |= number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value == _EXTERNAL)
                    if number == _DIMS:
                        dims += [value] if isinstance(value, int) else _varints(value[: 10 * _MOST_DIMS])
                    if len(dims) > _MOST_DIMS:
                        raise ValueError(f"it has a tensor of more than {_MOST_DIMS} axes")
            if kind == "node":
                nodes += 1
                if nodes > MOST_NODES:
                    raise ValueError(f"it has more than {MOST_NODES} nodes")
                domains = {"" if domain in _STANDARD else f"{domain}." for domain in named[_DOMAIN] or {""}}
                operators |= {domain + name for domain in domains for name in named[_OP_TYPE]}
            elif kind == "tensor":
                most_elements = max(most_elements, math.prod(dims))
        return cls(frozenset(operators), nodes, most_elements, refers)


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The number and value of each field: a view of the bytes for fields with a length, otherwise an int."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(message, at)
            yield number, value
            continue
        if kind == _LENGTH:
            length, at = _varint(message, at)
        elif kind in {_EIGHT_BYTES, _FOUR_BYTES}:
            length = 8 if kind == _EIGHT_BYTES else 4
        else:
            raise ValueError("it is no protobuf message")
        if length > len(message) - at:
            raise ValueError("it ends within a message")
        if kind == _LENGTH:
            yield number, message[at : at + length]
        at += length


def _varints(packed: memoryview) -> Iterator[int]:
    at = 0
    while at < len(packed):
        value, at = _varint(packed, at)
        yield value


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A variable-length integer (seven bits per byte), and the index after it."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise ValueError("it ends within a number")
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("it has a number of more than ten bytes")
