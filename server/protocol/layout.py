"""Headers of binary messages. One definition packs them, reads them and describes them in the documentation."""

import struct
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

_TYPES: Final = {"B": "u8", "H": "u16", "I": "u32", "Q": "u64", "f": "f32", "x": "u8"}


class Field(NamedTuple):
    """A header field of `length` numbers of `type`, such as u32, at byte `offset`."""

    name: str
    offset: int
    type: str
    length: int
    meaning: str

    @property
    def type_name(self) -> str:
        return self.type if self.length == 1 else f"{self.type}[{self.length}]"


class Layout:
    """A header, little endian and without gaps. Each field has a name, a `struct` code (I, 3f) and a meaning.

    `then` describes the bytes after the header.
    """

    def __init__(self, *fields: tuple[str, str, str], then: str = "") -> None:
        header = struct.Struct("<" + "".join(code for _, code, _ in fields))
        self.then = then
        self.size = header.size
        self.pack, self.unpack, self.unpack_from = header.pack, header.unpack, header.unpack_from
        self._fields = fields

    @property
    def fields(self) -> Iterator[Field]:
        offset = 0
        for name, code, meaning in self._fields:
            yield Field(name, offset, _TYPES[code[-1]], int(code[:-1] or 1), meaning)
            offset += struct.calcsize(f"<{code}")

    def to_markdown(self) -> str:
        """A table of the fields, and a sentence about the bytes after the header."""
        rows = [f"| {each.offset} | {each.type_name} | `{each.name}` | {each.meaning} |" for each in self.fields]
        table = "\n".join(["| byte | type | field | meaning |", "| --- | --- | --- | --- |", *rows])
        return f"{table}\n\nThen, from byte {self.size} on, {self.then}." if self.then else table

    def to_json(self) -> dict[str, Any]:
        header = [field._asdict() for field in self.fields]
        return {"endianness": "little", "bytes": self.size, "header": header, "then": self.then}
