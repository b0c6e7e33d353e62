"""Headers of binary messages: what packs and reads them is also what they are described by."""

import struct
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

_TYPES: Final = {"B": "u8", "H": "u16", "I": "u32", "Q": "u64", "f": "f32", "x": "u8"}


class Field(NamedTuple):
    """`length` numbers of `type`, such as u32, from byte `offset` on."""

    name: str
    offset: int
    type: str
    length: int
    meaning: str

    @property
    def type_name(self) -> str:
        return self.type if self.length == 1 else f"{self.type}[{self.length}]"


class Layout:
    """A header, little endian and without gaps: every field by its name, its `struct` code (I, 3f) and its meaning.

    `then` says what follows the header.
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
        """A table, and what follows."""
        rows = [f"| {each.offset} | {each.type_name} | `{each.name}` | {each.meaning} |" for each in self.fields]
        table = "\n".join(["| byte | type | field | meaning |", "| --- | --- | --- | --- |", *rows])
        return f"{table}\n\nThen, from byte {self.size} on, {self.then}." if self.then else table

    def to_json(self) -> dict[str, Any]:
        header = [field._asdict() for field in self.fields]
        return {"endianness": "little", "bytes": self.size, "header": header, "then": self.then}
