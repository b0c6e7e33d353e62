"""Triangle meshes: the surfaces of a place, with a material for each triangle.

Units are metres, and the world is that of `server.acoustics.geometry`: right-handed, x east, y north, z up. The corners
of a triangle run counter-clockwise as seen from the air, so that its normal points from the surface into the air. Both
sides of a triangle stop and reflect sound; orientation matters only to what is inside.
"""

import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import FARTHEST_M
from server.core.npy import NpyHeader
from server.core.npz import NpzArchive, NpzError

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int32]

MOST_TRIANGLES = 1_000_000
MOST_VERTICES = 3 * MOST_TRIANGLES
MOST_MATERIALS = 1_024
LONGEST_NAME = 128
"""The longest name of a material, in characters."""
_FIELDS = ("vertices_m", "triangles", "surfaces", "materials")


class MeshError(ValueError):
    """Arrays or a file that are no mesh. The message names the field at fault and what to do."""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """`vertices_m` (V, 3); `triangles` (T, 3), vertices of each triangle; `surfaces` (T,), the index in `materials` of
    each triangle's material. The arrays are copies, and read-only.

    Triangles may be degenerate, lie on each other, and leave holes. Raises MeshError for arrays of other shapes or
    types, for coordinates that are not finite or beyond `FARTHEST_M`, and for indices out of range.
    """

    vertices_m: _Floats
    triangles: _Integers
    surfaces: _Integers
    materials: tuple[str, ...]

    def __post_init__(self) -> None:
        vertices = _places(self.vertices_m)
        triangles = _indices("triangles", self.triangles, (None, 3), len(vertices), "vertices_m")
        if not 1 <= len(triangles) <= MOST_TRIANGLES:
            fix = "give at least one" if not len(triangles) else f"leave at most {MOST_TRIANGLES:,}"
            raise MeshError(f"triangles: {fix}, not {len(triangles):,}")
        materials = _names(self.materials)
        surfaces = _indices("surfaces", self.surfaces, (len(triangles),), len(materials), "materials")
        for name, value in zip(_FIELDS, (vertices, triangles, surfaces, materials), strict=True):
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    @cached_property
    def corners_m(self) -> _Floats:
        """(T, corner, 3)"""
        return _read_only(self.vertices_m[self.triangles])

    @cached_property
    def bounds_m(self) -> _Floats:
        """(2, 3) least and greatest coordinates of the triangles. Vertices that no triangle uses do not count."""
        corners = self.corners_m.reshape(-1, 3)
        return _read_only(np.stack([corners.min(axis=0), corners.max(axis=0)]))

    @cached_property
    def areas_m2(self) -> _Floats:
        """(T,)"""
        return _read_only(np.linalg.norm(self._crosses, axis=-1) / 2)

    @cached_property
    def normals(self) -> _Floats:
        """(T, 3) unit vectors into the air; zero for a triangle without area."""
        crosses = self._crosses
        # Scaled first: the square of a very small area is zero.
        largest = np.max(np.abs(crosses), axis=-1, keepdims=True)
        scaled = crosses / np.where(largest > 0, largest, 1.0)
        length = np.linalg.norm(scaled, axis=-1, keepdims=True)
        return _read_only(scaled / np.where(length > 0, length, 1.0))

    @cached_property
    def volume_m3(self) -> float:
        """The volume of air that a closed mesh encloses; negative if its normals point outwards. It means nothing for
        an open one."""
        from_middle = self.corners_m[:, 0] - self.bounds_m.mean(axis=0)
        return float(-np.sum(from_middle * self._crosses) / 6)

    @property
    def _crosses(self) -> _Floats:
        first, second, third = self.corners_m.transpose(1, 0, 2)
        return np.asarray(np.cross(second - first, third - first), dtype=np.float64)

    def only(self, chosen: npt.ArrayLike) -> "TriangleMesh":
        """The mesh of the triangles `chosen` (T,) of flags, or (n,) of indices, with the same vertices and materials.
        Raises MeshError if that is none."""
        chosen = np.asarray(chosen)
        return TriangleMesh(self.vertices_m, self.triangles[chosen], self.surfaces[chosen], self.materials)

    @classmethod
    def joined(cls, meshes: "Sequence[TriangleMesh]") -> "TriangleMesh":
        """The triangles of all, in order. Materials of one name are one. Raises MeshError if they are too many."""
        materials = tuple(dict.fromkeys(name for mesh in meshes for name in mesh.materials))
        numbers = {name: number for number, name in enumerate(materials)}
        begins = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
        return cls(
            np.concatenate([mesh.vertices_m for mesh in meshes]),
            np.concatenate([mesh.triangles + begin for mesh, begin in zip(meshes, begins, strict=False)]),
            np.concatenate([np.array([numbers[name] for name in mesh.materials])[mesh.surfaces] for mesh in meshes]),
            materials,
        )

    def to_bytes(self) -> bytes:
        """The arrays as an .npz file. The same mesh gives the same bytes."""
        stored: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _FIELDS}
        file = io.BytesIO()
        np.savez_compressed(file, **stored)
        return file.getvalue()

    def save(self, path: Path) -> None:
        """Write `to_bytes` to a file."""
        path.write_bytes(self.to_bytes())

    @classmethod
    def from_bytes(
        cls, data: bytes, *, most_triangles: int = MOST_TRIANGLES, most_vertices: int = MOST_VERTICES
    ) -> "TriangleMesh":
        """Read what `to_bytes` wrote. Nothing is unpickled, and no more memory is taken than the limits allow.

        Raises MeshError with the array at fault.
        """
        return cls._read(io.BytesIO(data), most_triangles, most_vertices)

    @classmethod
    def load(
        cls, path: Path, *, most_triangles: int = MOST_TRIANGLES, most_vertices: int = MOST_VERTICES
    ) -> "TriangleMesh":
        """As `from_bytes`, from a file. Raises MeshError with the path and the array at fault, and OSError."""
        try:
            with path.open("rb") as file:
                return cls._read(file, most_triangles, most_vertices)
        except MeshError as exc:
            raise MeshError(f"{path}: {exc}") from exc

    @classmethod
    def _read(cls, file: IO[bytes], most_triangles: int, most_vertices: int) -> "TriangleMesh":
        try:
            archive = NpzArchive(file, _FIELDS)
            vertices = _read(archive, "vertices_m", most_vertices, np.dtype(np.float64))
            triangles = _read(archive, "triangles", most_triangles, np.dtype(np.int32))
            surfaces = _read(archive, "surfaces", most_triangles, np.dtype(np.int32))
            names = _read(archive, "materials", MOST_MATERIALS, np.dtype(f"U{LONGEST_NAME}"))
        except NpzError as exc:
            raise MeshError(f"{exc}: write the file with TriangleMesh.save") from exc
        codes = np.frombuffer(names.tobytes(), np.dtype(np.uint32).newbyteorder(names.dtype.byteorder))
        # NumPy makes text of such numbers with a SystemError.
        if np.any(codes > sys.maxunicode):
            raise MeshError(f"materials: holds no text: {codes.max()} is no character")
        return cls(vertices, triangles, surfaces, tuple(names.tolist()))


def _read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    array.flags.writeable = False
    return array


def _places(given: npt.ArrayLike) -> _Floats:
    try:
        places = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as exc:
        raise MeshError("vertices_m: give an array (vertex, 3) of numbers") from exc
    if places.ndim != 2 or places.shape[1] != 3:
        raise MeshError(f"vertices_m: give an array (vertex, 3), not {places.shape}")
    if len(places) > MOST_VERTICES:
        raise MeshError(f"vertices_m: leave at most {MOST_VERTICES:,}, not {len(places):,}")
    faulty = np.flatnonzero(~np.all(np.abs(places) <= FARTHEST_M, axis=-1))  # not finite: no comparison holds
    if len(faulty):
        place = ", ".join(f"{value:g}" for value in places[faulty[0]])
        raise MeshError(
            f"vertices_m: vertex {faulty[0]} is at ({place}), one of {len(faulty):,}: remove them or give finite "
            f"coordinates within {FARTHEST_M:g} m"
        )
    return places + 0.0  # no negative zeros


def _indices(name: str, given: npt.ArrayLike, shape: tuple[int | None, ...], count: int, of: str) -> _Integers:
    try:
        indices = np.asarray(given)
    except ValueError as exc:
        raise MeshError(f"{name}: give an array of integers") from exc
    if len(indices.shape) != len(shape) or any(
        wanted not in (None, size) for size, wanted in zip(indices.shape, shape, strict=True)
    ):
        wanted = ", ".join("triangle" if size is None else str(size) for size in shape)
        raise MeshError(f"{name}: give an array ({wanted}{',' if len(shape) == 1 else ''}), not {indices.shape}")
    if indices.dtype.kind not in "iu" and indices.size:
        raise MeshError(f"{name}: give integers, not {indices.dtype}")
    rows = indices.reshape(len(indices), -1 if indices.size else 1)
    faulty = np.flatnonzero(np.any((rows < 0) | (rows >= count), axis=-1))
    if len(faulty):
        raise MeshError(
            f"{name}: row {faulty[0]} is {rows[faulty[0]].tolist()}, one of {len(faulty):,} out of range: {of} has "
            f"{count:,}, so indices run from 0 to {count - 1}"
        )
    return np.array(indices, dtype=np.int32)


def _names(given: Sequence[str]) -> tuple[str, ...]:
    if isinstance(given, str) or not all(isinstance(name, str) for name in given):
        raise MeshError("materials: give a tuple of names")
    names = tuple(map(str, given))
    if not 1 <= len(names) <= MOST_MATERIALS:
        raise MeshError(f"materials: give from 1 to {MOST_MATERIALS:,} names, not {len(names):,}")
    for index, name in enumerate(names):
        if not 1 <= len(name) <= LONGEST_NAME or "\0" in name:
            raise MeshError(
                f"materials: name {index} must have from 1 to {LONGEST_NAME} characters without NUL, not {len(name)}"
            )
        if name in names[:index]:
            raise MeshError(f"materials: {name!r} is there twice: give each name once")
    return names


def _read(archive: NpzArchive, name: str, most_rows: int, kind: "np.dtype[Any]") -> npt.NDArray[Any]:
    """An array of an archive, of the given type or, for text, one that is not wider."""

    def require(header: NpyHeader) -> None:
        fits = header.dtype.kind == kind.kind and header.dtype.itemsize <= kind.itemsize
        if not fits or (kind.kind != "U" and header.dtype != kind):
            raise MeshError(f"{name}: holds {header.dtype}, and must hold {kind}")
        if header.shape and header.shape[0] > most_rows:
            raise MeshError(f"{name}: has {header.shape[0]:,} rows, and may have {most_rows:,}: simplify the mesh")
        if header.data_bytes > most_rows * kind.itemsize * 3:
            raise MeshError(f"{name}: must be an array of at most three columns, not {header.shape}")

    return archive.read(name, require)
