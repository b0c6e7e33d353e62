"""What rays meet in a triangle mesh, without a tree: each triangle is tried, in NumPy or in exact fractions."""

from fractions import Fraction

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh import TriangleMesh

Floats = npt.NDArray[np.float64]


def distances(mesh: TriangleMesh, origins: Floats, directions: Floats) -> Floats:
    """(ray, triangle) distances in lengths of the direction, infinite where a ray does not meet a triangle. By Moeller
    and Trumbore (J. Graphics Tools 2(1), 1997), which decides by rounding what is at an edge."""
    first, second, third = mesh.corners_m.transpose(1, 0, 2)
    across = np.cross(directions[:, None], third - first)
    volume = np.sum((second - first) * across, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origins[:, None] - first
        u = np.sum(offset * across, axis=-1) / volume
        beside = np.cross(offset, second - first)
        v = np.sum(directions[:, None] * beside, axis=-1) / volume
        distance = np.sum((third - first) * beside, axis=-1) / volume
        meets = (volume != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return np.where(meets, distance, np.inf)


def exact(mesh: TriangleMesh, origin: Floats, direction: Floats) -> tuple[list[Fraction], list[Fraction]]:
    """Distances greater than zero at which a ray meets triangles: in their interior, and there or on their edges. A ray
    in the plane of a triangle does not meet it."""
    start, way = [[Fraction(float(value)) for value in point] for point in (origin, direction)]
    inside, touching = [], []
    for corners in mesh.corners_m:
        a, b, c = ([Fraction(float(value)) - at for value, at in zip(corner, start, strict=True)] for corner in corners)
        sides = [_volume(way, p, q) for p, q in ((b, c), (c, a), (a, b))]
        whole = sum(sides)
        if whole == 0 or not (all(side >= 0 for side in sides) or all(side <= 0 for side in sides)):
            continue
        point = [sum(side * corner[axis] for side, corner in zip(sides, (a, b, c), strict=True)) for axis in range(3)]
        distance = next(at / (step * whole) for at, step in zip(point, way, strict=True) if step)
        if distance > 0:
            touching.append(distance)
            if all(sides):
                inside.append(distance)
    return inside, touching


def _volume(a: list[Fraction], b: list[Fraction], c: list[Fraction]) -> Fraction:
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
