"""A check for ONNX weights that are stored in other files, which a bundle's graphs must not have.

ONNX Runtime would look for such files relative to the process' working directory, where they are not covered by the
bundle's hashes. The server does not use the `onnx` package, so this module reads the protobuf itself
(https://protobuf.dev/programming-guides/encoding/), by the field numbers of
https://github.com/onnx/onnx/blob/main/onnx/onnx.proto; it skips the weights without reading them.
"""

from collections.abc import Iterator

_VARINT, _EIGHT_BYTES, _LENGTH, _FOUR_BYTES = 0, 1, 2, 5
_DEEPEST = 100  # the same limit as in protobuf's own readers
_EXTERNAL_DATA, _DATA_LOCATION, _EXTERNAL = 13, 14, 1
_PARTS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
"""The fields of each type of message that may contain tensors, and the message type of each field."""


def refers_to_other_files(model: bytes) -> bool:
    """Whether any tensor of the model is stored in another file. Raises ValueError for bytes that are no protobuf, and
    for graphs nested deeper than `_DEEPEST`."""
    waiting = [(memoryview(model), "model", 0)]
    while waiting:
        message, kind, depth = waiting.pop()
        if depth > _DEEPEST:
            raise ValueError(f"its graphs are nested deeper than {_DEEPEST}")
        for number, value in _fields(message):
            if kind == "tensor":
                if number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value == _EXTERNAL):
                    return True
            elif number in _PARTS[kind] and isinstance(value, memoryview):
                waiting.append((value, _PARTS[kind][number], depth + 1))
    return False


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
