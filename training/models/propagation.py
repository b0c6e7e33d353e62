"""Geometric inputs of a field: sight, shortest path and directions. They are computed in torch so that they are part of
the ONNX graph.

Results agree with `server.acoustics.geometry.FloorPlan` (tested); points are (B, 3).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from server.acoustics.geometry import FloorPlan

_Floats = npt.NDArray[np.float64]

_TOUCH = 1e-6
"""In m^4, for the product of two products of sides. Below it a line only grazes a corner, or the value is rounding."""
_FAR = 1e4
_PENUMBRA_M = 0.05
"""Sight has fallen to 1 / e where the path round a corner is this much longer than the straight line: half a wavelength
at 3 kHz. Reflected sound does not change at once where the line of sight breaks, so predicted levels must not jump
there."""


@dataclass(frozen=True)
class Path:
    """The shortest path from emitter to listener: its `length`, the height `rise` from listener to emitter, and
    `visible` (B, 1), which is 1 where the two see each other and falls to 0 behind a corner. `directions` (B, 2, 2) are
    unit vectors in plan in which the path leaves the listener and the emitter."""

    length: Tensor
    rise: Tensor
    directions: Tensor
    visible: Tensor


class Propagation(nn.Module):
    """Shortest paths through a floor plan, round its reflex corners.

    In a graph of many small nodes, the overhead of nodes takes longer than their arithmetic. So both ends are computed
    together by products and sums of whole arrays, constants of corners and walls are computed beforehand, and nothing
    is computed for a plan without reflex corners.
    """

    _apart: Tensor
    _turn_left: Tensor
    _corners: Tensor
    _bends: Tensor
    _bends_across: Tensor
    _between: Tensor
    _of_place: Tensor
    _of_all_places: Tensor

    def __init__(self, plan: FloorPlan) -> None:
        super().__init__()
        walls = np.asarray(plan.walls, dtype=np.float64)
        self._wall_count, self._bend_count = len(walls), len(plan.bend_corners)
        bends = np.reshape(plan.bend_corners, (self._bend_count, 2))
        between = np.minimum(plan.bend_lengths_m, _FAR) if self._bend_count else ()
        for name, values in (
            ("apart", [[-1, 1]]),
            ("turn_left", _turned_left(np.eye(2))),
            ("corners", np.concatenate([walls[:, 0], walls[:, 1]]).T),
            ("bends", bends),
            ("bends_across", bends.T),
            ("between", np.reshape(between, (self._bend_count, self._bend_count))),
            *zip(("of_place", "of_all_places"), _crossings(walls, bends), strict=True),
        ):
            self.register_buffer(f"_{name}", torch.tensor(np.asarray(values), dtype=torch.float32), persistent=False)

    @property
    def sees_all(self) -> bool:
        """Whether all places see each other."""
        return self._bend_count == 0

    def forward(self, listener: Tensor, emitter: Tensor) -> Path:
        ends = torch.stack([listener, emitter], dim=1)
        places = ends[..., :2]
        offset = (self._apart @ ends)[:, 0]
        across, rise = torch.split(offset, [2, 1], dim=-1)
        plan_length, visible = _norm(across), torch.ones_like(rise)
        towards = places.flip(1)
        if not self.sees_all:
            plan_length, visible, towards = self._shortest(places, across, plan_length, towards)
        out = towards - places
        directions = out / (_norm(out) + 1e-4)
        length = torch.sqrt(plan_length * plan_length + rise * rise + 1e-9)
        return Path(length, rise, directions, visible)

    def _shortest(
        self, places: Tensor, across: Tensor, straight: Tensor, other: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The length in plan, sight (B, 1), and the point that the path leads to first from either end. `places` (B,
        end, 2) are in plan, `across` (B, 2) is the offset between them, `straight` (B, 1) its length, and `other` the
        places in exchanged order."""
        corners = self._bend_count * self._wall_count
        crossings = places @ self._of_place + self._of_all_places
        sides, starts, stops, of_walls = torch.split(crossings, [corners, corners, corners, self._wall_count], dim=-1)
        crossed = torch.maximum(sides, starts * stops).reshape(-1, 2, self._bend_count, self._wall_count)
        columns = places[..., None]
        to_bends = columns - self._bends_across
        far = torch.sqrt(torch.sum(to_bends * to_bends, dim=2) + 1e-12)
        reach = torch.where(crossed.amin(dim=-1) < -_TOUCH, _FAR, far)
        via = (reach[..., None] + self._between + reach.flip(1)[:, :, None]).amin(dim=-1)
        sight = ~self._is_crossed(columns[:, 0], across, of_walls)
        shortest = torch.where(sight, straight, via.amin(dim=(1, 2))[:, None])
        return (
            shortest,
            # A place further away than _FAR may be straight ahead of a way that is called shorter.
            torch.exp(torch.clamp(straight - shortest, max=0.0) / _PENUMBRA_M),
            torch.where(sight[..., None], other, self._bends[via.argmin(dim=-1)]),
        )

    def _is_crossed(self, start: Tensor, across: Tensor, sides: Tensor) -> Tensor:
        """(B, 1) whether a wall crosses the line from `start` (B, 2, 1) by the offset `across` (B, 2). `sides` (B, end,
        wall) tell on which side of each wall its ends lie. A wall that only touches the line does not cross it."""
        of_line = (across @ self._turn_left)[:, None]
        starts, stops = torch.split(of_line @ (self._corners - start), self._wall_count, dim=-1)
        crossed = torch.maximum(sides.prod(dim=1, keepdim=True), starts * stops)
        return crossed.amin(dim=-1) < -_TOUCH


def _crossings(walls: _Floats, bends: _Floats) -> tuple[_Floats, _Floats]:
    """Factors (2, n) and offsets (n,) of a linear map of a place. Its outputs are, for each bend and wall: the product
    of the sides of the wall on which place and bend lie; the side of the line from place to bend on which the wall's
    start lies; the same for the wall's end; and last, for each wall, the side on which the place lies. Where the bend
    is an end of the wall, the first is exactly 0."""
    starts, stops = walls[:, 0], walls[:, 1]
    normals = _turned_left(stops - starts)
    of_start = np.sum(normals * starts, axis=-1)
    of_bends = np.sum(bends[:, None] * normals, axis=-1) - of_start
    of_bends[np.all(bends[:, None, None] == walls, axis=-1).any(axis=-1)] = 0
    factors, offsets = [of_bends[..., None] * normals], [-of_bends * of_start]
    for ends in (starts, stops):
        factors.append(-_turned_left(bends[:, None] - ends))
        offsets.append(np.sum(factors[-1] * -ends, axis=-1))
    flat = [part.reshape(-1, 2) for part in (*factors, normals)]
    return np.concatenate(flat).T, np.concatenate([*(part.ravel() for part in offsets), -of_start])


def _turned_left(offsets: npt.ArrayLike) -> _Floats:
    """(..., 2) turned left by 90 degrees. The dot product with a turned vector is the cross product with the
    original."""
    x, y = np.moveaxis(np.asarray(offsets, dtype=np.float64), -1, 0)
    return np.stack([-y, x], axis=-1)


def _norm(offset: Tensor) -> Tensor:
    """(..., 1) lengths of vectors (..., 2)."""
    return torch.sqrt(torch.sum(offset * offset, dim=-1, keepdim=True) + 1e-12)
