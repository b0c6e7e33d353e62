"""Scene bundles in a store that fsspec reads, such as S3, copied to a folder that `BundleFolder` watches.

Each folder of the store with a `scene.json` is a bundle. It is copied whole under another name first, and only then
takes its place, so the watched folder never has half of one. Files that are equal by their size and the store's own key
(`fsspec`'s `ukey`: an ETag, or a time) are not copied again.
"""

import logging
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from server.core.stores import Store, StoreCalls
from server.scene.bundle import MANIFEST_FILE, MOST_FILE_BYTES, MOST_MANIFEST_BYTES

_logger = logging.getLogger(__name__)

MOST_BUNDLES: Final = 256
MOST_FILES: Final = 64
"""Files of one bundle. The bundled apartment has 5."""
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
"""What folders and files may be called. Nothing else becomes a path here."""


class _StoreError(Exception):
    """Something in the store is not taken, or not as it is now."""


@dataclass(frozen=True)
class _File:
    path: str
    size_bytes: int
    key: str


_Files = Mapping[str, _File]
"""Files of one bundle by name."""


class BundleStore:
    """Keeps `copies`, a folder for temporary files that is there while the store is entered, as the store at `url` is.
    `fetch` is for one thread at a time.

    Raises NafirError if fsspec or the package of the store's protocol is not installed, and for a URL that is none.
    """

    def __init__(self, url: str) -> None:
        self._store = Store(url, "bundle_url")
        self._folder = Path()
        self._taken: dict[str, _Files] = {}
        self._problems: dict[str, str] = {}
        """What is wrong now, by the bundle's name, and with the store as a whole, by ''."""

    def __enter__(self) -> Self:
        self._folder = Path(tempfile.mkdtemp(prefix="nafir-bundles-"))
        self._taken, self._problems = {}, {}
        self.copies.mkdir()
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def copies(self) -> Path:
        """The folder whose sub-folders are bundles."""
        return self._folder / "scenes"

    @property
    def name(self) -> str:
        """The store's address without a password."""
        return self._store.name

    @property
    def calls(self) -> StoreCalls:
        """What the store was asked, and how it answered."""
        return self._store.calls

    def fetch(self) -> None:
        """Copy what is new or has changed, and remove what has gone. If the store cannot be read, all stays as it
        was. The log says why, as it does of a bundle that is left out, and says so once."""
        before, self._problems = self._problems, {}
        try:
            found = self._folders()
        except Exception as exc:  # noqa: BLE001  each file system raises errors of its own
            self._problems = {**before, "": f"cannot be listed, and are taken to be as before: {exc}"}
        else:
            for name in self._taken.keys() - found.keys():
                self._remove(name)
            for name, path in found.items():
                try:
                    self._follow(name, path)
                except Exception as exc:  # noqa: BLE001  other bundles go on, and so does the copy that there is
                    self._problems[name] = f"left out, {name}: {exc}"
        for name, problem in self._problems.items():
            if before.get(name) != problem:
                _logger.error("bundles of %s: %s", self.name, self._store.told(problem))

    def _folders(self) -> dict[str, str]:
        """Paths of the store's folders by name."""
        found = {}
        for entry in self._store.list():
            if entry.is_folder and _NAME.fullmatch(entry.name):
                found[entry.name] = entry.path
        if len(found) > MOST_BUNDLES:
            raise _StoreError(f"there are {len(found)} folders; a server takes {MOST_BUNDLES}")
        return dict(sorted(found.items()))

    def _follow(self, name: str, path: str) -> None:
        """Make the copy of one folder what the store has, if that is a bundle."""
        files = self._files(path)
        if MANIFEST_FILE not in files:
            self._remove(name)
            return
        if files == self._taken.get(name):
            return
        arriving = Path(tempfile.mkdtemp(dir=self._folder))
        try:
            for file_name, file in files.items():
                self._copy(name, file_name, file, arriving / file_name)
            # guard: what changed while it was copied waits for the next look
            if self._files(path) != files:
                raise _StoreError("changed while it was copied; it is tried again")
            shutil.rmtree(self.copies / name, ignore_errors=True)
            arriving.rename(self.copies / name)
        finally:
            shutil.rmtree(arriving, ignore_errors=True)
        self._taken[name] = files

    def _remove(self, name: str) -> None:
        if self._taken.pop(name, None) is not None:
            shutil.rmtree(self.copies / name, ignore_errors=True)

    def _files(self, path: str) -> dict[str, _File]:
        """The files of a folder. Raises _StoreError for more, or larger ones, than a bundle has."""
        found, size_bytes = {}, 0
        for entry in self._store.list(path):
            if not entry.is_file or not _NAME.fullmatch(entry.name):
                continue
            if entry.size_bytes is None:
                raise _StoreError(f"{entry.name}: the store does not say its size")
            found[entry.name] = _File(entry.path, entry.size_bytes, self._store.key(entry.path))
            size_bytes += entry.size_bytes
            if len(found) > MOST_FILES:
                raise _StoreError(f"has more than {MOST_FILES} files")
        if size_bytes > MOST_FILE_BYTES + MOST_MANIFEST_BYTES:
            raise _StoreError(f"has {size_bytes} bytes, which is more than a bundle may have")
        return found

    def _copy(self, bundle: str, name: str, file: _File, target: Path) -> None:
        before = self._taken.get(bundle, {}).get(name)
        if before == file:
            shutil.copy2(self.copies / bundle / name, target)
            return
        self._store.get(file.path, str(target))
        if target.stat().st_size != file.size_bytes:
            self.calls.fail("read", "incomplete")
            raise _StoreError(f"{name} has {target.stat().st_size} bytes in place of {file.size_bytes}")
