"""What geometry alone tells a field: sight, shortest path and directions, in torch so that they live inside the ONNX
graph.

Agrees with `server.acoustics.geometry.FloorPlan` (tested); points are (B, 3).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from server.acoustics.geometry import FloorPlan

_Floats = npt.NDArray[np.float64]

_TOUCH = 1e-6
"""Metres to the fourth power, of two products of sides: less is a line that grazes a corner, or rounding."""
_FAR = 1e4
_PENUMBRA_M = 0.05
"""By how much a way round a corner is longer than the straight one where sight has fallen to 1 / e: half a wavelength
at 3 kHz. Reflected sound does not change at once where the line of sight breaks, and levels may not step there."""


@dataclass(frozen=True)
class Path:
    """Shortest path from emitter to listener: `length`, by how much the emitter is higher, and sight (B, 1), 1 where
    they see each other and falling to 0 behind a corner; unit directions in plan in which it leaves the listener and
    the emitter (B, 2, 2)."""

    length: Tensor
    rise: Tensor
    directions: Tensor
    visible: Tensor


class Propagation(nn.Module):
    """Shortest paths through a floor plan, round its reflex corners.

    A graph of many small nodes takes longer than what they compute, so both ends are worked on together, by products
    and sums over whole vectors, and what is known of corners and walls is worked out beforehand; where there is nothing
    to see round, there is nothing to compute.
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
        """Whether there is nothing to see round."""
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
        """Length in plan, sight (B, 1), and where the path goes from either end first (B, end, 2), of places in plan
        (B, end, 2), which are `across` (B, 2) from each other, and `straight` (B, 1); `other` are the ends
        exchanged."""
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
            torch.exp((straight - shortest) / _PENUMBRA_M),
            torch.where(sight[..., None], other, self._bends[via.argmin(dim=-1)]),
        )

    def _is_crossed(self, start: Tensor, across: Tensor, sides: Tensor) -> Tensor:
        """(B, 1) whether a wall crosses the line that leads `across` (B, 2) from `start` (B, 2, 1), whose ends are on
        these `sides` (B, end, wall) of walls; one that grazes a corner does not."""
        of_line = (across @ self._turn_left)[:, None]
        starts, stops = torch.split(of_line @ (self._corners - start), self._wall_count, dim=-1)
        crossed = torch.maximum(sides.prod(dim=1, keepdim=True), starts * stops)
        return crossed.amin(dim=-1) < -_TOUCH


def _crossings(walls: _Floats, bends: _Floats) -> tuple[_Floats, _Floats]:
    """(2, n) and (n,): a place times the one and with the other added has first, for each bend and wall, the product of
    the two's sides of the wall, then of which side of the line to the bend the wall's start is and its end; then of
    which side of each wall the place is. Where the bend is an end of the wall, their product is exactly 0."""
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
    """(..., 2) by a quarter of a turn: their scalar products are what others' cross products with them would be."""
    x, y = np.moveaxis(np.asarray(offsets, dtype=np.float64), -1, 0)
    return np.stack([-y, x], axis=-1)


def _norm(offset: Tensor) -> Tensor:
    """(..., 1) of (..., 2)."""
    return torch.sqrt(torch.sum(offset * offset, dim=-1, keepdim=True) + 1e-12)
