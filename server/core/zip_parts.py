"""ZIP archives that leave in parts, so that nobody has to hold them whole: without compression, and the same bytes for
the same content."""

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

_DATE = (1980, 1, 1, 0, 0, 0)
"""The earliest that the format knows."""
_MODE = 0o644


class ZipParts:
    """An archive under way. `take` returns the bytes that it has grown by, and `end` the last of them. What is kept
    meanwhile is a line for each file."""

    def __init__(self) -> None:
        self._sink = _Sink()
        self._archive = _Archive(self._sink, "w")

    def write(self, name: str, data: bytes) -> None:
        """Add a whole file."""
        self._archive.writestr(_described(name), data)

    @contextmanager
    def file(self, name: str) -> Iterator[IO[bytes]]:
        """Add a file that is written in parts, of less than 2 GiB altogether. No other is added meanwhile."""
        with self._archive.open(_described(name), "w") as file:
            yield file

    def take(self) -> bytes:
        return self._sink.take()

    def end(self) -> bytes:
        self._archive.close()
        return self._sink.take()


class _Archive(zipfile.ZipFile):
    """An archive that may be left as it is, with a file open: nobody reads what `ZipFile` would add then."""

    def __del__(self) -> None:
        pass


class _Sink(io.RawIOBase):
    """A file that can only be written to, and whose content is taken away."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: "memoryview | bytes", /) -> int:  # type: ignore[override]
        self._parts.append(bytes(data))
        return len(data)

    def take(self) -> bytes:
        whole = b"".join(self._parts)
        self._parts.clear()
        return whole


def _described(name: str) -> zipfile.ZipInfo:
    described = zipfile.ZipInfo(name, _DATE)
    described.external_attr = _MODE << 16
    return described
