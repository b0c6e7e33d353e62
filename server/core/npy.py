"""NumPy's array files (.npy), read without trusting what their headers claim.

`numpy.load` allocates what a header claims before it looks at the data, and evaluates the header as Python. Here the
header has to be what NumPy writes (https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html), and what it
claims has to be what follows it.
"""

import math
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

_MAGIC = b"\x93NUMPY"
MOST_HEADER_BYTES = 10_000
"""The limit that NumPy itself has. The header of an array of plain numbers has about a hundred bytes."""
_HEADER = re.compile(
    r"""\s*\{\s*
    ['"]descr['"]\s*:\s*['"](?P<dtype>[<>=|]?[A-Za-z][0-9]{0,4})['"]\s*,\s*
    ['"]fortran_order['"]\s*:\s*(?P<fortran>True|False)\s*,\s*
    ['"]shape['"]\s*:\s*\(\s*(?P<shape>(?:[0-9]{1,18}L?\s*,\s*){0,32}(?:[0-9]{1,18}L?\s*)?)\)\s*,?\s*
    \}\s*""",
    re.VERBOSE,
)


class NpyError(ValueError):
    """The bytes are not an array file, or its header and data disagree. The message says what is wrong."""


@dataclass(frozen=True)
class NpyHeader:
    """Header of an array file. The data begin `header_bytes` after the start of the file."""

    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    is_fortran: bool
    header_bytes: int

    @property
    def data_bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize

    @classmethod
    def read(cls, stream: IO[bytes]) -> "NpyHeader":
        """Read a header and leave the stream at the start of the data. Raises NpyError, also for arrays of objects and
        of records."""
        start = stream.read(8)
        if len(start) < 8 or not start.startswith(_MAGIC) or start[6] not in {1, 2, 3}:
            raise NpyError("is no array file of NumPy's")
        width = 2 if start[6] == 1 else 4
        counted = stream.read(width)
        if len(counted) < width:
            raise NpyError("ends within its header")
        (length,) = struct.unpack("<H" if width == 2 else "<I", counted)
        if length > MOST_HEADER_BYTES:
            raise NpyError(f"has a header of {length} bytes; {MOST_HEADER_BYTES} are enough for any array of numbers")
        text = stream.read(length)
        if len(text) < length:
            raise NpyError("ends within its header")
        found = _HEADER.fullmatch(text.decode("latin1"))
        if found is None:
            raise NpyError("has a header that is not one of an array of plain numbers")
        try:
            dtype = np.dtype(found["dtype"])
        except TypeError as exc:
            raise NpyError(f"holds {found['dtype']!r}, which is not a type of numbers") from exc
        if dtype.kind not in "biufcSU":
            raise NpyError(f"holds {dtype}, not numbers")
        shape = tuple(int(size) for size in re.findall(r"[0-9]+", found["shape"]))
        return cls(dtype, shape, found["fortran"] == "True", 8 + width + length)

    def array(self, data: bytes) -> npt.NDArray[np.generic]:
        """The array whose bytes are `data`. Raises NpyError unless there are `data_bytes` of them."""
        if len(data) != self.data_bytes:
            raise NpyError(f"claims {self.data_bytes} bytes of {self.dtype} {self.shape} and has {len(data)}")
        order = "F" if self.is_fortran else "C"
        return np.frombuffer(data, self.dtype).reshape(self.shape, order=order)  # type: ignore[call-overload, no-any-return]


def read_npy(path: Path) -> npt.NDArray[np.generic]:
    """Read an array from a file. Raises OSError, or NpyError before any memory that the header claims is allocated."""
    with path.open("rb") as stream:
        header = NpyHeader.read(stream)
        present = path.stat().st_size - header.header_bytes
        if present != header.data_bytes:
            raise NpyError(f"claims {header.data_bytes} bytes of {header.dtype} {header.shape} and has {present}")
        return header.array(stream.read())
