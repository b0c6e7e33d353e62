"""The compiled code of `server.acoustics.mesh_reflections`, for one emitter after the other."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import COINCIDENT_M, TOUCH_M
from server.acoustics.mesh_tree_kernel import Tree, closest_hit, first_blocker
from server.kernels.compiled import compiled

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int32]


class Patches(NamedTuple):
    """Planes by unit `normals` (xyz, patch) and `offsets` (patch,) along them, `bounds` (6, patch), and `of_rows`
    (triangle,), the patch of each triangle in the order of the tree (-1 for none). What is nearer to a patch than
    `margin_m` lies on it."""

    normals: Floats
    offsets: Floats
    bounds: Floats
    of_rows: Integers
    margin_m: float


@compiled
def _meets_patch(tree: Tree, patches: Patches, stack: Integers, patch: int, start: Floats, spot: Floats) -> int:
    """The row of the triangle of a patch that a line from `start` meets first, at `spot`; -1 if it meets another."""
    dx, dy, dz = spot[0] - start[0], spot[1] - start[1], spot[2] - start[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    near = patches.margin_m / length
    distance, row, _ = closest_hit(tree, stack, start[0], start[1], start[2], dx, dy, dz, 1e-3 * near, 1 + near, -1)
    if row < 0 or distance < 1 - near or patches.of_rows[row] != patch:
        return -1
    return row


@compiled
def _offset(patches: Patches, patch: int, point: Floats) -> float:
    """How far a point is from the plane of a patch, on the side of its normal."""
    normals = patches.normals
    return float(
        normals[0, patch] * point[0]
        + normals[1, patch] * point[1]
        + normals[2, patch] * point[2]
        - patches.offsets[patch]
    )


@compiled
def _try_all(patches: Patches, listener: Floats, emitter: Floats, is_near: npt.NDArray[np.bool_]) -> None:
    """Fill `is_near` (patch,) with whether the line to the image in its plane goes through the box around a patch. All
    are tried without a branch, several at a time."""
    normals, bounds, offsets = patches.normals, patches.bounds, patches.offsets
    lx, ly, lz = listener[0], listener[1], listener[2]
    ex, ey, ez = emitter[0], emitter[1], emitter[2]
    for patch in range(len(offsets)):
        nx, ny, nz = normals[0, patch], normals[1, patch], normals[2, patch]
        l_off = nx * lx + ny * ly + nz * lz - offsets[patch]
        e_off = nx * ex + ny * ey + nz * ez - offsets[patch]
        between = l_off + e_off
        share = l_off / between
        x, y, z = lx - l_off * nx, ly - l_off * ny, lz - l_off * nz
        x += (ex - e_off * nx - x) * share
        y += (ey - e_off * ny - y) * share
        z += (ez - e_off * nz - z) * share
        is_near[patch] = (
            (abs(between) >= COINCIDENT_M)
            # Both ends are on one side, or on the plane.
            & (abs(between) + 2 * TOUCH_M >= abs(l_off - e_off))
            & (x >= bounds[0, patch] - patches.margin_m)
            & (y >= bounds[1, patch] - patches.margin_m)
            & (z >= bounds[2, patch] - patches.margin_m)
            & (x <= bounds[3, patch] + patches.margin_m)
            & (y <= bounds[4, patch] + patches.margin_m)
            & (z <= bounds[5, patch] + patches.margin_m)
        )


@compiled
def find_patch_reflections(
    tree: Tree,
    patches: Patches,
    stack: Integers,
    listener: Floats,
    emitters: Floats,
    most: int,
    emitter: npt.NDArray[np.int64],
    triangle: Integers,
    length_m: Floats,
    arrival: Floats,
    departure: Floats,
) -> int:
    """Fill the first rows of the last five arrays and return the number of reflections, `most` of each emitter; see
    `MeshReflectionFinder`."""
    found = 0
    spot, is_near = np.empty(3), np.empty(len(patches.offsets), np.bool_)
    for row in range(len(emitters)):
        until = found + most
        _try_all(patches, listener, emitters[row], is_near)
        for patch in range(len(patches.offsets)):
            if not is_near[patch]:
                continue
            l_off, e_off = _offset(patches, patch, listener), _offset(patches, patch, emitters[row])
            side = 1.0 if l_off + e_off > 0.0 else -1.0
            l_off, e_off = side * l_off, side * e_off
            nx, ny, nz = (
                side * patches.normals[0, patch],
                side * patches.normals[1, patch],
                side * patches.normals[2, patch],
            )
            share = l_off / (l_off + e_off)
            for axis in range(3):
                step = nx if axis == 0 else (ny if axis == 1 else nz)
                here, there = listener[axis] - l_off * step, emitters[row, axis] - e_off * step
                spot[axis] = here + (there - here) * share
            # The farther end looks for the patch, since the nearer one may lie on it.
            far, near = (listener, emitters[row]) if l_off >= e_off else (emitters[row], listener)
            hit = _meets_patch(tree, patches, stack, patch, far, spot)
            if hit < 0:
                continue
            dx, dy, dz = near[0] - spot[0], near[1] - spot[1], near[2] - spot[2]
            rest = math.sqrt(dx * dx + dy * dy + dz * dz)
            if rest > 2 * patches.margin_m:
                margin = patches.margin_m / rest
                plane = tree.planes[hit]
                if (
                    first_blocker(tree, stack, spot[0], spot[1], spot[2], dx, dy, dz, margin, 1 - margin, plane, -1)
                    >= 0
                ):
                    continue
            if found == until:
                break
            # From the listener to the emitter's image, and from the emitter to the listener's.
            ax, ay, az = (
                emitters[row, 0] - listener[0] - 2 * e_off * nx,
                emitters[row, 1] - listener[1] - 2 * e_off * ny,
                emitters[row, 2] - listener[2] - 2 * e_off * nz,
            )
            length = math.sqrt(ax * ax + ay * ay + az * az)
            turn = 2 * (l_off + e_off)
            emitter[found], triangle[found], length_m[found] = row, tree.numbers[hit], length
            arrival[found, 0], arrival[found, 1], arrival[found, 2] = ax / length, ay / length, az / length
            departure[found, 0] = -(ax + turn * nx) / length
            departure[found, 1] = -(ay + turn * ny) / length
            departure[found, 2] = -(az + turn * nz) / length
            found += 1
    return found
