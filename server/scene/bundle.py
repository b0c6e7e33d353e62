"""Scene bundles: folders that training writes and the server loads.

`scene.json` describes the scene and lists the SHA-256 of every other file. `*.onnx` are the fields. `arrays.npz` holds
`frozen_noise` (2, sample), the white signal behind the late reverberation of the scene. If the place is a mesh, another
archive holds its arrays, and one for each door those of its leaf. A `Bundle` object exists only after the whole folder
was read and checked.
"""

import contextlib
import hashlib
import io
import json
import stat
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from server.acoustics.doors import DoorLeaf, MeshWithDoors, Openness
from server.acoustics.geometry import FloorPlan, Vector3
from server.acoustics.mesh import MeshError, TriangleMesh
from server.acoustics.mesh_plan import floors_of
from server.acoustics.surroundings import MeshSurroundings, PlanSurroundings, Surroundings
from server.core.errors import BundleError, RequestError
from server.core.json_keys import DoubledKeyError, require_distinct_keys
from server.core.npy import MOST_HEADER_BYTES, NpyHeader
from server.core.npz import NpzArchive, NpzError
from server.scene.door import Door, openness_of
from server.scene.geometry import Material
from server.scene.manifest import ARRAYS_FILE, Manifest, SceneMesh
from server.scene.signatures import MOST_SIGNATURE_BYTES, SIGNATURE_FILE, BundleKeys

MANIFEST_FILE = "scene.json"
BUNDLED = Path(__file__).parent / "bundles"

MOST_MANIFEST_BYTES = 4 * 2**20
"""Largest `scene.json`. That of the bundled apartment, with its whole frontier, has 31 kB."""
MOST_FILE_BYTES = 2**31 - 1
"""Largest size of all listed files together. A single ONNX file cannot be larger, since protobuf has no larger
messages."""
MOST_TRIANGLES = 200_000
"""The most triangles of a mesh. Paths are looked for in it whenever something moves."""
LONGEST_MESH_M = 1_000.0
"""The longest side of the box around a mesh."""
_CHUNK_BYTES = 2**20
_WIDEST_SAMPLE_BYTES = 8
_ARCHIVE_OVERHEAD_BYTES = 2**16


@dataclass(frozen=True)
class Bundle:
    """A checked scene bundle. `contents` holds the bytes of its files by name, `scene.json` among them, as they were
    checked: those in the folder may be others by now. `frozen_noise` (2, sample) is empty if the scene has no fields.
    `mesh` is None for a floor plan, and where walls are unknown. It has no leaves: these are in `moving`, if there are
    doors."""

    folder: Path
    manifest: Manifest
    digest: str
    contents: dict[str, bytes]
    frozen_noise: npt.NDArray[np.float32]
    mesh: TriangleMesh | None = None
    moving: MeshWithDoors | None = None

    @classmethod
    def load(cls, folder: Path, *, keys: BundleKeys | None = None) -> "Bundle":
        """Read and check a bundle, which one of the `keys` has to have signed if there are any. Raises BundleError,
        which names the file and the field, for anything missing, damaged or out of bounds."""
        path = folder / MANIFEST_FILE
        text = _read(folder, MANIFEST_FILE, MOST_MANIFEST_BYTES)
        if keys is not None:
            # guard: nothing of a bundle is read before its signature is checked
            keys.require(folder, text, _read_signature(folder))
        try:
            manifest = Manifest.model_validate_json(text)
        except ValidationError as exc:
            # guard: a manifest that is none is refused by file and field
            first = exc.errors()[0]
            field = ".".join(str(part) for part in first["loc"]) or "document"
            raise BundleError(path, field, first["msg"]) from exc
        try:
            require_distinct_keys(text)
        except DoubledKeyError as exc:
            raise BundleError(path, exc.key, "is there twice: give it once") from exc
        contents = _read_listed(folder, manifest)
        noise = np.zeros((2, 0), np.float32)
        if manifest.fields:
            noise = _frozen_noise(folder / ARRAYS_FILE, contents[ARRAYS_FILE], manifest.codec.samples)
        mesh = None if manifest.mesh is None else _mesh(folder, manifest.mesh, manifest.mesh.file, contents)
        moving = None
        if manifest.mesh is not None and mesh is not None and manifest.mesh.doors:
            moving = _moving(folder, manifest.mesh, mesh, contents)
        digest = hashlib.sha256(text).hexdigest()
        bundle = cls(folder, manifest, digest, {MANIFEST_FILE: text, **contents}, noise, mesh, moving)
        bundle._require_places(path)
        return bundle

    @property
    def id(self) -> str:
        return self.manifest.id

    @cached_property
    def models(self) -> dict[str, bytes]:
        """The ONNX files by name."""
        return {name: data for name, data in self.contents.items() if name.endswith(".onnx")}

    @cached_property
    def floor_plan(self) -> FloorPlan:
        return self.manifest.floor_plan

    @property
    def doors(self) -> tuple[Door, ...]:
        return () if self.manifest.mesh is None else self.manifest.mesh.doors

    @property
    def openness(self) -> Openness:
        """How far its doors are open, in their order."""
        return openness_of(self.doors)

    def with_doors(self, openness: Openness) -> "Bundle":
        """The same scene with its doors open so far at the beginning."""
        if self.manifest.mesh is None or openness == self.openness:
            return self
        doors = [door.model_copy(update={"openness": share}) for door, share in zip(self.doors, openness, strict=True)]
        mesh = self.manifest.mesh.model_copy(update={"doors": tuple(doors)})
        return replace(self, manifest=self.manifest.model_copy(update={"mesh": mesh}))

    @cached_property
    def surroundings(self) -> Surroundings:
        """The geometry by which sound is computed, with doors as at the beginning."""
        if self.moving is not None:
            return self.moving.at(self.openness)
        if self.mesh is not None and self.manifest.mesh is not None:
            return MeshSurroundings(self.mesh, open_sky=self.manifest.mesh.open_sky)
        return PlanSurroundings(self.floor_plan)

    @property
    def surfaces(self) -> tuple[Material, ...] | None:
        """The materials of its surfaces, as the geometry numbers them; None if they are unknown."""
        if self.mesh is not None and self.manifest.mesh is not None:
            names = self.mesh.materials if self.moving is None else self.moving.materials
            return tuple(self.manifest.mesh.materials[name] for name in names)
        return None if self.manifest.geometry is None else self.manifest.geometry.materials.surfaces

    def _require_places(self, path: Path) -> None:
        """Raises BundleError if the mesh is too large, and if the places that the manifest names do not lie in its air.
        Those in a floor plan are checked with the manifest."""
        if self.mesh is None or self.manifest.mesh is None:
            return
        manifest, (low, high) = self.manifest, self.mesh.bounds_m
        if np.max(high - low) > LONGEST_MESH_M:
            sides = " x ".join(f"{side:.0f}" for side in high - low)
            problem = f"fills {sides} m: leave at most {LONGEST_MESH_M:g} m along each axis, and give metres"
            raise BundleError(path.parent / self.manifest.mesh.file, "vertices_m", problem)
        if np.any(manifest.bounds.minimum < low) or np.any(manifest.bounds.maximum > high):
            box = " to ".join(str([round(float(side), 3) for side in corner]) for corner in (low, high))
            raise BundleError(path, "bounds", f"must lie in the box around the mesh, {box}")
        for name, position in (("listener", manifest.start.listener), ("emitter", manifest.start.emitter)):
            if not self.holds(position):
                raise BundleError(path, f"start.{name}", "is not in the air: the mesh has it inside a wall or outside")

    @cached_property
    def floors_m(self) -> tuple[float, ...]:
        """Heights of the floors of a mesh, from below; empty for a floor plan."""
        return () if self.mesh is None else tuple(floors_of(self.mesh))

    def holds(self, position: Vector3) -> bool:
        """Whether a point is in the air. Leaves of doors do not count."""
        return self.surroundings.holds(position) if self.moving is None else self.moving.holds(position)

    def require_inside(self, position: Vector3, field: str) -> None:
        """Raises RequestError `position_out_of_bounds` unless the position is finite, within the bounds and not
        inside a wall."""
        bounds = self.manifest.bounds
        sides = zip(bounds.minimum, position, bounds.maximum, strict=True)
        # guard: a place is within the bounds
        in_box = all(least <= at <= most for least, at, most in sides)
        if in_box and self.holds(position):
            return
        place = ", ".join(f"{coordinate:g}" for coordinate in position)
        problem = "is inside a wall" if in_box else f"is outside {list(bounds.minimum)} to {list(bounds.maximum)} m"
        raise RequestError("position_out_of_bounds", f"{field} ({place}) {problem} of scene {self.id}", field=field)


def write_bundle(folder: Path, manifest: Manifest, files: dict[str, bytes]) -> Bundle:
    """Write the files and the manifest with their hashes, and load the result back. Raises BundleError for what cannot
    be loaded; then the folder is as it was before."""
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in sorted(files.items())}
    document = manifest.model_copy(update={"files": hashes}).model_dump(mode="json")
    contents = {**files, MANIFEST_FILE: (json.dumps(document, indent=2) + "\n").encode()}
    try:
        with tempfile.TemporaryDirectory(prefix=".writing-", dir=folder) as name:
            trial = Path(name)
            for file, data in contents.items():
                (trial / file).write_bytes(data)
            try:
                bundle = Bundle.load(trial)
            except BundleError as exc:
                raise BundleError(folder / exc.path.relative_to(trial), exc.field, exc.problem) from exc
            for file in contents:  # the manifest last
                (trial / file).replace(folder / file)
    except BaseException:
        if is_new:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
    return replace(bundle, folder=folder)


def find_bundle(scene: str) -> Path:
    """The folder of a bundled scene by its id, or of any scene by its path. Raises RequestError `unknown_scene`."""
    for folder in (BUNDLED / scene, Path(scene)):
        try:
            if (folder / MANIFEST_FILE).is_file():
                return folder
        except (OSError, ValueError):  # not a possible name of a file
            continue
    known = ", ".join(folder.name for folder in bundled_scenes())
    raise RequestError(
        "unknown_scene", f"{scene!r} is neither a bundled scene ({known}) nor a scene folder", field="scene", status=404
    )


def bundled_scenes() -> list[Path]:
    """Folders of the scenes that come with the package."""
    return sorted(path.parent for path in BUNDLED.glob(f"*/{MANIFEST_FILE}"))


def _read_listed(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    """Contents of the files that the manifest lists, by name. Raises BundleError for a file that is too long or has
    another hash."""
    contents = {}
    left = MOST_FILE_BYTES
    for name, expected in manifest.files.items():
        most = left
        if name == ARRAYS_FILE and manifest.fields:
            most = min(left, _noise_bytes(manifest.codec.samples) + _ARCHIVE_OVERHEAD_BYTES)
        contents[name] = _read(folder, name, most, sha256=expected)
        left -= len(contents[name])
    return contents


def _mesh(folder: Path, described: SceneMesh, file: str, contents: Mapping[str, bytes]) -> TriangleMesh:
    """The mesh from its archive. Raises BundleError for arrays that are none, and for a material that the manifest does
    not describe."""
    try:
        mesh = TriangleMesh.from_bytes(contents[file], most_triangles=MOST_TRIANGLES, most_vertices=3 * MOST_TRIANGLES)
    except MeshError as exc:
        raise BundleError(folder / file, "mesh", str(exc)) from exc
    missing = [name for name in mesh.materials if name not in described.materials]
    if missing:
        told = f"{missing[0]!r} is missing, and {file} has it: give its absorption and scattering"
        raise BundleError(folder / MANIFEST_FILE, "mesh.materials", told)
    return mesh


def _moving(folder: Path, described: SceneMesh, still: TriangleMesh, contents: Mapping[str, bytes]) -> MeshWithDoors:
    """The mesh with the leaves of its doors. Raises BundleError for leaves that are none, that are too many triangles
    with the mesh, or that go too far."""
    leaves = []
    for door in described.doors:
        leaf = DoorLeaf(_mesh(folder, described, door.mesh, contents), door.motion)
        # guard: a leaf stays near the place that it is of
        if np.any(np.abs(leaf.swept() - still.bounds_m.mean(axis=0)) > LONGEST_MESH_M):
            problem = f"moves its leaf farther than {LONGEST_MESH_M:g} m from the mesh"
            raise BundleError(folder / MANIFEST_FILE, f"mesh.doors.{door.name}", problem)
        leaves.append(leaf)
    count = len(still.triangles) + sum(len(leaf.mesh.triangles) for leaf in leaves)
    if count > MOST_TRIANGLES:
        problem = f"leaves make it {count:,} triangles, and a bundle has at most {MOST_TRIANGLES:,}"
        raise BundleError(folder / MANIFEST_FILE, "mesh.doors", problem)
    try:
        return MeshWithDoors(still, leaves, open_sky=described.open_sky)
    except MeshError as exc:
        raise BundleError(folder / MANIFEST_FILE, "mesh.doors", str(exc)) from exc


def _noise_bytes(samples: int) -> int:
    return MOST_HEADER_BYTES + 2 * samples * _WIDEST_SAMPLE_BYTES


def _read_signature(folder: Path) -> bytes:
    if not (folder / SIGNATURE_FILE).exists():
        problem = "is missing: bundle_keys asks for signed bundles (`nafir sign-bundle`)"
        raise BundleError(folder / SIGNATURE_FILE, "file", problem)
    return _read(folder, SIGNATURE_FILE, MOST_SIGNATURE_BYTES)


def _read(folder: Path, name: str, most_bytes: int, *, sha256: str | None = None) -> bytes:
    """Content of the file `name` of a bundle. Raises BundleError if it is missing, not a regular file, outside the
    folder, longer than `most_bytes`, or has another hash. These checks come before the content is held in memory."""
    path = folder / name
    try:
        # guard: a bundle is what lies in its folder
        if not path.resolve().is_relative_to(folder.resolve()):
            raise BundleError(path, "file", f"is a link to {path.resolve()}, outside of the bundle; copy the file here")
        # Before opening, which would block on a pipe.
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise BundleError(path, "file", "cannot be read: not a regular file")
        if status.st_size > most_bytes:
            raise BundleError(path, "size", f"is {status.st_size} bytes, and at most {most_bytes} are allowed here")
        with path.open("rb") as stream:
            if sha256 is not None and _hash_of(stream, most_bytes) != sha256:
                raise BundleError(path, "sha256", f"differs from the one in {MANIFEST_FILE}; the file is damaged")
            stream.seek(0)
            data = stream.read(status.st_size)
            # guard: what is kept of a file is what was checked
            if sha256 is not None and hashlib.sha256(data).hexdigest() != sha256:
                raise BundleError(path, "sha256", f"differs from the one in {MANIFEST_FILE}; it changes meanwhile")
            return data
    except OSError as exc:
        raise BundleError(path, "file", f"cannot be read: {exc.strerror}") from exc
    except RuntimeError as exc:  # a circle of links
        raise BundleError(path, "file", f"cannot be read: {exc}") from exc


def _hash_of(stream: IO[bytes], most_bytes: int) -> str:
    digest = hashlib.sha256()
    for _ in range(most_bytes // _CHUNK_BYTES + 1):
        chunk = stream.read(_CHUNK_BYTES)
        if not chunk:
            break
        digest.update(chunk)
    return digest.hexdigest()


def _frozen_noise(path: Path, data: bytes, samples: int) -> npt.NDArray[np.float32]:
    """(2, samples) noise from the archive. The array's header is compared with the manifest before it is unpacked."""

    def require(header: NpyHeader) -> None:
        if not np.issubdtype(header.dtype, np.floating):
            raise BundleError(path, "frozen_noise", f"holds {header.dtype}, expected floating point")
        if header.shape != (2, samples):
            raise BundleError(path, "frozen_noise", f"has shape {header.shape}, expected {(2, samples)}")

    try:
        stored = NpzArchive(io.BytesIO(data), ("frozen_noise",)).read("frozen_noise", require)
    except NpzError as exc:
        raise BundleError(path, "frozen_noise", f"cannot be read: {exc.problem}") from exc
    with np.errstate(over="ignore"):  # checked below
        noise = stored.astype(np.float32)
    # guard: the frozen noise is finite
    if not np.isfinite(noise).all():
        raise BundleError(path, "frozen_noise", "holds non-finite samples")
    return noise
