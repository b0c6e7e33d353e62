"""Clips that clients have uploaded: files in a folder, found by their content.

A clip's name is `upload-` and the beginning of the SHA-256 of what was uploaded, so the same file is stored once.
Beside the sound, `NAME.wav` (mono float, as `server.assets.upload_decoder` wrote it), stands `NAME.json` with its title
and duration. A clip is there once both are: the second file is written last, and each under another name first. A
server that is killed at any moment leaves at most files that the next one removes.

Several processes may use one folder. Whatever changes it holds the lock of its file `.lock`. Whoever receives a file
holds a lock of that, too. The system gives it back when a process is killed: so what nobody holds is removed at once,
and no clock that is set makes a file that is arriving look old.
"""

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Final, Self

from server.assets.clips import Clip, UnknownClipError, decode
from server.core.bounded_cache import BoundedCache
from server.core.errors import RequestError
from server.rendering.ingest import DryAudio

try:
    import fcntl
except ImportError:  # not a POSIX system: only one process may use the folder
    fcntl = None  # type: ignore[assignment]

_HAS_LOCKS: bool = fcntl is not None
_NAME = re.compile(r"upload-[0-9a-f]{32}")
_PART = ".part"
_ABANDONED_S = 3_600.0
"""Age from which on an unfinished file is nobody's any more, where the system has no locks."""
_KEPT_BYTES = 256 * 2**20
"""Decoded clips that are kept in memory."""
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
MOST_CLIPS: Final = 4_096


def is_upload(name: str) -> bool:
    """Whether a clip's name is one of an uploaded clip."""
    return _NAME.fullmatch(name) is not None


@dataclass(frozen=True)
class ClipLabel:
    """What is stored beside the sound of a clip."""

    title: str
    duration_s: float

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Raises ValueError."""
        try:
            label = json.loads(data)
            title, duration_s = str(label["title"]), float(label["duration_s"])
        except (KeyError, TypeError) as exc:
            raise ValueError(f"no label of a clip: {exc}") from exc
        if not math.isfinite(duration_s):
            raise ValueError(f"no clip lasts {duration_s} s")
        return cls(title, duration_s)

    def serialize(self) -> bytes:
        return json.dumps({"title": self.title, "duration_s": self.duration_s}).encode()

    def describe(self, name: str, *, expires_s: float) -> Clip:
        """The clip that has this label."""
        expires_at = datetime.fromtimestamp(expires_s, UTC).isoformat(timespec="seconds")
        return Clip(name, self.title, self.duration_s, "", expires_at=expires_at)


@dataclass(frozen=True)
class _Entry:
    """A stored clip with the size of its files and when it was uploaded last."""

    name: str
    size_bytes: int
    uploaded_s: float


class Incoming:
    """A file that is arriving, and held until it is discarded. `write` and `target` are for one thread at a time."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / f"{secrets.token_hex(16)}{_PART}"
        self.target = self.path.with_name(f"{self.path.stem}.wav{_PART}")
        """Where its decoder is to write."""
        self._hash = hashlib.sha256()
        self.size_bytes = 0
        self._file = self.path.open("xb", buffering=0)  # so that nothing is left to write when it is closed
        self._held = self.path.open("rb")
        if fcntl is not None:
            fcntl.flock(self._held, fcntl.LOCK_EX)

    def write(self, data: bytes) -> None:
        """Raises RequestError storage_failed."""
        self._hash.update(data)
        self.size_bytes += len(data)
        with storing():
            self._file.write(data)

    @property
    def name(self) -> str:
        """The name that its content gives to the clip."""
        return f"upload-{self._hash.hexdigest()[:32]}"

    def close(self) -> None:
        self._file.close()

    def discard(self) -> None:
        """Remove what is left of it."""
        self.close()
        self._held.close()
        for path in (self.path, self.target):
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def storing() -> Iterator[None]:
    """Turn errors of the disk into RequestError storage_failed."""
    try:
        yield
    except OSError as exc:
        what = "the disk is full" if exc.errno in _FULL else f"the folder of clips: {exc.strerror or exc}"
        raise RequestError("storage_failed", f"the clip could not be stored: {what}", status=507) from exc


def no_room(size_bytes: int, free_bytes: int) -> RequestError:
    """The refusal of a clip that does not fit into the quota."""
    free = max(0, free_bytes)
    problem = f"the clip takes {size_bytes} bytes when decoded, and {free} are free: delete others first"
    return RequestError("clips_full", problem, status=507)


class ClipStore:
    """The uploaded clips in `folder`, which is made if it does not exist: at most `quota_bytes` of them, each for
    `expires_s` since it was uploaded last. Safe to use from any thread. Raises OSError if the folder cannot be used."""

    def __init__(
        self, folder: Path, *, quota_bytes: int, expires_s: float, time_s: Callable[[], float] = time.time
    ) -> None:
        self._folder = folder
        self._quota_bytes = quota_bytes
        self._expires_s = expires_s
        self._time_s = time_s
        self._decoded: BoundedCache[tuple[str, int], DryAudio] = BoundedCache(_KEPT_BYTES)
        self._decoding = Lock()
        folder.mkdir(parents=True, exist_ok=True)
        with self._locked():
            self._clean_up()

    def receive(self) -> Incoming:
        """Begin to store a file. Raises RequestError storage_failed."""
        with storing(), self._locked():
            return Incoming(self._folder)

    def keep(self, incoming: Incoming, title: str, duration_s: float) -> tuple[Clip, bool]:
        """Store a file that has arrived and was decoded; return its description, and whether it is new. One that is
        there already keeps its title, and expires later.

        Raises RequestError: storage_failed, or clips_full if it does not fit into the quota.
        """
        name, now_s = incoming.name, self._time_s()
        with storing(), self._locked():
            self._clean_up()
            entries = self._entries()
            if name in entries:
                os.utime(self._label(name), (now_s, now_s))
                return self.describe(name), False
            label = ClipLabel(title, duration_s).serialize()
            size_bytes = incoming.target.stat().st_size + len(label)
            stored_bytes = sum(entry.size_bytes for entry in entries.values())
            if stored_bytes + size_bytes > self._quota_bytes or len(entries) >= MOST_CLIPS:
                raise no_room(size_bytes, self._quota_bytes - stored_bytes)
            self._put(name, incoming, label, now_s)
        return self.describe(name), True

    def keep_copy(self, name: str, incoming: Incoming, label: ClipLabel, uploaded_s: float) -> None:
        """Store the decoded sound of a clip that has its place elsewhere. If the quota has no room, clips that were
        uploaded longest ago go. Raises RequestError storage_failed."""
        with storing(), self._locked():
            self._clean_up()
            data = label.serialize()
            room_bytes = self._quota_bytes - incoming.target.stat().st_size - len(data)
            others = sorted(self._entries().values(), key=lambda entry: entry.uploaded_s)
            stored_bytes = sum(entry.size_bytes for entry in others)
            for number, entry in enumerate(others):
                if stored_bytes <= room_bytes and len(others) - number < MOST_CLIPS:
                    break
                self._unlink(entry.name)
                stored_bytes -= entry.size_bytes
            self._put(name, incoming, data, uploaded_s)

    def renew(self, name: str, uploaded_s: float) -> bool:
        """Let a clip expire as one that was uploaded then. Returns False if it is not here."""
        try:
            self._sound(name).stat()
            if self._label(name).stat().st_mtime != uploaded_s:
                os.utime(self._label(name), (uploaded_s, uploaded_s))
            self.describe(name)
        except (OSError, UnknownClipError):
            return False
        return True

    def _put(self, name: str, incoming: Incoming, label: bytes, uploaded_s: float) -> None:
        """Move the sound to its place, and write the label."""
        incoming.target.replace(self._sound(name))
        part = self._label(name).with_suffix(_PART)
        try:
            with part.open("wb") as file:
                file.write(label)
                file.flush()
                os.fsync(file.fileno())
            os.utime(part, (uploaded_s, uploaded_s))
            part.replace(self._label(name))
        except OSError:
            for path in (part, self._sound(name)):
                path.unlink(missing_ok=True)
            raise

    def clips(self) -> list[Clip]:
        """Descriptions of all clips that have not expired, by name."""
        described = []
        for name in sorted(self._entries()):
            with contextlib.suppress(UnknownClipError):  # another process has removed it
                described.append(self.describe(name))
        return described

    def describe(self, name: str) -> Clip:
        """Raises UnknownClipError."""
        try:
            uploaded_s = self._label(name).stat().st_mtime
            label = ClipLabel.parse(self._label(name).read_bytes())
        except (OSError, ValueError):
            raise UnknownClipError(name) from None
        if uploaded_s + self._expires_s <= self._time_s():
            raise UnknownClipError(name)
        return label.describe(name, expires_s=uploaded_s + self._expires_s)

    def file(self, name: str) -> Path:
        """The file of a clip. Raises UnknownClipError."""
        self.describe(name)
        return self._sound(name)

    def load(self, name: str, sample_rate: int) -> DryAudio:
        """The clip at a sample rate. One is decoded at a time, and kept while there is room. Raises UnknownClipError,
        and DecodeError for a file that somebody has damaged."""
        self.describe(name)
        with self._decoding:
            audio = self._decoded.get((name, sample_rate))
            if audio is None:
                audio = decode(self._sound(name), sample_rate)
                self._decoded.put((name, sample_rate), audio, audio.samples.nbytes)
            return audio

    def loaded(self, name: str, sample_rate: int) -> DryAudio | None:
        """What `load` returned, if it is still kept. This is fast."""
        return self._decoded.get((name, sample_rate))

    def remove(self, name: str) -> None:
        """Remove a clip; what plays it goes on. Raises UnknownClipError, and RequestError storage_failed."""
        self.describe(name)
        with storing(), self._locked():
            self._unlink(name)

    def _entries(self) -> dict[str, _Entry]:
        """The clips that are stored and have not expired."""
        entries = {}
        for label in self._folder.glob("upload-*.json"):
            name = label.stem
            if not is_upload(name):
                continue
            with contextlib.suppress(OSError):
                about, sound = label.stat(), self._sound(name).stat()
                if about.st_mtime + self._expires_s > self._time_s():
                    entries[name] = _Entry(name, about.st_size + sound.st_size, about.st_mtime)
        return entries

    def _clean_up(self) -> None:
        """Remove what has expired, and what others have left unfinished."""
        now_s = self._time_s()
        for file in list(self._folder.iterdir()):
            with contextlib.suppress(OSError):
                age_s = now_s - file.stat().st_mtime
                name, _, suffix = file.name.partition(".")
                if file.suffix == _PART:
                    if self._is_abandoned(name, age_s):
                        file.unlink()
                elif suffix == "json" and is_upload(name) and age_s >= self._expires_s:
                    self._unlink(name)
                elif suffix == "wav" and is_upload(name) and not self._label(name).exists():
                    file.unlink()

    def _is_abandoned(self, name: str, age_s: float) -> bool:
        """Whether nobody holds the unfinished file of a name."""
        if not _HAS_LOCKS:
            return age_s > _ABANDONED_S
        try:
            with (self._folder / f"{name}{_PART}").open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except FileNotFoundError:
            pass
        return True

    def _unlink(self, name: str) -> None:
        self._label(name).unlink(missing_ok=True)
        self._sound(name).unlink(missing_ok=True)

    def _label(self, name: str) -> Path:
        return self._file(name, "json")

    def _sound(self, name: str) -> Path:
        return self._file(name, "wav")

    def _file(self, name: str, suffix: str) -> Path:
        if not is_upload(name):  # nothing else becomes a path
            raise UnknownClipError(name)
        return self._folder / f"{name}.{suffix}"

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        with (self._folder / ".lock").open("ab") as file:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX)
            yield
