"""A folder of scene bundles that may change while the server runs.

Each sub-folder with a `scene.json` is a bundle. One that came, changed or went is noticed by the names, sizes and times
of its files, and is loaded only when they have stayed the same from one look to the next, so that nothing is read while
it is being copied. A bundle that cannot be loaded changes nothing: the scene stays what it was, and the log says why.
"""

import logging
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from server.core.errors import BundleError
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import MANIFEST_FILE, Bundle
from server.scene.signatures import BundleKeys

_logger = logging.getLogger(__name__)

_Stamp = tuple[tuple[str, int, int, int], ...]
"""Name, size, time and inode of each file of a folder."""


@dataclass(frozen=True)
class Changes:
    """What one look at the folder has found."""

    loaded: Mapping[str, FieldsByLevel] = field(default_factory=dict)
    """Scenes, by id, that are new or take the place of another."""
    gone: frozenset[str] = frozenset()
    """Ids of scenes that are there no longer."""

    def __bool__(self) -> bool:
        return bool(self.loaded or self.gone)


@dataclass
class _Known:
    seen: _Stamp
    """How the files were when the folder was last looked at."""
    settled: _Stamp | None = None
    """How they were when they were last loaded, or could not be."""
    scene: str | None = None
    """Id of the scene that is served from here."""
    served_before: str | None = None
    """Id of the scene that was served from here before the last one was loaded."""
    is_refused: bool = False


class BundleFolder:
    """A scene of the folder takes the place of one of the same id among `others`, which comes back when the folder no
    longer has it. Of two sub-folders with one id, the first by name has it. Where there are `keys`, one of them has to
    have signed each bundle. `fetch` brings the folder up to date before each look."""

    def __init__(
        self,
        folder: Path,
        others: Mapping[str, FieldsByLevel],
        *,
        keys: BundleKeys | None = None,
        fetch: Callable[[], None] | None = None,
    ) -> None:
        self._folder = folder
        self._fetch = fetch
        self._keys = keys
        self._others = others
        self._known: dict[Path, _Known] = {}

    @property
    def refused(self) -> int:
        """Number of bundles that cannot be served as they are now."""
        return sum(known.is_refused for known in self._known.values())

    def look(self, *, is_first: bool = False) -> Changes:
        """Look at the folder, and load what has changed: work for another thread. The first look takes everything as
        it is."""
        if self._fetch is not None:
            self._fetch()
        stamps = self._stamps()
        before = self._served
        loaded: dict[str, FieldsByLevel] = {}
        for path in self._known.keys() - stamps.keys():
            del self._known[path]
        if before - self._served:
            self._try_refused_again()
        for path, stamp in stamps.items():
            known = self._known.setdefault(path, _Known(seen=()))
            is_steady, known.seen = is_first or known.seen == stamp, stamp
            if not is_steady or known.settled == stamp:
                continue
            known.settled = stamp
            levels = self._load(path)
            known.is_refused = levels is None
            if levels is not None:
                known.served_before, known.scene = known.scene, levels.bundle.id
                loaded[known.scene] = levels
        gone = before - self._served
        restored = {scene: self._others[scene] for scene in gone & self._others.keys()}
        return Changes(restored | loaded, frozenset(gone - self._others.keys()))

    def has(self, levels: FieldsByLevel) -> bool:
        """Whether a scene was loaded from here."""
        return levels.bundle.folder in self._known

    def replaced(self, scene: str) -> FieldsByLevel | None:
        """The scene among the others that one of the folder takes the place of; None if there is none."""
        return self._others.get(scene)

    def refuse(self, path: Path) -> None:
        """Count the bundle of a sub-folder that was loaded last as one that cannot be served as it is now. Another
        sub-folder may have its id."""
        if (known := self._known.get(path)) is not None:
            self._try_refused_again()
            known.is_refused, known.scene = True, known.served_before

    def _try_refused_again(self) -> None:
        """Forget that bundles were refused, as an id may be free."""
        for known in self._known.values():
            if known.is_refused:
                known.settled = None

    @property
    def _served(self) -> set[str]:
        return {known.scene for known in self._known.values() if known.scene is not None}

    def _load(self, path: Path) -> FieldsByLevel | None:
        """A bundle's levels; None, and a line in the log, if it cannot be served."""
        try:
            bundle = Bundle.load(path, keys=self._keys)
            others = (other for other, known in self._known.items() if known.scene == bundle.id and other != path)
            if (other := next(others, None)) is not None:
                problem = f"is {bundle.id!r}, and so is that of {other}; leave one out, or change one"
                raise BundleError(path / MANIFEST_FILE, "id", problem)
            return FieldsByLevel.load(bundle)
        except (BundleError, OSError) as exc:
            _logger.error("bundle left out: %s", exc)
            return None

    def _stamps(self) -> dict[Path, _Stamp]:
        """The bundles of the folder in the order of their names; none if it cannot be read."""
        try:
            folders = sorted(path for path in self._folder.iterdir() if (path / MANIFEST_FILE).is_file())
            return {path: _stamp(path) for path in folders}
        except OSError as exc:
            _logger.error("the folder of bundles cannot be read, and is taken to be as before: %s", exc)
            return {path: known.seen for path, known in self._known.items()}


def _stamp(folder: Path) -> _Stamp:
    found = []
    for file in sorted(folder.iterdir()):
        status = file.stat()
        if stat.S_ISREG(status.st_mode):
            found.append((file.name, status.st_size, status.st_mtime_ns, status.st_ino))
    return tuple(found)
