"""A place given as a triangle mesh, with the acoustic properties of its materials; and floor plans as such places."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.mesh import MeshError, TriangleMesh
from server.scene.geometry import Geometry, Material, PlanPoint

_Integers = npt.NDArray[np.int32]

_SURFACES = ("walls", "floor", "ceiling")


@dataclass(frozen=True, eq=False)
class MeshGeometry:
    """A mesh, and the properties of each of its materials by name.

    Raises MeshError if the mesh has a material without properties.
    """

    mesh: TriangleMesh
    materials: Mapping[str, Material]

    def __post_init__(self) -> None:
        missing = [name for name in self.mesh.materials if name not in self.materials]
        if missing:
            raise MeshError(f"materials: {', '.join(missing)}: give absorption and scattering")
        object.__setattr__(self, "materials", MappingProxyType(dict(self.materials)))

    @classmethod
    def of_plan(cls, geometry: Geometry) -> "MeshGeometry":
        """The surfaces of a floor plan: a closed mesh with the materials `walls`, `floor` and `ceiling`."""
        corners, count = np.asarray(geometry.corners, dtype=np.float64), len(geometry.corners)
        low, high = (np.column_stack([corners, np.full(count, z)]) for z in (0.0, geometry.height_m))
        here = np.arange(count)
        after = np.roll(here, -1)
        # As seen from the room, a wall runs from right to left.
        walls = np.concatenate(
            [np.stack([after, here, here + count], axis=-1), np.stack([after, here + count, after + count], axis=-1)]
        )
        floor = triangulated(geometry.corners)
        triangles = np.concatenate([walls, floor, floor[:, ::-1] + count])
        surfaces = np.repeat([0, 1, 2], [len(walls), len(floor), len(floor)])
        mesh = TriangleMesh(np.concatenate([low, high]), triangles, surfaces, _SURFACES)
        return cls(mesh, {name: getattr(geometry.materials, name) for name in _SURFACES})

    def without_scattering(self) -> "MeshGeometry":
        """The same place with specular reflections only."""
        smooth = {"scattering": (0.0,) * len(OCTAVE_BANDS_HZ)}
        return MeshGeometry(
            self.mesh, {name: material.model_copy(update=smooth) for name, material in self.materials.items()}
        )

    @property
    def in_order(self) -> tuple[Material, ...]:
        """The materials in the order in which the mesh numbers them."""
        return tuple(self.materials[name] for name in self.mesh.materials)

    def of_surfaces(self, name: str) -> npt.NDArray[np.float64]:
        """(material, band) `absorption` or `scattering`, in the order of the mesh's materials."""
        return np.array([getattr(each, name) for each in self.in_order], dtype=np.float64)


def triangulated(corners: tuple[PlanPoint, ...]) -> _Integers:
    """(n - 2, 3) triangles that fill a simple polygon, given counter-clockwise, by cutting off ears (Meisters,
    "Polygons have ears", Amer. Math. Monthly 82, 1975). Of all ears, the one with the widest angles is cut first."""
    points = np.asarray(corners, dtype=np.float64)
    left, triangles = list(range(len(points))), []
    while len(left) > 3:
        ears = [(_breadth(points[left], place), place) for place in range(len(left)) if _is_ear(points[left], place)]
        # Rounding may hide the ears of a polygon with minute angles; any corner that is not reflex then serves.
        place = max(ears)[1] if ears else max(range(len(left)), key=lambda at: _turn(points[left], at))
        triangles.append((left[place - 1], left[place], left[(place + 1) % len(left)]))
        del left[place]
    return np.array([*triangles, tuple(left)], dtype=np.int32)


def _at(points: npt.NDArray[np.float64], place: int) -> npt.NDArray[np.float64]:
    """A corner between the one before it and the one after."""
    return points[[place - 1, place, (place + 1) % len(points)]]


def _turn(points: npt.NDArray[np.float64], place: int) -> float:
    """Twice the area of the triangle at a corner; negative if the corner is reflex."""
    (ax, ay), (bx, by), (cx, cy) = _at(points, place)
    return float((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))


def _is_ear(points: npt.NDArray[np.float64], place: int) -> bool:
    if _turn(points, place) <= 0:
        return False
    others = np.delete(points, [place - 1, place, (place + 1) % len(points)], axis=0)
    triangle = _at(points, place)
    inside = np.ones(len(others), np.bool_)
    for start, end in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
        along, offset = end - start, others - start
        inside &= along[0] * offset[:, 1] - along[1] * offset[:, 0] >= 0
    return not inside.any()


def _breadth(points: npt.NDArray[np.float64], place: int) -> float:
    """The area of the triangle at a corner, as a share of the square of its longest side."""
    triangle = _at(points, place)
    longest = np.max(np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=-1))
    return float(_turn(points, place) / longest**2)
