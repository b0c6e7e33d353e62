"""NumPy's archives of arrays (.npz), read without trusting what they claim.

An archive is a ZIP file with a member `NAME.npy` for each array, stored or deflated: what `numpy.savez` and
`numpy.savez_compressed` write. `zipfile` unpacks other methods (bzip2, LZMA) without a limit to what comes out, so
these are refused unopened.
"""

import contextlib
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any

import numpy.typing as npt

from server.core.npy import NpyError, NpyHeader

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Exceptions of `zipfile` for invalid or damaged archives. NotImplementedError is a RuntimeError.
# guard: an archive that is none is refused by file and field
_ARCHIVE_ERRORS = (
    OSError,
    EOFError,
    KeyError,
    ValueError,
    OverflowError,
    RuntimeError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)


class NpzError(ValueError):
    """The bytes are not an archive of these arrays. The message names the array, if one is at fault, and `problem` says
    what is wrong with it or with the archive."""

    def __init__(self, problem: str, name: str | None = None) -> None:
        super().__init__(problem if name is None else f"{name}: {problem}")
        self.problem = problem


class NpzArchive:
    """The archive in `file`, which has to be open as long as this is read. It holds the arrays `names` and no others.

    Raises NpzError for anything else.
    """

    def __init__(self, file: IO[bytes], names: Sequence[str]) -> None:
        with _refusing_damage():
            self._archive = zipfile.ZipFile(file)
        self._members = {member.filename: member for member in self._archive.infolist()}
        for name in names:
            member = self._members.get(f"{name}.npy")
            if member is None:
                raise NpzError("is missing", name)
            if member.compress_type not in _METHODS:
                raise NpzError("is packed by a method that NumPy does not use: write it with numpy.savez", name)
        # guard: an archive of arrays has no other members
        if len(self._archive.infolist()) > len(names):
            others = [name for name in self._members if name.removesuffix(".npy") not in names]
            raise NpzError(f"there are others beside it, {others[0]!r} for one" if others else "it is there twice")

    def read(self, name: str, require: Callable[[NpyHeader], None]) -> npt.NDArray[Any]:
        """An array. `require` raises for a header that will not do, before memory is taken for what that claims.

        Raises NpzError for an array that is damaged, or longer or shorter than its header says.
        """
        member = self._members[f"{name}.npy"]
        with _refusing_damage(name):
            stream = self._archive.open(member)
        with stream:
            with _refusing_damage(name):
                header = NpyHeader.read(stream)
            require(header)
            present = member.file_size - header.header_bytes
            # guard: an archive unpacks to what its arrays' headers say
            if present != header.data_bytes:
                claimed = f"{header.data_bytes} bytes of {header.dtype} {header.shape}"
                raise NpzError(f"claims {claimed} and has {present}", name)
            with _refusing_damage(name):
                # At its end, `zipfile` compares the checksum.
                return header.array(stream.read(header.data_bytes))


@contextlib.contextmanager
def _refusing_damage(name: str | None = None) -> Iterator[None]:
    try:
        yield
    except NpyError as exc:
        raise NpzError(str(exc), name) from exc
    except _ARCHIVE_ERRORS as exc:
        raise NpzError(f"is no readable .npz file: {exc}", name) from exc
