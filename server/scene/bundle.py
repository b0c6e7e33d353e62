"""Scene bundles: the folder training writes and the server loads.

`scene.json` describes the scene and lists a SHA-256 for every other file; `*.onnx` are the fields; `arrays.npz` holds
`frozen_noise` (2, sample), the white signal behind every late reverberation of the scene. Nothing half-loads: a bundle
that exists as an object was read and checked whole.
"""

import hashlib
import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from server.acoustics.geometry import FloorPlan, Vector3
from server.errors import BundleError, RequestError
from server.scene.manifest import ARRAYS_FILE, Manifest

MANIFEST_FILE = "scene.json"
BUNDLED = Path(__file__).parent / "bundles"

# What `zipfile` and NumPy raise between them for bytes that are no archive, or archives that hold no array.
_ARCHIVE_ERRORS = (OSError, EOFError, KeyError, ValueError, RuntimeError, zlib.error, zipfile.BadZipFile)


@dataclass(frozen=True)
class Bundle:
    """A checked scene bundle. `models` holds the bytes of each ONNX file by name, as hashed; `frozen_noise` is empty
    where there are none."""

    folder: Path
    manifest: Manifest
    digest: str
    models: dict[str, bytes]
    frozen_noise: npt.NDArray[np.float32]

    @classmethod
    def load(cls, folder: Path) -> "Bundle":
        """Raises BundleError naming file and field for anything missing, damaged or out of bounds."""
        path = folder / MANIFEST_FILE
        text = _read(path)
        try:
            manifest = Manifest.model_validate_json(text)
        except ValidationError as exc:
            first = exc.errors()[0]
            field = ".".join(str(part) for part in first["loc"]) or "document"
            raise BundleError(path, field, first["msg"]) from exc
        contents = {}
        for name, expected in manifest.files.items():
            contents[name] = _read(folder / name)
            if hashlib.sha256(contents[name]).hexdigest() != expected:
                raise BundleError(
                    folder / name, "sha256", f"differs from the one in {MANIFEST_FILE}; the file is damaged"
                )
        noise = np.zeros((2, 0), np.float32)
        if manifest.fields:
            noise = _frozen_noise(folder / ARRAYS_FILE, contents[ARRAYS_FILE], manifest.codec.samples)
        models = {name: data for name, data in contents.items() if name.endswith(".onnx")}
        return cls(folder, manifest, hashlib.sha256(text).hexdigest(), models, noise)

    @property
    def id(self) -> str:
        return self.manifest.id

    @cached_property
    def floor_plan(self) -> FloorPlan:
        return self.manifest.floor_plan

    def require_inside(self, position: Vector3, field: str) -> None:
        """Raises RequestError `position_out_of_bounds` unless the position is finite, within the bounds and not
        inside a wall."""
        bounds = self.manifest.bounds
        sides = zip(bounds.minimum, position, bounds.maximum, strict=True)
        in_box = all(least <= at <= most for least, at, most in sides)
        if in_box and self.floor_plan.holds(position):
            return
        place = ", ".join(f"{coordinate:g}" for coordinate in position)
        problem = "is inside a wall" if in_box else f"is outside {list(bounds.minimum)} to {list(bounds.maximum)} m"
        raise RequestError("position_out_of_bounds", f"{field} ({place}) {problem} of scene {self.id}", field=field)


def write_bundle(folder: Path, manifest: Manifest, files: dict[str, bytes]) -> Bundle:
    """Writes the files, then the manifest with their hashes in place of any it had, and loads the result back."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in sorted(files.items())}
    document = manifest.model_copy(update={"files": hashes}).model_dump(mode="json")
    (folder / MANIFEST_FILE).write_text(json.dumps(document, indent=2) + "\n")
    return Bundle.load(folder)


def find_bundle(scene: str) -> Path:
    """The folder of a bundled scene by id, or of any scene by path. Raises RequestError `unknown_scene`."""
    for folder in (BUNDLED / scene, Path(scene)):
        if (folder / MANIFEST_FILE).is_file():
            return folder
    known = ", ".join(folder.name for folder in bundled_scenes())
    raise RequestError(
        "unknown_scene", f"{scene!r} is neither a bundled scene ({known}) nor a scene folder", field="scene", status=404
    )


def bundled_scenes() -> list[Path]:
    """Folders of the scenes that come with the package."""
    return sorted(path.parent for path in BUNDLED.glob(f"*/{MANIFEST_FILE}"))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as exc:
        raise BundleError(path, "file", f"cannot be read: {exc.strerror}") from exc


def _frozen_noise(path: Path, data: bytes, samples: int) -> npt.NDArray[np.float32]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, archive.open("frozen_noise.npy") as member:
            noise = np.lib.format.read_array(member, allow_pickle=False)
    except _ARCHIVE_ERRORS as exc:
        raise BundleError(path, "frozen_noise", f"cannot be read: {exc}") from exc
    if not np.issubdtype(noise.dtype, np.floating):
        raise BundleError(path, "frozen_noise", f"holds {noise.dtype}, expected floating point")
    if noise.shape != (2, samples):
        raise BundleError(path, "frozen_noise", f"has shape {noise.shape}, expected {(2, samples)}")
    if not np.isfinite(noise).all():
        raise BundleError(path, "frozen_noise", "holds non-finite samples")
    return noise.astype(np.float32, copy=False)
