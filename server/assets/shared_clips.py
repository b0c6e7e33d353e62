"""Clips that several machines share: they are in a store that fsspec reads, such as S3, and each machine has copies.

A clip is two files of the store. Its sound is `NAME.SOUND.wav`, and its label `NAME.SOUND.UPLOADED.json`. `NAME` comes
from the content, as on disk. `SOUND` is when the sound was stored, and a random number. `UPLOADED` is when the clip was
uploaded last. Times are milliseconds since 1970. The label is written last: a clip is there once the store has both. No
name is used twice, so machines that store or remove the same clip at once do not disturb each other. Of several labels
of a clip, the newest counts whose sound is there.

One listing says what there is, how large, and what has expired. Each machine lists the store every few seconds, and
once more for a clip that it does not know. It removes what has expired or was left unfinished. Only copies are played.
"""

import asyncio
import contextlib
import errno
import logging
import re
import secrets
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar
from weakref import WeakValueDictionary

from server.assets.clip_store import MOST_CLIPS, ClipLabel, ClipStore, Incoming, is_upload, no_room, storing
from server.assets.clips import Clip, UnknownClipError
from server.core.errors import RequestError
from server.core.stores import Failure, Operation, Store
from server.runtime.bounded_calls import BoundedCalls

T = TypeVar("T")

LOOK_S: Final = 5.0
"""Time between two listings of the store."""
STALE_S: Final = 60.0
"""How old the last listing may be, while the store does not answer, to say what there is."""
_SOONEST_S: Final = 0.25
"""The least time between two listings."""
CALL_S: Final = 10.0
"""Time for a call of the store; one that copies a sound has more."""
_BYTES_PER_S: Final = 2**20
"""The slowest that a sound may be copied."""
_MOST_CALLS: Final = 8
_REUSED_S: Final = 120.0
"""How long the sound of a clip has to stay yet, if it is not to be stored again with the next upload: longer than other
machines take to notice."""
_ABANDONED_S: Final = 3_600.0
"""Age from which on an unfinished file is nobody's any more."""
_LABELS_AT_ONCE: Final = 64
_REMOVED_AT_ONCE: Final = 64
_MOST_LABEL_BYTES: Final = 4_096
_FULL: Final = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_DONE: Final[dict[Operation, str]] = {"list": "listed", "read": "read", "write": "written", "remove": "removed"}
_STEM: Final = r"(?P<name>upload-[0-9a-f]{32})\.(?P<sound>(?P<stored>[0-9]{13})-[0-9a-f]{8})"
_SOUND: Final = re.compile(rf"{_STEM}\.wav")
_LABEL: Final = re.compile(rf"{_STEM}\.(?P<uploaded>[0-9]{{13}})\.json(?P<part>\.part)?")

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SharedClip:
    """A clip as the names of its two files in the store say."""

    name: str
    sound_id: str
    uploaded_ms: int

    @classmethod
    def new(cls, name: str, now_ms: int) -> "SharedClip":
        return cls(name, f"{now_ms:013d}-{secrets.token_hex(4)}", now_ms)

    @property
    def uploaded_s(self) -> float:
        return self.uploaded_ms / 1_000

    @property
    def sound(self) -> str:
        return f"{self.name}.{self.sound_id}.wav"

    @property
    def label(self) -> str:
        return f"{self.name}.{self.sound_id}.{self.uploaded_ms:013d}.json"


Files = Mapping[str, int]
"""Sizes of the store's files in bytes, by name."""


def clips_among(files: Files) -> dict[str, SharedClip]:
    """The clips that are there whole, by name, those that have expired among them."""
    found: dict[str, SharedClip] = {}
    for file in sorted(files):
        match = _LABEL.fullmatch(file)
        if match is None or match["part"]:
            continue
        clip = SharedClip(match["name"], match["sound"], int(match["uploaded"]))
        other = found.get(clip.name)
        if clip.sound in files and (other is None or clip.uploaded_ms >= other.uploaded_ms):
            found[clip.name] = clip
    return found


def superfluous(files: Files, *, now_s: float, expires_s: float) -> list[str]:
    """What to remove: clips that have expired or were uploaded again, and what was left unfinished. Labels come before
    sounds."""

    def is_abandoned(since_ms: str) -> bool:
        return now_s - int(since_ms) / 1_000 > _ABANDONED_S

    current = [clip for clip in clips_among(files).values() if clip.uploaded_s + expires_s > now_s]
    others = sorted(files.keys() - {file for clip in current for file in (clip.label, clip.sound)})
    labels, labelled = [], set()
    for match in filter(None, map(_LABEL.fullmatch, others)):
        sound = f"{match['name']}.{match['sound']}.wav"
        is_whole = match["part"] is None and sound in files
        if is_whole:
            labelled.add(sound)
        if is_whole or is_abandoned(match["uploaded"]):
            labels.append(match.string)
    sounds = filter(None, map(_SOUND.fullmatch, others))
    return labels + [each.string for each in sounds if each.string in labelled or is_abandoned(each["stored"])]


class SharedClips:
    """The clips of `store`: at most `quota_bytes` of them, each for `expires_s` since it was uploaded last. `copies`
    has those of this machine.

    It belongs to the event loop, and calls the store from threads of its own, each call with a limit of time. Where the
    store does not answer, refuses, or has failed and was not seen to answer since, methods raise RequestError
    store_unreachable.
    """

    def __init__(
        self,
        copies: ClipStore,
        store: Store,
        *,
        quota_bytes: int,
        expires_s: float,
        time_s: Callable[[], float] = time.time,
        call_s: float = CALL_S,
    ) -> None:
        self.copies = copies
        self._store = store
        self._quota_bytes = quota_bytes
        self._expires_s = expires_s
        self._time_s = time_s
        self._call_s = call_s
        self._calls = BoundedCalls(_MOST_CALLS, "nafir-clips")
        self._files: dict[str, int] | None = None
        """What the store had when it was last listed, and what this machine has changed since. None before that."""
        self._clips: dict[str, SharedClip] = {}
        """The clips that these files are, by name, those that have expired among them."""
        self._began_s = self._failed_s = self._listed_s = float("-inf")
        """When the last listing began, failed, and succeeded (when it began), by the loop's clock."""
        self._is_down = False
        self._listing = asyncio.Lock()
        self._changed_meanwhile: dict[str, int | None] = {}
        """Sizes of files that were stored, and None of those that were removed, while the store is listed."""
        self._labels: dict[str, ClipLabel | None] = {}
        """Labels that were read, by file; None for one that is damaged."""
        self._arriving_bytes = 0
        self._keeping: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._copying: dict[str, asyncio.Task[None]] = {}
        self._giving_up: set[asyncio.Task[None]] = set()
        self._problems: dict[Operation, str] = {}
        """What fails now, by what the store cannot do."""

    async def run(self) -> None:
        """Follow the store for ever."""
        while True:
            with contextlib.suppress(RequestError):
                await self.look()
                await self._clean_up()
            await asyncio.sleep(LOOK_S)

    async def look(self) -> None:
        """List the store, whether or not it has answered before."""
        async with self._listing:
            await self._list()

    def require(self) -> None:
        """Raises RequestError store_unreachable if the store is known not to answer."""
        if self._is_down:
            raise _unreachable()

    async def clips(self) -> list[Clip]:
        """All clips by name. The list is some seconds old, and at most a minute while the store does not answer."""
        if asyncio.get_running_loop().time() - self._listed_s > STALE_S:
            await self._look_anew()
        there = {name: clip for name, clip in self._clips.items() if self._is_current(clip)}
        try:
            async with asyncio.timeout(2 * self._call_s):
                await self._read_labels(clip.label for clip in there.values())
        except TimeoutError:
            raise _unreachable() from None  # those that were read are not read again
        labelled = ((clip, self._labels.get(clip.label)) for _, clip in sorted(there.items()))
        return [self._described(clip, label) for clip, label in labelled if label is not None]

    async def describe(self, name: str) -> Clip:
        """Raises RequestError unknown_clip too."""
        clip = await self._find(name)
        return self._described(clip, await self._label(clip))

    async def bring(self, name: str) -> None:
        """Have a copy of a clip. If there is one, nothing is waited for. Raises RequestError unknown_clip and
        storage_failed too."""
        try:
            clip = await self._find(name)
        except UnknownClipError:
            with contextlib.suppress(RequestError):
                await asyncio.to_thread(self.copies.remove, name)
            raise
        except RequestError:
            if self._files is None and await asyncio.to_thread(self._has_copy, name):
                return  # nobody knows whether it was removed elsewhere
            raise
        if await asyncio.to_thread(self.copies.renew, name, clip.uploaded_s):
            return
        copying = self._copying.get(name)
        if copying is None:
            copying = self._copying[name] = asyncio.create_task(self._copy_newest(clip))
            copying.add_done_callback(partial(self._has_copied, name))
        await asyncio.shield(copying)

    async def keep(self, incoming: Incoming, title: str, duration_s: float) -> tuple[Clip, bool]:
        """Store a file that has arrived and was decoded; return its description, and whether it is new. One that is
        there already keeps its title, and expires later. Raises RequestError storage_failed and clips_full too."""
        name = incoming.name
        async with self._keeping.setdefault(name, asyncio.Lock()):
            if self._files is None:
                await self._look_anew()
            self.require()
            there = self._current(name)
            label = None if there is None else await self._known_label(there)
            if there is not None and label is not None and (clip := await self._renewed(there, label)) is not None:
                await asyncio.to_thread(self.copies.renew, name, clip.uploaded_s)
                return self._described(clip, label), False
            is_new = label is None or self._current(name) is None  # it may have been removed elsewhere
            label = label or ClipLabel(title, duration_s)
            former = self._clips.get(name)
            now_ms = max(_ms(self._time_s()), 0 if former is None else former.uploaded_ms + 1)
            clip = SharedClip.new(name, now_ms)
            await self._put(clip, incoming, label)
            try:
                await asyncio.to_thread(self.copies.keep_copy, name, incoming, label, clip.uploaded_s)
            except RequestError as exc:  # the clip is safe, and is copied when it is asked for
                _logger.warning("an uploaded clip is not copied: %s", exc)
            return self._described(clip, label), is_new

    async def remove(self, name: str) -> None:
        """Remove a clip from the store; what plays it goes on, and other machines know it no longer with their next
        listing. Raises RequestError unknown_clip too."""
        if not is_upload(name):
            raise UnknownClipError(name)
        await self._look_anew()
        is_there = self._current(name) is not None
        labels = [match for file in self._files or () if (match := _LABEL.fullmatch(file)) and match["name"] == name]
        sounds = sorted({f"{name}.{match['sound']}.wav" for match in labels})
        for file in (*(match.string for match in labels), *sounds):  # without its label, a clip is gone already
            await self._discard(file)
        with contextlib.suppress(RequestError):
            await asyncio.to_thread(self.copies.remove, name)
        if not is_there:
            raise UnknownClipError(name)

    def _is_current(self, clip: SharedClip) -> bool:
        return clip.uploaded_s + self._expires_s > self._time_s()

    def _current(self, name: str) -> SharedClip | None:
        """A clip that has not expired, as far as is known."""
        clip = self._clips.get(name)
        return clip if clip is not None and self._is_current(clip) else None

    def _has_copy(self, name: str) -> bool:
        try:
            self.copies.describe(name)
        except UnknownClipError:
            return False
        return True

    def _described(self, clip: SharedClip, label: ClipLabel) -> Clip:
        return label.describe(clip.name, expires_s=clip.uploaded_s + self._expires_s)

    async def _find(self, name: str) -> SharedClip:
        """Raises RequestError unknown_clip too."""
        if not is_upload(name):
            raise UnknownClipError(name)
        if (clip := self._current(name)) is None:
            await self._look_anew()
            clip = self._current(name)
        if clip is None:
            raise UnknownClipError(name)
        return clip

    async def _look_anew(self) -> None:
        """Have a listing that was begun after this call. All who wait share one."""
        asked_s = asyncio.get_running_loop().time()
        self.require()
        async with self._listing:
            if self._failed_s >= asked_s:
                raise _unreachable()
            if self._began_s <= asked_s:
                await self._list()

    async def _list(self) -> None:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(self._began_s + _SOONEST_S - loop.time())
        began_s = self._began_s = loop.time()
        self._changed_meanwhile.clear()
        try:
            files, clips = await self._call("list", self._list_files)
        except RequestError:
            self._is_down, self._failed_s = True, loop.time()
            raise
        self._files, self._clips, self._listed_s, self._is_down = files, clips, began_s, False
        for file, size in tuple(self._changed_meanwhile.items()):
            self._note(file, size)
        for file in self._labels.keys() - files.keys():
            del self._labels[file]

    def _list_files(self) -> tuple[dict[str, int], dict[str, SharedClip]]:
        try:
            entries = self._store.list()
        except FileNotFoundError:  # nothing was stored yet
            return {}, {}
        found = {entry.name: entry.size_bytes or 0 for entry in entries if entry.is_file}
        files = {name: size for name, size in found.items() if _SOUND.fullmatch(name) or _LABEL.fullmatch(name)}
        return files, clips_among(files)

    def _note(self, file: str, size: int | None) -> None:
        """Note that a file was stored, or removed (None)."""
        self._changed_meanwhile[file] = size
        if self._files is None:
            return
        if size is None:
            self._files.pop(file, None)
        else:
            self._files[file] = size
        name = file.partition(".")[0]
        self._clips.pop(name, None)
        self._clips |= clips_among({each: size for each, size in self._files.items() if each.startswith(name)})

    async def _renewed(self, clip: SharedClip, label: ClipLabel) -> SharedClip | None:
        """Let a clip that is there expire later. Returns None if it has to be stored anew."""
        now_s = self._time_s()
        if clip.uploaded_s + self._expires_s - now_s < _REUSED_S:
            return None
        later = SharedClip(clip.name, clip.sound_id, _ms(now_s))
        if later.uploaded_ms <= clip.uploaded_ms:
            return clip
        await self._write(later, label)
        # guard: another machine may have removed the sound just before it had a new label
        if await self._call("read", partial(self._size_bytes, clip.sound)) is None:
            self._note(clip.sound, None)
            await self._discard(later.label)
            return None
        with contextlib.suppress(RequestError):
            await self._discard(clip.label)
        return later

    async def _put(self, clip: SharedClip, incoming: Incoming, label: ClipLabel) -> None:
        """Have the store keep a clip: the sound first, and the label once the whole sound is there."""
        assert self._files is not None
        size_bytes = incoming.target.stat().st_size
        needed_bytes = size_bytes + len(label.serialize())
        if not self._has_room(needed_bytes):
            await self._clean_up()
            if not self._has_room(needed_bytes):
                raise no_room(needed_bytes, self._free_bytes)
        self._arriving_bytes += size_bytes
        try:
            put = partial(self._store.put, str(incoming.target), self._store.path(clip.sound))
            await self._call("write", put, size_bytes=size_bytes)
            # guard: what the store has not taken whole is not acknowledged
            if await self._call("read", partial(self._size_bytes, clip.sound)) != size_bytes:
                self._fail("write", "incomplete", f"{clip.sound} did not come whole")
                raise _unreachable()
            self._note(clip.sound, size_bytes)
            await self._write(clip, label)
        except RequestError:
            giving_up = asyncio.create_task(self._give_up(clip))
            self._giving_up.add(giving_up)
            giving_up.add_done_callback(self._giving_up.discard)
            raise
        finally:
            self._arriving_bytes -= size_bytes

    async def _give_up(self, clip: SharedClip) -> None:
        """Remove what there may be of a clip that could not be stored whole. What stays is removed later."""
        with contextlib.suppress(RequestError):
            for file in (clip.label, clip.sound):
                await self._discard(file)

    @property
    def _free_bytes(self) -> int:
        return self._quota_bytes - self._arriving_bytes - sum((self._files or {}).values())

    def _has_room(self, size_bytes: int) -> bool:
        return size_bytes <= self._free_bytes and len(self._clips) < MOST_CLIPS

    async def _write(self, clip: SharedClip, label: ClipLabel) -> None:
        data = label.serialize()
        await self._call("write", partial(self._store.write, self._store.path(clip.label), data))
        self._note(clip.label, len(data))
        self._labels[clip.label] = label

    async def _discard(self, file: str) -> None:
        await self._call("remove", partial(self._store.remove, self._store.path(file)))
        self._note(file, None)

    async def _clean_up(self) -> None:
        """Remove some of what is superfluous; the rest goes after the next listing."""
        find = partial(superfluous, dict(self._files or {}), now_s=self._time_s(), expires_s=self._expires_s)
        for file in (await asyncio.to_thread(find))[:_REMOVED_AT_ONCE]:
            await self._discard(file)

    async def _label(self, clip: SharedClip) -> ClipLabel:
        """Raises RequestError unknown_clip for a label that is damaged or gone."""
        label = await self._known_label(clip)
        if label is None:
            raise UnknownClipError(clip.name)
        return label

    async def _known_label(self, clip: SharedClip) -> ClipLabel | None:
        await self._read_labels([clip.label])
        return self._labels.get(clip.label)

    async def _read_labels(self, files: Iterable[str]) -> None:
        """Read labels that were not read yet. Those that are gone meanwhile are left out."""
        sizes = self._files or {}
        unread = (file for file in files if file not in self._labels)
        missing = [file for file in unread if 0 < sizes.get(file, 0) <= _MOST_LABEL_BYTES]
        if missing:
            self.require()
        for start in range(0, len(missing), _LABELS_AT_ONCE):
            some = missing[start : start + _LABELS_AT_ONCE]
            self._labels |= await self._call("read", partial(self._read_some, some))

    def _read_some(self, files: list[str]) -> dict[str, ClipLabel | None]:
        found: dict[str, ClipLabel | None] = {}
        read = self._store.read([self._store.path(file) for file in files], _MOST_LABEL_BYTES)
        for file, data in zip(files, read, strict=True):
            if isinstance(data, FileNotFoundError):
                continue
            if isinstance(data, Exception):
                raise data
            try:
                found[file] = ClipLabel.parse(data)
            except ValueError:
                found[file] = None
        return found

    def _size_bytes(self, file: str) -> int | None:
        """The size of a file; None if it is not there."""
        try:
            return self._store.size_bytes(self._store.path(file))
        except FileNotFoundError:
            return None

    async def _copy_newest(self, clip: SharedClip) -> None:
        """Copy a clip, or what has taken its place meanwhile."""
        if await self._copy(clip):
            return
        await self._look_anew()
        newer = self._current(clip.name)
        if newer is None or not await self._copy(newer):
            raise UnknownClipError(clip.name)

    async def _copy(self, clip: SharedClip) -> bool:
        """Copy a clip from the store. Returns False if it is not there."""
        self.require()
        if (label := await self._known_label(clip)) is None:
            return False
        size_bytes = (self._files or {}).get(clip.sound, 0)
        incoming = await asyncio.to_thread(self.copies.receive)
        try:
            get = partial(self._get, clip.sound, str(incoming.target))
            if not await self._call("read", get, size_bytes=size_bytes):
                return False
            # guard: half a sound is no copy
            if incoming.target.stat().st_size != size_bytes:
                self._fail("read", "incomplete", f"{clip.sound} did not come whole")
                raise _unreachable()
            await asyncio.to_thread(self.copies.keep_copy, clip.name, incoming, label, clip.uploaded_s)
        finally:
            incoming.discard()
        return True

    def _get(self, file: str, target: str) -> bool:
        try:
            self._store.get(self._store.path(file), target)
        except FileNotFoundError:
            return False
        return True

    def _has_copied(self, name: str, task: asyncio.Task[None]) -> None:
        del self._copying[name]
        if not task.cancelled():
            task.exception()  # nobody may wait for it any more

    async def _call(self, operation: Operation, work: Callable[[], T], *, size_bytes: int = 0) -> T:
        """Call the store, and log what fails once. Raises RequestError store_unreachable, or storage_failed if a disk
        is full."""
        limit_s = self._call_s + size_bytes / _BYTES_PER_S
        try:
            result = await self._calls.run(work, limit_s)
        except TimeoutError:
            self._fail(operation, "timeout", f"it has not answered for {limit_s:.3g} s")
        except Exception as exc:  # noqa: BLE001  each file system raises errors of its own
            self._tell(operation, self._store.told(exc))
            if isinstance(exc, OSError) and exc.errno in _FULL:
                with storing():
                    raise OSError(exc.errno, "") from None
        else:
            if self._problems.pop(operation, None) is not None:
                _logger.info("clips of %s: can be %s again", self._store.name, _DONE[operation])
            return result
        raise _unreachable()

    def _fail(self, operation: Operation, how: Failure, problem: str) -> None:
        """Count and tell a failure of which the store has raised no error."""
        self._store.calls.fail(operation, how)
        self._tell(operation, problem)

    def _tell(self, operation: Operation, problem: str) -> None:
        if self._problems.get(operation) != problem:
            _logger.error("clips of %s: cannot be %s: %s", self._store.name, _DONE[operation], problem)
        self._problems[operation] = problem


def _unreachable() -> RequestError:
    again_s = round(LOOK_S)
    problem = f"the store of uploaded clips does not answer, or refuses: ask again in {again_s} s"
    return RequestError("store_unreachable", problem, field="clip", status=503, retry_after_s=again_s)


def _ms(time_s: float) -> int:
    return round(1_000 * time_s)
