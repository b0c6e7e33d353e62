"""A writer for SOFA files (AES69), the same to the byte at any time. The largest variable is written as it comes: it
lies at the end of the file, so that nobody has to hold it whole.

SOFA is netCDF-4, and so HDF5. Two things are changed in the file that the library makes (HDF5 File Format Specification
Version 3.0, II.A, IV.A.1.b and IV.A.2.i), each with the checksum of its object:

- HDF5 notes the time in the header of the root group. Here these times are zero.
- The last variable is declared and never written, so that the library gives it no place. Its place is then the end of
  the file.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from server.rendering.sofa_file import ONE_AT_A_TIME

_SUPERBLOCK = b"\x89HDF\r\n\x1a\n\x02\x08\x08"
_HEADER = b"OHDR\x02"
_END, _SUPERBLOCK_BYTES = 28, 48
_HAS_TIMES, _HAS_PHASE, _SIZE_WIDTH = 0x20, 0x10, 0x03
_WORD = 0xFFFFFFFF
_CONTIGUOUS_NOWHERE = b"\x03\x01" + b"\xff" * 8
"""The layout of a variable that was never written: version 3, contiguous, at no address. Its size in bytes follows."""
_ALIGNMENT = 8


@dataclass(frozen=True)
class Variable:
    """A variable with the letters of its dimensions, such as MRN, and its attributes. Values are numbers, or texts in
    an array whose last dimension, S, is their length."""

    dimensions: str
    values: npt.NDArray[np.float64] | Sequence[str]
    attributes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class LastVariable:
    """A variable whose values end the file: 64-bit floats, little-endian, the last dimension running fastest."""

    name: str
    dimensions: str
    shape: tuple[int, ...]
    attributes: Mapping[str, str] = field(default_factory=dict)


def sofa_head(attributes: Mapping[str, str], variables: Mapping[str, Variable], last: LastVariable) -> bytes:
    """Return a file with these global attributes and variables, up to the values of the `last` variable, which have to
    follow. One thread at a time writes, and others wait.

    Raises ValueError if two variables disagree about the length of a dimension.
    """
    import netCDF4  # takes half a second

    arrays = {name: _array(variable) for name, variable in variables.items()}
    lengths: dict[str, int] = dict(zip(last.dimensions, last.shape, strict=True))
    for name, variable in variables.items():
        for letter, length in zip(variable.dimensions, arrays[name].shape, strict=True):
            if lengths.setdefault(letter, length) != length:
                raise ValueError(f"{name}: dimension {letter} is {length}, and elsewhere {lengths[letter]}")
    with ONE_AT_A_TIME:
        file = netCDF4.Dataset("in memory", "w", format="NETCDF4", memory=1)
        for letter, length in lengths.items():
            file.createDimension(letter, length)
        file.setncatts(dict(attributes))
        for name, variable in variables.items():
            values = arrays[name]
            stored = file.createVariable(name, "S1" if "S" in variable.dimensions else "f8", tuple(variable.dimensions))
            stored.set_auto_maskandscale(False)
            stored.setncatts(dict(variable.attributes))
            stored[:] = values
        stored = file.createVariable(
            last.name, "f8", tuple(last.dimensions), fill_value=False, contiguous=True, endian="little"
        )
        stored.setncatts(dict(last.attributes))
        image = bytearray(file.close())
    return _ended_by(_without_times(image), 8 * math.prod(last.shape))


def _array(variable: Variable) -> npt.NDArray[np.float64] | npt.NDArray[np.bytes_]:
    if isinstance(variable.values, np.ndarray):
        return variable.values.astype(np.float64)
    texts = np.array([text.encode() for text in variable.values])
    return texts.view("S1").reshape(len(texts), -1)


def _without_times(image: bytearray) -> bytearray:
    """The file with the times of its root group set to zero, and without what lies behind its end. Raises ValueError
    for a file of another form than netCDF writes."""
    if not image.startswith(_SUPERBLOCK):
        raise ValueError("the file has another superblock than expected")
    end, root = struct.unpack_from("<QQ", image, _END)
    if image[root : root + 5] != _HEADER or not image[root + 5] & _HAS_TIMES:
        raise ValueError("the root group has another header than expected")
    image[root + 6 : root + 22] = bytes(16)
    _check_header(image, root)
    return image[:end]


def _ended_by(image: bytearray, size_bytes: int) -> bytes:
    """The file in which the one variable of this size that has no place lies behind the end. Raises ValueError if there
    is not exactly one."""
    nowhere = _CONTIGUOUS_NOWHERE + struct.pack("<Q", size_bytes)
    if image.count(nowhere) != 1:
        raise ValueError("the last variable is stored in another way than expected")
    image += bytes(-len(image) % _ALIGNMENT)
    at = image.index(nowhere)
    struct.pack_into("<Q", image, at + 2, len(image))
    _check_header(image, image.rindex(_HEADER, 0, at))
    struct.pack_into("<Q", image, _END, len(image) + size_bytes)
    struct.pack_into("<I", image, _SUPERBLOCK_BYTES - 4, lookup3(image[: _SUPERBLOCK_BYTES - 4]))
    return bytes(image)


def _check_header(image: bytearray, start: int) -> None:
    """Write the checksum of the object header that begins at `start`."""
    flags = image[start + 5]
    at = start + 6 + (16 if flags & _HAS_TIMES else 0) + (4 if flags & _HAS_PHASE else 0)
    width = 1 << (flags & _SIZE_WIDTH)
    checked = at + width + int.from_bytes(image[at : at + width], "little")
    struct.pack_into("<I", image, checked, lookup3(image[start:checked]))


def lookup3(data: bytes | bytearray) -> int:
    """HDF5's checksum of metadata: `hashlittle` of Bob Jenkins' lookup3.c (2006, public domain), started from zero."""
    a = b = c = (0xDEADBEEF + len(data)) & _WORD
    whole = max(0, len(data) - 1) // 12 * 12
    for start in range(0, whole, 12):
        x, y, z = struct.unpack_from("<III", data, start)
        a, b, c = _mixed(a + x, b + y, c + z)
    if data:
        x, y, z = struct.unpack("<III", bytes(data[whole:]).ljust(12, b"\0"))
        a, b, c = a + x, b + y, c + z
        for turns in ((14, 11, 25), (16, 4, 14)):
            c = ((c ^ b) - _rotated(b, turns[0])) & _WORD
            a = ((a ^ c) - _rotated(c, turns[1])) & _WORD
            b = ((b ^ a) - _rotated(a, turns[2])) & _WORD
        c = ((c ^ b) - _rotated(b, 24)) & _WORD
    return c


def _mixed(a: int, b: int, c: int) -> tuple[int, int, int]:
    for turns in ((4, 6, 8), (16, 19, 4)):
        a, c = ((a - c) ^ _rotated(c, turns[0])) & _WORD, c + b
        b, a = ((b - a) ^ _rotated(a, turns[1])) & _WORD, a + c
        c, b = ((c - b) ^ _rotated(b, turns[2])) & _WORD, b + a
    return a, b, c


def _rotated(word: int, turn: int) -> int:
    word &= _WORD
    return (word << turn | word >> (32 - turn)) & _WORD
