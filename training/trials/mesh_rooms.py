"""Rooms as triangle meshes whose sound is known: of simple volumes, with the same share in all octave bands.

Metres. Faces of rooms look inwards, into the air.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_tree import MeshTree
from server.scene.geometry import Geometry, Material, Materials
from server.scene.mesh_geometry import MeshGeometry

_Floats = npt.NDArray[np.float64]
_Part = tuple[npt.ArrayLike, npt.ArrayLike, str]
"""Vertices (n, 3), triangles (m, 3) and the name of a material."""

CUBE: Final = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
_QUADS: Final = ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))
INWARDS: Final = np.array([(q[0], q[a], q[a + 1]) for q in _QUADS for a in (1, 2)])
"""Triangles of CUBE, two for each side: west, east, south, north, below, above."""
ROUGH, PANEL, LINING = "rough", "panel", "lining"


def material(absorption: float, scattering: float) -> Material:
    bands = len(OCTAVE_BANDS_HZ)
    return Material(absorption=(absorption,) * bands, scattering=(scattering,) * bands)


def place_of(*parts: _Part, **materials: Material) -> MeshGeometry:
    names, begin = tuple(materials), 0
    vertices: list[_Floats] = []
    triangles, surfaces = [], []
    for corners, faces, name in parts:
        triangles.append(np.asarray(faces) + begin)
        vertices.append(np.asarray(corners, dtype=float))
        surfaces.append(np.full(len(triangles[-1]), names.index(name)))
        begin += len(vertices[-1])
    mesh = TriangleMesh(np.concatenate(vertices), np.concatenate(triangles), np.concatenate(surfaces), names)
    return MeshGeometry(mesh, materials)


def house(absorption: float, scattering: float) -> MeshGeometry:
    """A room of 5 x 4 m under a gabled roof, 2.5 m high at the eaves and 4 m at the ridge, with a block in it."""
    profile = np.array([(0, 0), (4, 0), (4, 2.5), (2, 4), (0, 2.5)], dtype=float)
    ends = [np.column_stack([np.full(5, x), profile]) for x in (0.0, 5.0)]
    gable = np.array([(0, 1, 2), (0, 2, 4), (2, 3, 4)])
    here, after = np.arange(5), np.roll(np.arange(5), -1)
    sides = [(a, b, b + 5) for a, b in zip(here, after, strict=True)]
    sides += [(a, b + 5, a + 5) for a, b in zip(here, after, strict=True)]
    shell = np.concatenate([gable, gable[:, ::-1] + 5, np.array(sides)[:, ::-1]])
    block = CUBE * (1.5, 1.0, 0.8) + (2.5, 0.7, 0.9)
    of_all = material(absorption, scattering)
    return place_of((np.concatenate(ends), shell, ROUGH), (block, INWARDS[:, ::-1], ROUGH), **{ROUGH: of_all})


def pyramid(absorption: float, scattering: float) -> MeshGeometry:
    """A pyramid of 6 m over a base of 7 x 5 m."""
    corners = [(0, 0, 0), (7, 0, 0), (7, 5, 0), (0, 5, 0), (3.5, 2.5, 6)]
    faces = [(0, 1, 2), (0, 2, 3), (1, 0, 4), (2, 1, 4), (3, 2, 4), (0, 3, 4)]
    return place_of((corners, faces, ROUGH), **{ROUGH: material(absorption, scattering)})


def shoebox_plan(absorption: float, scattering: float) -> Geometry:
    """A plan of 6 x 4.5 m, 3 m high."""
    return _plan(((0, 0), (6, 0), (6, 4.5), (0, 4.5)), 3.0, material(absorption, scattering))


def l_plan(absorption: float, scattering: float) -> Geometry:
    """An L of 8 x 7 m whose arms are 3 and 3.5 m wide, 2.8 m high."""
    corners = ((0, 0), (8, 0), (8, 3), (3.5, 3), (3.5, 7), (0, 7))
    return _plan(corners, 2.8, material(absorption, scattering))


def _plan(corners: tuple[tuple[float, float], ...], height_m: float, of_all: Material) -> Geometry:
    materials = Materials(walls=of_all, floor=of_all, ceiling=of_all)
    return Geometry(height_m=height_m, corners=corners, materials=materials)


def two_rooms(
    *, wall_m: float, absorption: float, panel: Material, lining: Material | None = None, slit_m: float = 0.0
) -> MeshGeometry:
    """Rooms of 3 x 3 x 2.5 m and 4 x 3 x 2.5 m, and a wall between them: a sheet, or `wall_m` thick. Its sides are of
    PANEL, or the second one of LINING. What goes into a thick wall at its edge leaves it outside of the rooms. A sheet
    may have a slit in its middle, as high as the rooms."""
    rooms = [(CUBE * (size_x, 3, 2.5) + (x, 0, 0)) for size_x, x in ((3, 0), (4, 3 + wall_m))]
    west, east = INWARDS[[0, 1]], INWARDS[[2, 3]]
    rest = [np.delete(INWARDS, at, axis=0) for at in ((2, 3), (0, 1))]
    materials = {ROUGH: material(absorption, 1.0), PANEL: panel, LINING: lining or panel}
    second: list[_Part] = [(rooms[1], west, LINING if lining else PANEL)] if wall_m else []
    side_m = (3 - slit_m) / 2
    wall: list[_Part] = [(rooms[0], east, PANEL)]
    if slit_m:
        wall = [(CUBE * (3, side_m, 2.5) + (0, y, 0), east, PANEL) for y in (0.0, 3 - side_m)]
    return place_of((rooms[0], rest[0], ROUGH), (rooms[1], rest[1], ROUGH), *wall, *second, **materials)


def places_in(place: MeshGeometry, count: int, rng: np.random.Generator, *, clear_m: float = 0.3) -> _Floats:
    """(count, 3) random places in the air, so far from all surfaces. Raises ValueError if too little room is left."""
    tree, (low, high) = MeshTree(place.mesh), place.mesh.bounds_m
    points = rng.uniform(low, high, (200 * count, 3))
    free = points[tree.contains(points) & (tree.distance_m(points) >= clear_m)][:count]
    if len(free) < count:
        raise ValueError(f"clear_m: only {len(free)} of {count} places are {clear_m:g} m from all surfaces")
    return np.asarray(free)
