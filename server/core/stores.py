"""Folders of stores that fsspec reads, such as S3. A setting names one by its URL, whose passwords are never told."""

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Lock
from typing import Any, Literal, get_args
from urllib.parse import parse_qsl, unquote, urlsplit

from server.core.durations import DurationHistogram
from server.core.errors import NafirError

Operation = Literal["list", "read", "write", "remove"]
"""What a store is asked to do. Sizes and keys of files are read."""
Failure = Literal["error", "timeout", "incomplete"]
"""How a call fails: the store raises an error, does not answer in time, or has another file than it was to have."""


class StoreCalls:
    """How long the calls of a store took, how many failed, and when it last answered. Any thread may add and read."""

    def __init__(
        self, time_s: Callable[[], float] = time.time, clock_s: Callable[[], float] = time.perf_counter
    ) -> None:
        self._time_s, self._clock_s = time_s, clock_s
        self._lock = Lock()
        self._answered_s = 0.0
        self._durations = {operation: DurationHistogram() for operation in get_args(Operation)}
        self._failures = {(each, how): 0 for each in get_args(Operation) for how in get_args(Failure)}

    @property
    def answered_s(self) -> float:
        """When a call last succeeded, in seconds since 1970; 0 if none has yet."""
        return self._answered_s

    @property
    def durations(self) -> Mapping[Operation, DurationHistogram]:
        """Times of the calls that have ended, also of those that failed."""
        return self._durations

    @property
    def failures(self) -> Mapping[tuple[Operation, Failure], int]:
        """Numbers of failures."""
        return self._failures

    @contextmanager
    def call(self, operation: Operation) -> Iterator[None]:
        """Count what is called in here. That a file is not there is an answer, too."""
        began_s = self._clock_s()
        try:
            yield
        except FileNotFoundError:
            self._answered_s = self._time_s()
            raise
        except Exception:
            self.fail(operation, "error")
            raise
        else:
            self._answered_s = self._time_s()
        finally:
            with self._lock:
                self._durations[operation].add(self._clock_s() - began_s)

    def fail(self, operation: Operation, how: Failure) -> None:
        """Count a failure. A call that was given up may fail once more when it ends."""
        with self._lock:
            self._failures[operation, how] += 1


@dataclass(frozen=True)
class StoreEntry:
    """A file or a folder of a store, or something that is neither. `size_bytes` is None if the store does not say
    it."""

    name: str
    path: str
    is_file: bool
    is_folder: bool
    size_bytes: int | None


class Store:
    """The folder at `url`, which the setting called `setting` names. Its calls may take as long as the store likes, and
    raise errors of the store's own.

    Raises NafirError if fsspec or the package of the store's protocol is not installed, and for a URL that is none.
    """

    def __init__(self, url: str, setting: str) -> None:
        self._secrets = _secrets(url)
        try:
            import fsspec
        except ImportError as exc:
            raise NafirError(f"{setting}: needs `pip install 'nafir[store]'`") from exc
        try:
            self._system, root = fsspec.url_to_fs(url)
        except Exception as exc:  # noqa: BLE001  each file system raises errors of its own
            raise NafirError(f"{setting}: {self.told(exc)}") from None  # the traceback would have the URL
        self.root = str(root)
        self.calls = StoreCalls()
        self._can_rename = type(self._system).mv is not fsspec.AbstractFileSystem.mv

    @property
    def name(self) -> str:
        """The store's address without a password."""
        return self._without_secrets(str(self._system.unstrip_protocol(self.root)))

    @property
    def digest(self) -> str:
        """A short name that another store does not have."""
        return hashlib.sha256(self.name.encode()).hexdigest()[:16]

    def told(self, problem: object) -> str:
        """The text of a problem without what is secret in the URL."""
        return self._without_secrets(str(problem) or type(problem).__name__)

    def path(self, name: str) -> str:
        """Where a file of the folder is."""
        return f"{self.root.rstrip('/')}/{name}"

    def list(self, path: str | None = None) -> Sequence[StoreEntry]:
        """What is in the folder now, or in another one. Raises FileNotFoundError; many stores have no empty folders."""
        with self.calls.call("list"):
            self._system.invalidate_cache()
            return [_entry(each) for each in self._system.ls(self.root if path is None else path, detail=True)]

    def key(self, path: str) -> str:
        """What changes when the file changes: an ETag, or a time."""
        with self.calls.call("read"):
            return str(self._system.ukey(path))

    def size_bytes(self, path: str) -> int | None:
        """How long the file is now. Raises FileNotFoundError."""
        with self.calls.call("read"):
            self._system.invalidate_cache()
            return _entry(self._system.info(path)).size_bytes

    def read(self, paths: Sequence[str], most_bytes: int) -> Sequence[bytes | Exception]:
        """The beginnings of small files, or why one cannot be read."""
        read: Sequence[bytes | Exception]
        with self.calls.call("read"):
            read = self._system.cat_ranges(list(paths), 0, most_bytes, on_error="return")
        if any(isinstance(each, Exception) and not isinstance(each, FileNotFoundError) for each in read):
            self.calls.fail("read", "error")
        return read

    def get(self, path: str, target: str) -> None:
        """Copy a file to one of this machine."""
        with self.calls.call("read"):
            self._system.get_file(path, target)

    def put(self, source: str, path: str) -> None:
        """Copy a file of this machine to the store, whose folder is made if need be."""
        with self.calls.call("write"):
            try:
                self._system.put_file(source, path)
            except FileNotFoundError:
                self._system.makedirs(self.root, exist_ok=True)
                self._system.put_file(source, path)

    def write(self, path: str, data: bytes) -> None:
        """Write a small file. If the store can rename files, it is written under another name first; others show a file
        only once it is whole."""
        with self.calls.call("write"):
            if not self._can_rename:
                self._system.pipe_file(path, data)
                return
            part = f"{path}.part"
            self._system.pipe_file(part, data)
            self._system.mv(part, path)

    def remove(self, path: str) -> None:
        """Remove a file, if it is there."""
        with self.calls.call("remove"), suppress(FileNotFoundError):
            self._system.rm_file(path)

    def _without_secrets(self, text: str) -> str:
        for secret in self._secrets:
            text = text.replace(secret, "***")
        return text


def _entry(entry: Any) -> StoreEntry:
    path, kind, size = str(entry["name"]), entry["type"], entry.get("size")
    return StoreEntry(
        path.rstrip("/").rpartition("/")[2],
        path,
        is_file=kind == "file",
        is_folder=kind == "directory",
        size_bytes=size if isinstance(size, int) and size >= 0 else None,
    )


def _secrets(url: str) -> list[str]:
    """What nobody may read of a URL, of which several may be chained: who logs in, and all that follows a question
    mark. The longest come first."""
    found = set()
    for part in url.split("::"):
        split = urlsplit(part)
        login = split.netloc.rpartition("@")[0]
        found |= {login, login.partition(":")[2], split.query, *(value for _, value in parse_qsl(split.query))}
    found |= {unquote(each) for each in found}
    return sorted(filter(None, found), key=len, reverse=True)
