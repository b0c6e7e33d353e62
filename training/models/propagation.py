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

_TOUCH = 1e-6
_FAR = 1e4


@dataclass(frozen=True)
class Path:
    """Shortest path from emitter to listener: `length` (B,), unit directions in plan (B, 2) in which it leaves each
    end, sight (B,)."""

    length: Tensor
    from_listener: Tensor
    from_emitter: Tensor
    visible: Tensor


class Propagation(nn.Module):
    """Shortest paths through a floor plan, round its reflex corners.

    A graph of many small nodes takes longer than what they compute, so all lines are looked along at once, by products
    and sums over whole vectors, whose last axis is the longest; where there is nothing to see round, there is nothing
    to compute.
    """

    def __init__(self, plan: FloorPlan) -> None:
        super().__init__()
        self._bend_count = len(plan.bend_corners)
        walls = plan.walls
        edges = walls[:, 1] - walls[:, 0]
        between = np.minimum(plan.bend_lengths_m, _FAR) if self._bend_count else ()
        for name, values in (
            ("start", walls[:, 0].T[:, None]),
            ("end", walls[:, 1].T[:, None]),
            ("normals", _turned_left(edges).T[:, None]),
            ("bends", np.reshape(plan.bend_corners, (self._bend_count, 2))),
            ("between", np.reshape(between, (self._bend_count, self._bend_count))),
            ("turn_left", _turned_left(np.eye(2)).T),
        ):
            self.register_buffer(f"_{name}", torch.tensor(values, dtype=torch.float32), persistent=False)

    @property
    def sees_all(self) -> bool:
        """Whether there is nothing to see round."""
        return self._bend_count == 0

    def forward(self, listener: Tensor, emitter: Tensor) -> Path:
        p, q = listener[:, :2], emitter[:, :2]
        rise = listener[:, 2:] - emitter[:, 2:]
        if self.sees_all:
            plan_length, visible = _norm(p - q), torch.ones_like(rise)
            towards, back = q, p
        else:
            plan_length, visible, towards, back = self._shortest(p, q)
        return Path(
            torch.sqrt(plan_length**2 + rise**2 + 1e-9)[:, 0],
            _direction(towards - p),
            _direction(back - q),
            visible[:, 0],
        )

    def _shortest(self, p: Tensor, q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Length in plan and sight (B, 1); where the path goes from p, and from q, first (B, 2)."""
        count = self._bend_count
        bends = self._bends.T.expand(p.shape[0], -1, -1)
        here, there = p[..., None], q[..., None]
        froms = torch.cat([here, here.expand(-1, -1, count), there.expand(-1, -1, count)], dim=2)
        tos = torch.cat([there, bends, bends], dim=2)
        sees = self._visible(froms, tos)
        reach = torch.where(sees, _norm(froms - tos, dim=1)[:, 0], _FAR)
        via = reach[:, 1 : 1 + count, None] + self._between + reach[:, None, 1 + count :]
        by_first, by_last = via.amin(dim=2), via.amin(dim=1)
        sight = sees[:, :1]
        return (
            torch.where(sight, reach[:, :1], by_first.amin(dim=1, keepdim=True)),
            sight.to(p.dtype),
            torch.where(sight, q, self._bends[by_first.argmin(dim=1)]),
            torch.where(sight, p, self._bends[by_last.argmin(dim=1)]),
        )

    def _visible(self, froms: Tensor, tos: Tensor) -> Tensor:
        """(B, N) sight between (B, 2, N) points; a line that grazes a corner is free."""
        p, q = froms[..., None], tos[..., None]
        across = (self._turn_left @ (tos - froms))[..., None]
        after_start = p - self._start
        crosses = (_dot(after_start, self._normals) * _dot(q - self._start, self._normals) < -_TOUCH) & (
            _dot(after_start, across) * _dot(p - self._end, across) < -_TOUCH
        )
        return ~crosses.any(dim=-1)


def _turned_left(offsets: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(n, 2) by a quarter of a turn: their scalar products are what others' cross products with them would be."""
    x, y = np.asarray(offsets, dtype=np.float64).T
    return np.stack([-y, x], axis=-1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products (B, N, wall) over axis 1."""
    return torch.sum(a * b, dim=1)


def _norm(offset: Tensor, dim: int = -1) -> Tensor:
    """With an axis of one in place of `dim`."""
    return torch.sqrt(torch.sum(offset * offset, dim=dim, keepdim=True) + 1e-12)


def _direction(offset: Tensor) -> Tensor:
    return offset / (_norm(offset) + 1e-4)
